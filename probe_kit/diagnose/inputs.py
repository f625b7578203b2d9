"""The inputs that frames hold, their blanks and their controls. Loads no model."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.sources.donors import Frame
from probe_kit.extract.sources.inputs import (
    INSTRUCTION,
    PICTURE,
    STATE,
    hardly_changed,
    same_input,
)
from probe_kit.hooks.contract.observation import Observation


def inputs_of(frames: Sequence[Frame], camera: str = "") -> tuple[str, ...]:
    """The inputs that every frame holds: words, pictures and state. Raises UsageError without frames.

    camera: the name of the first one, needed where there are several.
    """
    if not frames:
        raise UsageError("the source has no frame; diagnose needs at least two that differ")
    cameras = list(frames[0].observation.cameras)
    pictures = [f"{PICTURE}.{name}" for name in (camera or "first", *cameras)] if cameras else [PICTURE]
    return (INSTRUCTION, *pictures, STATE)


def differing(frames: Sequence[Frame], name: str) -> bool:
    """Whether the frames hold more than one value of an input, so that it can be exchanged between them."""
    first = frames[0].observation
    return any(not same_input(first, frame.observation, name) for frame in frames[1:])


def control_of(frame: Frame, name: str, spread: NDArray[np.float64]) -> Observation:
    """The frame's observation after a change of one input that means nothing, see `hardly_changed`.

    Without other words of the frame, the first letter's case and the full stop change. spread: (D,) of the state.
    """
    words = frame.other_words or _retyped(frame.observation.instruction)
    return hardly_changed(frame.observation, name, spread, words)


def spread_of_states(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Standard deviation of every number of the state over frames."""
    states = np.stack([frame.observation.state for frame in frames]).astype(np.float64)
    return np.asarray(states.std(axis=0), np.float64)


def _retyped(words: str) -> str:
    """Without its full stop if it has one, else with one; the first letter in the other case."""
    stopped = words.removesuffix(".") if words.endswith(".") else f"{words}."
    return stopped[:1].swapcase() + stopped[1:]
