"""The inputs that frames hold, their blanks and their controls. Loads no model."""

from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.sources.inputs import (
    INSTRUCTION,
    PICTURE,
    STATE,
    Frame,
    content_of,
    hardly_changed,
    with_other_stop,
)
from probe_kit.hooks.contract.card import shown_cameras
from probe_kit.hooks.contract.observation import Observation

if TYPE_CHECKING:
    from probe_kit.runs import Run


def inputs_of(frames: Sequence[Frame], camera: str = "") -> tuple[str, ...]:
    """The inputs that every frame holds: words, pictures and state. Raises UsageError without frames.

    camera: the name of the first one, needed where there are several.
    """
    if not frames:
        raise UsageError("the source has no frame; diagnose needs at least two that differ")
    return names_of([camera or "first", *frames[0].observation.cameras])


def cameras_of(run: "Run") -> tuple[str, ...]:
    """Return the cameras of a run's model that got a picture."""
    policy = run.certificate["policy"]
    return shown_cameras(policy["cameras"], policy["needs"])


def names_of(cameras: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the inputs of a model that is shown these cameras."""
    pictures = [f"{PICTURE}.{name}" for name in cameras] if len(cameras) > 1 else [PICTURE]
    return (INSTRUCTION, *pictures, STATE)


def values_of(observations: Sequence[Observation], name: str) -> NDArray[np.intp]:
    """Return (F,) a number of every observation's value of an input; equal values have one number."""
    digests = [sha256(content_of(observation, name)).digest() for observation in observations]
    numbers = {digest: number for number, digest in enumerate(dict.fromkeys(digests))}
    return np.array([numbers[digest] for digest in digests], np.intp)


def controls_of(frame: Frame, name: str, spread: NDArray[np.float64]) -> list[Observation]:
    """The frame's observation after changes of one input that mean nothing, the best first; see `hardly_changed`.

    Without other words of the frame, the first letter's case and the full stop change, or one of them: a tokenizer
    of words may know only one spelling. spread: (D,) of the state.
    """
    clean = frame.observation
    if name != INSTRUCTION:
        return [hardly_changed(clean, name, spread)]
    texts = [frame.other_words] if frame.other_words else _retyped(clean.instruction)
    return [replace(clean, instruction=text) for text in texts]


def spread_of_states(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Standard deviation of every number of the state over frames."""
    states = np.stack([frame.observation.state for frame in frames]).astype(np.float64)
    return np.asarray(states.std(axis=0), np.float64)


def _retyped(words: str) -> list[str]:
    """The full stop added or removed, and the first letter in the other case; then one of both alone."""
    stopped = with_other_stop(words)
    return [text[:1].swapcase() + text[1:] for text in (stopped, words)] + [stopped]
