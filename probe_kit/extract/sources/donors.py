"""Frames, and the rule by which the donor of a frame is drawn. Loads no model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract.sources.inputs import INSTRUCTION, PICTURE, STATE, same_input
from probe_kit.hooks.contract.observation import Observation

NEAREST = 8
"""Frames with the nearest states among which the donor of a picture is drawn, so that the picture fits the arm."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One observation that a policy gets, alone; its pictures are read when they are needed.

    group: the unit that is resampled, such as an episode, or a couple of items. seed: of the inference.
    instruction, state: of the observation. observe: reads it, given the frame. other_words: the same instruction
    in other words; empty where the source has none.

    Of a run: row: in its episodes. number: of the recorded frame; 0 of an environment. item, episode, category: of
    the row. stored: (n, D) actions that the run has of it, None without any.
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
        """Return the frame of an observation that is there already."""
        state = np.asarray(observation.state, np.float64)
        return cls(name, group, seed, observation.instruction, state, lambda _: observation)

    @property
    def observation(self) -> Observation:
        """Return the observation."""
        return self.observe(self)


def draw_donors(
    frames: Sequence[Frame], vary: str, rng: np.random.Generator, count: int = 1, of: Sequence[int] | None = None
) -> list[tuple[int, int]]:
    """Return pairs (frame, donor) of indices: up to `count` donors per frame.

    A donor is of another group, and holds another value of the input. That of a picture is one of the `NEAREST`
    frames by state, in spreads of every number, and of all that are equally near. Frames without any donor are
    left out. of: the frames that get donors; None for all.
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
    """Return the nearest candidates with another picture, in the order of the frames. ordered: nearest first."""
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
