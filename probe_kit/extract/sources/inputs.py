"""The inputs of an observation by name, exchanged or hardly changed one at a time. Imports no torch.

An input is `instruction`, `state`, `picture` for the pictures of all cameras, or `picture.NAME` for one. A name
that no further camera has is that of the first one, whose picture is `Observation.image`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite.pictures import through_jpeg

INSTRUCTION, STATE, PICTURE = "instruction", "state", "picture"
STATE_SHARE = 0.01
"""The share of its spread over frames by which a control moves a state."""
FIRST = ""
"""The first camera, among the names of cameras."""
Picture = NDArray[np.uint8]


def with_input(clean: Observation, vary: str, donor: Observation) -> Observation:
    """Return the clean observation with one input of another."""
    if vary == INSTRUCTION:
        return replace(clean, instruction=donor.instruction)
    if vary == STATE:
        return replace(clean, state=donor.state)
    return with_pictures(clean, vary, partial(picture_of, donor))


def same_input(first: Observation, second: Observation, vary: str) -> bool:
    """Return whether two observations hold the same of one input."""
    if vary == INSTRUCTION:
        return first.instruction == second.instruction
    if vary == STATE:
        return np.array_equal(first.state, second.state)
    return all(np.array_equal(picture_of(first, name), picture_of(second, name)) for name in _cameras(first, vary))


def content_of(observation: Observation, vary: str) -> bytes:
    """Return the bytes of one input: equal ones are one value of it, among observations of equal shapes."""
    if vary == INSTRUCTION:
        return observation.instruction.encode()
    if vary == STATE:
        return observation.state.tobytes()
    return b"".join(picture_of(observation, name).tobytes() for name in _cameras(observation, vary))


def hardly_changed(clean: Observation, vary: str, spread: NDArray[np.floating]) -> Observation:
    """Return the clean observation after a change of one input that means nothing.

    The full stop, a JPEG round trip, a hundredth of the state's spread. spread: (D,) of the state.
    """
    if vary == INSTRUCTION:
        return replace(clean, instruction=with_other_stop(clean.instruction))
    if vary == STATE:
        moved = clean.state + STATE_SHARE * spread[: clean.state.size]
        return replace(clean, state=moved.astype(np.float32))
    return with_pictures(clean, vary, lambda name: through_jpeg(picture_of(clean, name)))


def with_other_stop(text: str) -> str:
    """Return a text with its full stop removed, or one added."""
    return text[:-1] if text.endswith(".") else f"{text}."


def blank_of(observations: Sequence[Observation]) -> Observation:
    """Return an observation without content: no words, pictures of the mean colour of all, the mean state."""
    first = observations[0]
    states = np.stack([observation.state for observation in observations]).astype(np.float64)
    cameras: Mapping[str, Picture] = {
        name: _mean_colour([observation.cameras[name] for observation in observations]) for name in first.cameras
    }
    return replace(
        first,
        image=_mean_colour([observation.image for observation in observations]),
        state=states.mean(axis=0).astype(np.float32),
        instruction="",
        cameras=cameras,
    )


def _mean_colour(pictures: Sequence[Picture]) -> Picture:
    colour = np.mean([picture.mean(axis=(0, 1)) for picture in pictures], axis=0)
    return np.broadcast_to(np.rint(colour).astype(np.uint8), pictures[0].shape).copy()


def with_pictures(clean: Observation, vary: str, picture: Callable[[str], Picture]) -> Observation:
    """The observation with other pictures of the cameras that an input names. picture: by the camera's name."""
    pictures = {name: picture(name) for name in _cameras(clean, vary)}
    image = pictures.pop(FIRST, clean.image)
    return replace(clean, image=image, cameras={**clean.cameras, **pictures})


def _cameras(observation: Observation, vary: str) -> tuple[str, ...]:
    camera = vary.partition(".")[2]
    if not camera:
        return FIRST, *observation.cameras
    return (camera,) if camera in observation.cameras else (FIRST,)


def picture_of(observation: Observation, camera: str) -> Picture:
    """Return (H, W, 3) the picture of a camera; of the first one for a name that no further camera has."""
    return observation.cameras.get(camera, observation.image)
