"""Per-step readout, teacher-forced: every condition is evaluated at every call of the unedited episode.

Where one inference is one action in greedy bins, the first one says little of where the hand will go. Here every
condition gets every state of the unedited episode, and the lateral displacements of its actions are summed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract.rollout.stage import Answer, Ending
from probe_kit.hashing import derive_seed
from probe_kit.hooks.capturing.edit_engine import EditLog
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.replay.conditions import AttentionRecord, Condition, ConditionContext, ReplayBatch
from probe_kit.intervene.replay.rollout import RolloutResult, apart_from_stored, executed, planned_of
from probe_kit.intervene.replay.session import Chunk, ReplayInput, ReplaySession


@dataclass(frozen=True)
class _Evaluated:
    """K conditions along one episode. displacement, max_action_change: (K,). edit_log: (K, 5).

    plain: how the episode went. attention_records: one per call, if attention was recorded.
    """

    displacement: NDArray[np.float64]
    max_action_change: NDArray[np.float64]
    edit_log: NDArray[np.float64]
    plain: RolloutResult
    attention_records: list[AttentionRecord]


def evaluate_per_step(
    session: ReplaySession, replay_inputs: Sequence[ReplayInput], conditions: Sequence[Condition]
) -> ReplayBatch:
    """Every condition along every episode; the first one, which edits nothing, is executed.

    `displacement` is where the hand began plus what the actions of all calls would add laterally, in metres from
    the middle, left positive. Raises CaptureChangedActionError if an outcome is not the stored one.
    """
    found = ReplayBatch.none_yet(replay_inputs, conditions)
    attention_records: list[AttentionRecord] = []
    for column, replay_input in enumerate(replay_inputs):
        own = _evaluated(session, replay_input, conditions)
        found.replay_error[column] = apart_from_stored(session, replay_input, own.plain)
        found.displacement[:, column], found.max_action_change[:, column] = own.displacement, own.max_action_change
        found.edit_log[:, column] = own.edit_log
        attention_records += own.attention_records
    return found.with_mass(attention_records)


def _evaluated(session: ReplaySession, replay_input: ReplayInput, conditions: Sequence[Condition]) -> _Evaluated:
    stage, planned = session.stage, planned_of(session, replay_input)
    seen: Answer = stage.begin(planned, False)
    assert isinstance(seen, Observation)
    displacement = np.full(len(conditions), session.lateral_offset(seen.state[:2].astype(np.float64)))
    changed, past = np.zeros(len(conditions)), list[Chunk]()
    edit_logs: list[list[EditLog]] = [[] for _ in conditions]
    attention_records: list[AttentionRecord] = []
    for call in count():
        assert isinstance(seen, Observation)
        other = stage.look_swapped().observation
        seed = derive_seed(planned.policy_seed, "inference", call)
        context = ConditionContext(
            session, replace(replay_input, seen=seen, swapped=other, seed=seed, tiles=stage.tile_masks())
        )
        plain = conditions[0].play(context)
        for number, condition in enumerate(conditions):
            played = condition.play(context) if number else plain
            displacement[number] += _lateral_change(session, executed(session, [*past, played.chunk]), seen)
            changed[number] = max(changed[number], float(np.abs(played.chunk - plain.chunk).max()))
            edit_logs[number] += [] if played.edit_log is None else [played.edit_log]
            attention_records += [] if played.mass is None else [(replay_input.row, call, played.mass)]
        past.append(plain.chunk)
        seen = stage.advance(executed(session, past))
        if isinstance(seen, Ending):
            break
    assert isinstance(seen, Ending)
    assert seen.trajectory is not None
    where = float(seen.outcome["cube_x"]), float(seen.outcome["cube_y"])
    carried = RolloutResult(str(seen.outcome["outcome"]), where, seen.trajectory, EditLog.sum(edit_logs[0]))
    rows = np.array([EditLog.sum(one).row() for one in edit_logs])
    return _Evaluated(displacement, changed, rows, carried, attention_records)


def _lateral_change(session: ReplaySession, actions: Chunk, seen: Observation) -> float:
    """How far the actions would move the hand across, in metres; left is positive."""
    return session.lateral_displacement(actions, seen) - session.lateral_offset(seen.state[:2].astype(np.float64))
