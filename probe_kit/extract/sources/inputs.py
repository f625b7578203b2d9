"""The inputs of an observation by name, exchanged or hardly changed one at a time. Imports no torch.

An input is `instruction`, `state`, `picture` for the pictures of all cameras, or `picture.NAME` for one. A name
that no further camera has is that of the first one, whose picture is `Observation.image`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite.pictures import through_jpeg

INSTRUCTION, STATE, PICTURE = "instruction", "state", "picture"
STATE_SHARE = 0.01
"""The share of its spread over frames by which a control moves a state."""
FIRST = ""
"""The name of the first camera, among the names of cameras."""
Picture = NDArray[np.uint8]


def with_input(clean: Observation, vary: str, donor: Observation) -> Observation:
    """Return the clean observation with one input of another."""
    if vary == INSTRUCTION:
        return replace(clean, instruction=donor.instruction)
    if vary == STATE:
        return replace(clean, state=donor.state)
    return with_pictures(clean, vary, partial(picture_of, donor))


def same_input(first: Observation, second: Observation, vary: str) -> bool:
    """Return whether two observations have the same value of one input."""
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

    The instruction gains or loses its period, pictures pass through JPEG, and the state moves by a hundredth of
    its `spread` (D,).
    """
    if vary == INSTRUCTION:
        return replace(clean, instruction=with_other_stop(clean.instruction))
    if vary == STATE:
        moved = clean.state + STATE_SHARE * spread[: clean.state.size]
        return replace(clean, state=moved.astype(np.float32))
    return with_pictures(clean, vary, lambda name: through_jpeg(picture_of(clean, name)))


def with_other_stop(text: str) -> str:
    """Return a text with its period removed, or one added."""
    return text[:-1] if text.endswith(".") else f"{text}."


def blank_of(observations: Sequence[Observation]) -> Observation:
    """Return an observation without content: no words, pictures of the mean color of all, the mean state."""
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
    """Return the observation with other pictures of the cameras that an input names, by the camera's name."""
    pictures = {name: picture(name) for name in _cameras(clean, vary)}
    image = pictures.pop(FIRST, clean.image)
    return replace(clean, image=image, cameras={**clean.cameras, **pictures})


def _cameras(observation: Observation, vary: str) -> tuple[str, ...]:
    camera = vary.partition(".")[2]
    if not camera:
        return FIRST, *observation.cameras
    return (camera,) if camera in observation.cameras else (FIRST,)


def picture_of(observation: Observation, camera: str) -> Picture:
    """Return the picture (H, W, 3) of a camera; of the first one for a name that no further camera has."""
    return observation.cameras.get(camera, observation.image)


NEAREST = 8
"""The frames with the nearest states from which a picture's donor is drawn, so that the picture fits the arm."""


@dataclass(frozen=True, eq=False)
class Frame:
    """An observation that a policy gets, alone; its pictures are read when they are needed.

    Attributes:
        group: The unit that is resampled, such as an episode, or a couple of items.
        seed: The seed of the inference.
        instruction: The instruction of the observation.
        state: The state of the observation.
        observe: A function that reads the observation, given the frame.
        other_words: The instruction in other words; empty where the source has none.
        row: The row in a run's episodes; -1 outside a run.
        number: The number of the recorded frame; 0 in an environment.
        item: The item of the row in a run.
        episode: The id of the row in a run.
        category: The category of the row in a run.
        stored: (n, D) actions that the run stores for it, None without any.
    """

    name: str
    group: str
    seed: int
    instruction: str
    state: NDArray[np.floating]
    observe: Callable[["Frame"], Observation] = field(repr=False)
    other_words: str = ""
    row: int = -1
    number: int = 0
    item: str = ""
    episode: str = ""
    category: str = ""
    stored: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, name: str, observation: Observation, group: str, seed: int) -> "Frame":
        """Return the frame of an observation that exists already."""
        state = np.asarray(observation.state, np.float64)
        return cls(name, group, seed, observation.instruction, state, lambda _: observation)

    @property
    def observation(self) -> Observation:
        """The observation, read when it is asked for."""
        return self.observe(self)


def draw_donors(
    frames: Sequence[Frame], vary: str, rng: np.random.Generator, count: int = 1, of: Sequence[int] | None = None
) -> list[tuple[int, int]]:
    """Return pairs (frame, donor) of indices: up to `count` donors per frame.

    A donor is of another group, and has another value of the input. The donor of a picture is one of the `NEAREST`
    frames by state, in spreads of every number, and of all that are equally near. Frames without any donor are
    left out.

    Args:
        frames: The frames, among which donors are drawn too.
        vary: The name of the input.
        rng: The generator of the draws.
        count: The most donors of a frame.
        of: The indices of the frames that get donors; None for all.
    """
    groups = np.array([frame.group for frame in frames])
    states = np.stack([np.asarray(frame.state, np.float64) for frame in frames])
    instructions = np.array([frame.instruction for frame in frames])
    spread = states.std(axis=0)
    scaled = states / np.where(spread > 0, spread, 1.0)
    pairs = []
    for index in range(len(frames)) if of is None else of:
        is_candidate = groups != groups[index]
        if vary == INSTRUCTION:
            is_candidate &= instructions != instructions[index]
        elif vary == STATE:
            is_candidate &= (states != states[index]).any(axis=1)
        candidates = np.flatnonzero(is_candidate)
        if vary.startswith(PICTURE):
            distances = np.linalg.norm(scaled[candidates] - scaled[index], axis=1)
            candidates = _nearest(frames, index, vary, candidates[np.argsort(distances, kind="stable")], distances)
        drawn = rng.choice(candidates, min(count, len(candidates)), replace=False)
        pairs += [(index, int(donor)) for donor in drawn]
    return pairs


def _nearest(
    frames: Sequence[Frame], index: int, vary: str, ordered: NDArray[np.intp], distances: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Return the nearest candidates with another picture, in the order of the frames.

    The candidates `ordered` come nearest first.
    """
    clean, limits = frames[index].observation, np.sort(distances)
    nearest: list[int] = []
    limit = np.inf
    for donor, distance in zip(ordered.tolist(), limits, strict=True):
        # Pictures of recordings are decoded one by one: none is read beyond the limit.
        if len(nearest) >= NEAREST and distance > limit:
            break
        if not same_input(clean, frames[donor].observation, vary):
            nearest.append(donor)
            limit = distance
    return np.sort(np.array(nearest, np.intp))
