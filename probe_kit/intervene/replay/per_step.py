"""Shadow: the episode goes on as it was, and at every call each condition is evaluated and not carried out.

Where one inference is one action in greedy bins, the first one says little of where the hand will go. Here every
condition meets every state of the unedited episode, and what its actions would add across is summed up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract.rollout.stage import Answer, Ending
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.edits.patching import Ledger
from probe_kit.intervene.replay.conditions import Condition, Noted, Replayed, Turn
from probe_kit.intervene.replay.rollout import Carried, apart_from_stored, executed, planned_of
from probe_kit.intervene.replay.session import Bench, Chunk, Question


@dataclass(frozen=True)
class _Evaluated:
    """K conditions along one episode. lateral, changed: (K,). ledger: (K, 5). plain: how the episode went.

    noted: what attention was asked for, a call each.
    """

    lateral: NDArray[np.float64]
    changed: NDArray[np.float64]
    ledger: NDArray[np.float64]
    plain: Carried
    noted: list[Noted]


def shadowed(bench: Bench, questions: Sequence[Question], conditions: Sequence[Condition]) -> Replayed:
    """Every condition along every episode; the first one, which changes nothing, is carried out.

    `lateral` is where the hand began plus what all calls' actions would add across, in metres from the middle,
    left positive. Raises CaptureChangedActionError if an outcome is not the stored one.
    """
    found = Replayed.none_yet(questions, conditions)
    noted: list[Noted] = []
    for column, question in enumerate(questions):
        own = _evaluated(bench, question, conditions)
        found.apart[column] = apart_from_stored(bench, question, own.plain)
        found.lateral[:, column], found.changed[:, column] = own.lateral, own.changed
        found.ledger[:, column] = own.ledger
        noted += own.noted
    return found.with_mass(noted)


def _evaluated(bench: Bench, question: Question, conditions: Sequence[Condition]) -> _Evaluated:
    stage, planned = bench.stage, planned_of(bench, question)
    seen: Answer = stage.begin(planned, False)
    assert isinstance(seen, Observation)
    lateral = np.full(len(conditions), bench.across(seen.state[:2].astype(np.float64)))
    changed, past = np.zeros(len(conditions)), list[Chunk]()
    ledgers: list[list[Ledger]] = [[] for _ in conditions]
    noted: list[Noted] = []
    for call in count():
        assert isinstance(seen, Observation)
        other = stage.look_exchanged().observation
        seed = derive_seed(planned.policy_seed, "inference", call)
        turn = Turn(bench, replace(question, seen=seen, exchanged=other, seed=seed, tiles=stage.tile_masks()))
        plain = conditions[0].play(turn)
        for number, condition in enumerate(conditions):
            played = condition.play(turn) if number else plain
            lateral[number] += _added(bench, executed(bench, [*past, played.chunk]), seen)
            changed[number] = max(changed[number], float(np.abs(played.chunk - plain.chunk).max()))
            ledgers[number] += [] if played.ledger is None else [played.ledger]
            noted += [] if played.mass is None else [(question.row, call, played.mass)]
        past.append(plain.chunk)
        seen = stage.advance(executed(bench, past))
        if isinstance(seen, Ending):
            break
    assert isinstance(seen, Ending)
    assert seen.trajectory is not None
    where = float(seen.outcome["cube_x"]), float(seen.outcome["cube_y"])
    carried = Carried(str(seen.outcome["outcome"]), where, seen.trajectory, Ledger.sum(ledgers[0]))
    rows = np.array([Ledger.sum(one).row() for one in ledgers])
    return _Evaluated(lateral, changed, rows, carried, noted)


def _added(bench: Bench, actions: Chunk, seen: Observation) -> float:
    """How far the actions would move the hand across, in metres; left is positive."""
    return bench.lateral(actions, seen) - bench.across(seen.state[:2].astype(np.float64))
