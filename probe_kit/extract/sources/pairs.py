"""Pairs of observations that differ in one input only: a clean one, a donor, and a control."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.plan import Row
from probe_kit.extract.sources.inputs import (
    INSTRUCTION,
    PICTURE,
    STATE,
    hardly_changed,
    same_input,
    with_input,
)
from probe_kit.extract.sources.player import Opens
from probe_kit.hooks.contract.observation import Observation

MAIN = "main"
"""The camera of `Observation.image`; others have their names."""


@dataclass(frozen=True)
class Frame:
    """The first observation of a row."""

    row: Row
    observation: Observation


@dataclass(frozen=True)
class Pair:
    """Two observations of one seed. clean, donor: they differ in the input `vary` alone.

    control: the clean one after a change of the same input that means nothing; None where there is none.
    donor_row: the row whose input the donor has. seed: of the inferences of all.
    """

    vary: str
    row: Row
    donor_row: Row
    clean: Observation
    donor: Observation
    control: Observation | None
    seed: int


def frames_of(opens: Opens, rows: Sequence[Row]) -> list[Frame]:
    """The first observation of every row, by a player that is closed afterwards."""
    player = opens()
    frames = []
    try:
        for row in rows:
            observation = player.answer("begin", (row, False))
            assert isinstance(observation, Observation)
            pictures = {name: np.array(picture) for name, picture in observation.cameras.items()}
            copied = replace(
                observation, image=np.array(observation.image), state=np.array(observation.state), cameras=pictures
            )
            frames.append(Frame(row, copied))
    finally:
        player.close()
    return frames


def pairs_of(frames: Sequence[Frame], vary: str, rng: np.random.Generator) -> Iterator[Pair]:
    """A pair for every frame that has a donor: another instruction, the nearest other picture, or another state.

    The donor is a frame of another group; that of a picture has the nearest state.
    Raises UsageError for an input that the frames do not have, or that is the same in all of them.
    """
    if vary not in inputs_of(frames):
        raise UsageError(
            f"vary is {vary!r}; expected one of {', '.join(inputs_of(frames)) or 'nothing: no frames'}"
        )
    spread = np.ptp([frame.observation.state for frame in frames], axis=0)
    count = 0
    for frame in frames:
        candidates = [other for other in frames if other.row.columns["group_id"] != frame.row.columns["group_id"]]
        candidates = [other for other in candidates if not same_input(frame.observation, other.observation, vary)]
        if not candidates:
            continue
        count += 1
        if vary.startswith(PICTURE):
            donor = min(candidates, key=lambda other: _distance(frame.observation.state, other.observation.state))
        else:
            donor = candidates[int(rng.integers(len(candidates)))]
        yield Pair(
            vary, frame.row, donor.row, frame.observation, with_input(frame.observation, vary, donor.observation),
            hardly_changed(frame.observation, vary, spread), frame.row.policy_seed,
        )  # fmt: skip
    if not count:
        raise UsageError(f"{vary} is the same in all {len(frames)} frames of different groups; choose more rows")


def inputs_of(frames: Sequence[Frame]) -> tuple[str, ...]:
    """The inputs that the frames have: the instruction, a picture per camera, the state."""
    if not frames:
        return ()
    return (INSTRUCTION, *(f"{PICTURE}.{name}" for name in (MAIN, *frames[0].observation.cameras)), STATE)


def _distance(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(first.astype(np.float64) - second.astype(np.float64)))
