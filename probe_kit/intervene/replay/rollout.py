"""Playing episodes again under conditions, step by step, beside the same state with its pictures exchanged."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from math import nan

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureChangedActionError, NoTrajectoryError
from probe_kit.extract.plan import PlannedEpisode
from probe_kit.extract.rollout.action_ensemble import ensemble
from probe_kit.extract.rollout.stage import Answer, Ending
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.edits.patching import Ledger
from probe_kit.intervene.replay.conditions import Condition, Replayed, Turn
from probe_kit.intervene.replay.session import Bench, Chunk, Question
from probe_kit.suite.items import Episode


@dataclass(frozen=True)
class Carried:
    """One episode to its end. outcome: correct, wrong or oob. frames: (T + 1, C) as in `env.trajectory`."""

    outcome: str
    cube: tuple[float, float]
    frames: NDArray[np.float32]
    ledger: Ledger


def play(bench: Bench, questions: Sequence[Question], conditions: Sequence[Condition]) -> Replayed:
    """Play every episode under every condition; the first one, which changes nothing, is what the run has.

    `changed` is the largest difference of any number of the trajectory from the first condition's, `apart` that of
    the first condition's from the stored one's. Raises CaptureChangedActionError if an outcome is not the stored
    one.
    """
    outcomes = np.zeros((len(conditions), len(questions)), "U7")
    found = replace(Replayed.none_yet(questions, conditions), outcomes=outcomes)
    for column, question in enumerate(questions):
        plain = carry_out(bench, question, conditions[0], exchanging=False)
        found.apart[column] = apart_from_stored(bench, question, plain)
        for number, condition in enumerate(conditions):
            carried = carry_out(bench, question, condition) if number else plain
            found.lateral[number, column] = bench.across(np.array(carried.cube))
            found.changed[number, column] = _largest(carried.frames, plain.frames)
            found.ledger[number, column] = carried.ledger.row()
            outcomes[number, column] = carried.outcome
    return found


def carry_out(bench: Bench, question: Question, condition: Condition, exchanging: bool = True) -> Carried:
    """One episode under a condition that is in force at every inference.

    exchanging: whether the condition looks at exchanged pictures; they are then drawn at every inference.
    """
    stage, planned = bench.stage, planned_of(bench, question)
    seen: Answer = stage.begin(planned, False)
    past: list[Chunk] = []
    ledgers = []
    for call in count():
        assert isinstance(seen, Observation)
        other = stage.look_exchanged().observation if exchanging else seen
        seed = derive_seed(planned.policy_seed, "inference", call)
        here = replace(question, seen=seen, exchanged=other, seed=seed, tiles=stage.tile_masks())
        played = condition.play(Turn(bench, here))
        ledgers += [] if played.ledger is None else [played.ledger]
        past.append(played.chunk)
        seen = stage.advance(executed(bench, past))
        if isinstance(seen, Ending):
            break
    assert isinstance(seen, Ending)
    assert seen.trajectory is not None
    outcome = seen.outcome
    where = float(outcome["cube_x"]), float(outcome["cube_y"])
    return Carried(str(outcome["outcome"]), where, seen.trajectory, Ledger.sum(ledgers))


def planned_of(bench: Bench, question: Question) -> PlannedEpisode:
    """The episode as the run planned it."""
    record = bench.run.episodes.iloc[question.row]
    item = replace(bench.items[question.item_id], instruction=question.seen.instruction)
    seeds = int(record["scene_seed"]), int(record["policy_seed"])
    return PlannedEpisode(0, Episode(item, question.layout), *seeds)


def executed(bench: Bench, past: Sequence[Chunk]) -> Chunk:
    """As in the run: the head of the newest chunk, or one action averaged over all."""
    exponent = bench.policy.card.ensemble
    return past[-1][: int(bench.run.settings["execute"])] if exponent is None else ensemble(past, exponent)[None]


def apart_from_stored(bench: Bench, question: Question, plain: Carried) -> float:
    """By how much the episode differs from the stored one; NaN where the run keeps no trajectory.

    Raises CaptureChangedActionError for another outcome.
    """
    stored = str(bench.run.episodes.iloc[question.row]["outcome"])
    if stored != plain.outcome:
        raise CaptureChangedActionError(
            f"{question.episode_id}, played again with nothing changed, ended {plain.outcome}; the run has "
            f"{stored}. A closed loop is held against the run's own outcomes, so that all must repeat: extract "
            "with --batch 1 on this machine (larger batches and other devices round otherwise), then intervene on "
            "that run"
        )
    try:
        frames = bench.run.trajectory(question.row).frames
    except NoTrajectoryError:
        return nan
    return _largest(plain.frames, frames)


def _largest(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Largest difference over the frames that both have; 0 only if they are the same bit for bit."""
    if np.array_equal(one, other, equal_nan=True):
        return 0.0
    both = min(len(one), len(other))
    apart = np.abs(one[:both].astype(np.float64) - other[:both])
    return max(float(np.nanmax(apart)), float(np.finfo(np.float32).tiny))
