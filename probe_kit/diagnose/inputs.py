"""The inputs of a policy: which of them a source varies, and how one is exchanged, blanked or hardly changed.

An input is named `instruction`, `state`, `picture` for the first camera, or `picture.<camera>`. Everything else of
an observation stays as it is. Loads no model.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.observation import Observation

INSTRUCTION, STATE, PICTURE = "instruction", "state", "picture"
JPEG_QUALITY = 95
"""Of the round trip that is the control of a picture: it changes pixels and nothing that they show."""
STATE_STEP = 0.01
"""Of the spread of the states: the control of the state."""
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """One observation that a policy gets, alone.

    group: the unit that is resampled, such as an episode, or a couple of items. seed: of the inference.
    other_words: the same instruction in other words; empty where the source has none.
    """

    name: str
    observation: Observation
    group: str
    seed: int
    other_words: str = ""


def inputs_of(frames: Sequence[Frame]) -> tuple[str, ...]:
    """The inputs that every frame holds: words, pictures and state. Raises UsageError without frames."""
    if not frames:
        raise UsageError("the source has no frame; diagnose needs at least two that differ")
    cameras = [camera for camera in frames[0].observation.cameras if _have(frames, camera)]
    return (INSTRUCTION, PICTURE, *(f"{PICTURE}.{camera}" for camera in cameras), STATE)


def _have(frames: Sequence[Frame], camera: str) -> bool:
    return all(camera in frame.observation.cameras for frame in frames)


def read_input(observation: Observation, name: str) -> object:
    """The value of one input. Raises UsageError for a camera that the observation does not have."""
    if name == INSTRUCTION:
        return observation.instruction
    if name == STATE:
        return observation.state
    if name == PICTURE:
        return observation.image
    return observation.cameras[_camera_of(observation, name)]


def write_input(observation: Observation, name: str, value: object) -> Observation:
    """The observation with another value of one input. Raises UsageError as `read_input`."""
    if name == INSTRUCTION:
        return replace(observation, instruction=str(value))
    if name == STATE:
        return replace(observation, state=np.asarray(value, np.float32))
    if name == PICTURE:
        return replace(observation, image=np.asarray(value, np.uint8))
    cameras = {**observation.cameras, _camera_of(observation, name): np.asarray(value, np.uint8)}
    return replace(observation, cameras=MappingProxyType(cameras))


def _camera_of(observation: Observation, name: str) -> str:
    kind, _, camera = name.partition(".")
    if kind != PICTURE or camera not in observation.cameras:
        further = [f"{PICTURE}.{other}" for other in observation.cameras]
        raise UsageError(
            f"no input is called {name!r}; this source has {', '.join((INSTRUCTION, PICTURE, *further, STATE))}"
        )
    return camera


def same_value(first: Observation, second: Observation, name: str) -> bool:
    """Whether two observations hold the same of one input."""
    return bool(np.array_equal(np.asarray(read_input(first, name)), np.asarray(read_input(second, name))))


def differing(frames: Sequence[Frame], name: str) -> bool:
    """Whether the frames hold more than one value of an input, so that it can be exchanged between them."""
    first = frames[0].observation
    return any(not same_value(first, frame.observation, name) for frame in frames[1:])


def blank(frames: Sequence[Frame], name: str) -> object:
    """No words; a picture of the mean colour of all frames; the mean state."""
    if name == INSTRUCTION:
        return ""
    values = [np.asarray(read_input(frame.observation, name)) for frame in frames]
    if name == STATE:
        return np.mean(values, axis=0, dtype=np.float64).astype(np.float32)
    colour = np.mean([value.mean(axis=(0, 1)) for value in values], axis=0)
    return np.broadcast_to(np.rint(colour).astype(np.uint8), values[0].shape).copy()


def hardly_changed(frame: Frame, spread: NDArray[np.float32], name: str) -> Observation:
    """The control of an input: other words of one meaning, a JPEG round trip, a state moved by 1 % of its spread.

    spread: of the states over frames. Without other words, the first letter's case and the full stop change.
    """
    value = read_input(frame.observation, name)
    if name == INSTRUCTION:
        return write_input(frame.observation, name, frame.other_words or _retyped(str(value)))
    if name == STATE:
        return write_input(frame.observation, name, np.asarray(value) + STATE_STEP * spread)
    return write_input(frame.observation, name, _jpeg_round_trip(np.asarray(value)))


def spread_of_states(frames: Sequence[Frame]) -> NDArray[np.float32]:
    """Standard deviation of every number of the state over frames."""
    states = np.stack([frame.observation.state for frame in frames]).astype(np.float64)
    return np.asarray(states.std(axis=0), np.float32)


def _retyped(words: str) -> str:
    """Without its full stop if it has one, else with one; the first letter in the other case."""
    stopped = words.removesuffix(".") if words.endswith(".") else f"{words}."
    return stopped[:1].swapcase() + stopped[1:]


def _jpeg_round_trip(picture: Picture) -> Picture:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=JPEG_QUALITY)
    return np.asarray(Image.open(stream).convert("RGB"), np.uint8)
