"""Pairs of observations that differ in one input only: a clean one, a donor, and a control."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.plan import Row
from probe_kit.extract.sources.player import Opens
from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite.pictures import through_jpeg

INSTRUCTION, STATE, PICTURE, MAIN = "instruction", "state", "picture.", "main"
"""Inputs that vary; `picture.main` is `Observation.image`, other cameras have their names."""
STATE_SHARE = 0.01
"""The share of its spread over frames by which a control moves a state."""


@dataclass(frozen=True)
class Frame:
    """The first observation of a row."""

    row: Row
    seen: Observation


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
            seen = player.answer("begin", (row, False))
            assert isinstance(seen, Observation)
            pictures = {name: np.array(picture) for name, picture in seen.cameras.items()}
            copied = replace(seen, image=np.array(seen.image), state=np.array(seen.state), cameras=pictures)
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
    spread = np.ptp([frame.seen.state for frame in frames], axis=0)
    count = 0
    for frame in frames:
        others = [other for other in frames if other.row.columns["group_id"] != frame.row.columns["group_id"]]
        others = [other for other in others if not _equal(frame.seen, other.seen, vary)]
        if not others:
            continue
        count += 1
        if vary.startswith(PICTURE):
            donor = min(others, key=lambda other: _distance(frame.seen.state, other.seen.state))
        else:
            donor = others[int(rng.integers(len(others)))]
        yield Pair(
            vary, frame.row, donor.row, frame.seen, _with_input(frame.seen, vary, donor.seen),
            _control(frame.seen, vary, spread), frame.row.policy_seed,
        )  # fmt: skip
    if not count:
        raise UsageError(f"{vary} is the same in all {len(frames)} frames of different groups; choose more rows")


def inputs_of(frames: Sequence[Frame]) -> tuple[str, ...]:
    """The inputs that the frames have: the instruction, a picture per camera, the state."""
    if not frames:
        return ()
    return (INSTRUCTION, f"{PICTURE}{MAIN}", *(PICTURE + name for name in frames[0].seen.cameras), STATE)


def _equal(one: Observation, other: Observation, vary: str) -> bool:
    if vary == INSTRUCTION:
        return one.instruction == other.instruction
    return np.array_equal(_array(one, vary), _array(other, vary))


def _array(seen: Observation, vary: str) -> NDArray[Any]:
    if vary == STATE:
        return seen.state
    name = vary.removeprefix(PICTURE)
    return seen.image if name == MAIN else seen.cameras[name]


def _with_input(seen: Observation, vary: str, donor: Observation) -> Observation:
    return (
        replace(seen, instruction=donor.instruction)
        if vary == INSTRUCTION
        else _with(seen, vary, _array(donor, vary))
    )


def _with(seen: Observation, vary: str, values: NDArray[Any]) -> Observation:
    if vary == STATE:
        return replace(seen, state=values)
    name = vary.removeprefix(PICTURE)
    return replace(seen, image=values) if name == MAIN else replace(seen, cameras={**seen.cameras, name: values})


def _control(seen: Observation, vary: str, spread: NDArray[np.float32]) -> Observation:
    """The same input after a change that means nothing: full stop, JPEG round trip, a hundredth of the spread."""
    if vary == INSTRUCTION:
        text = seen.instruction
        return replace(seen, instruction=text[:-1] if text.endswith(".") else f"{text}.")
    if vary == STATE:
        return replace(seen, state=(seen.state + STATE_SHARE * spread).astype(np.float32))
    return _with(seen, vary, through_jpeg(_array(seen, vary)))


def _distance(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(one.astype(np.float64) - other.astype(np.float64)))
