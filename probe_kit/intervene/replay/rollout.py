"""Playing episodes again under conditions, step by step, with the same state and swapped images as source."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from math import nan

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureChangedActionError, NoTrajectoryError
from probe_kit.extract.plan import PlannedEpisode
from probe_kit.extract.rollout.executed_actions import executed_actions
from probe_kit.extract.rollout.stage import Answer, Ending
from probe_kit.hashing import derive_seed
from probe_kit.hooks.capturing.edit_engine import EditLog
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.protocol import PLAIN
from probe_kit.intervene.replay.conditions import Condition, ConditionContext, ReplayBatch
from probe_kit.intervene.replay.session import Chunk, ReplayInput, ReplaySession
from probe_kit.suite.items import Episode


@dataclass(frozen=True)
class RolloutResult:
    """One episode to its end. outcome: correct, wrong or oob. frames: (T + 1, C) as in `env.trajectory`."""

    outcome: str
    cube: tuple[float, float]
    frames: NDArray[np.float32]
    edit_log: EditLog


def play(
    session: ReplaySession, replay_inputs: Sequence[ReplayInput], conditions: Sequence[Condition]
) -> ReplayBatch:
    """Play every episode under every condition; the first one, which changes nothing, is what the run has.

    `changed` is the largest difference of any number of the trajectory from the first condition's, `apart` that of
    the first condition's from the stored one's. Raises CaptureChangedActionError if an outcome is not the stored
    one.
    """
    episode_outcomes = np.zeros((len(conditions), len(replay_inputs)), "U7")
    found = replace(ReplayBatch.none_yet(replay_inputs, conditions), episode_outcomes=episode_outcomes)
    for column, replay_input in enumerate(replay_inputs):
        plain = roll_out(session, replay_input, conditions[0], swapping=False)
        found.replay_error[column] = apart_from_stored(session, replay_input, plain)
        for number, condition in enumerate(conditions):
            carried = roll_out(session, replay_input, condition) if number else plain
            found.displacement[number, column] = session.lateral_offset(np.array(carried.cube))
            found.max_action_change[number, column] = _largest(carried.frames, plain.frames)
            found.edit_log[number, column] = carried.edit_log.row()
            episode_outcomes[number, column] = carried.outcome
    return found


def roll_out(
    session: ReplaySession, replay_input: ReplayInput, condition: Condition, swapping: bool = True
) -> RolloutResult:
    """One episode under a condition that is in force at every inference.

    swapping: whether the condition looks at swapped images; they are then drawn at every inference.
    """
    stage, planned = session.stage, planned_of(session, replay_input)
    seen: Answer = stage.begin(planned, False)
    past: list[Chunk] = []
    edit_logs = []
    for call in count():
        assert isinstance(seen, Observation)
        other = stage.look_swapped().observation if swapping else seen
        seed = derive_seed(planned.policy_seed, "inference", call)
        here = replace(replay_input, seen=seen, swapped=other, seed=seed, tiles=stage.tile_masks())
        played = condition.play(ConditionContext(session, here))
        edit_logs += [] if played.edit_log is None else [played.edit_log]
        past.append(played.chunk)
        seen = stage.advance(executed(session, past))
        if isinstance(seen, Ending):
            break
    assert isinstance(seen, Ending)
    assert seen.trajectory is not None
    outcome = seen.outcome
    where = float(outcome["cube_x"]), float(outcome["cube_y"])
    return RolloutResult(str(outcome["outcome"]), where, seen.trajectory, EditLog.sum(edit_logs))


def planned_of(session: ReplaySession, replay_input: ReplayInput) -> PlannedEpisode:
    """The episode as the run planned it."""
    record = session.run.episodes.iloc[replay_input.row]
    item = replace(session.items[replay_input.item_id], instruction=replay_input.seen.instruction)
    seeds = int(record["scene_seed"]), int(record["policy_seed"])
    return PlannedEpisode(0, Episode(item, replay_input.layout), *seeds)


def executed(session: ReplaySession, past: Sequence[Chunk]) -> Chunk:
    """As in the run: the head of the newest chunk, or one action averaged over all, with the run's rotation."""
    settings, exponent = session.run.settings, session.policy.card.ensemble
    return executed_actions(past, int(settings["execute"]), exponent, settings.get("rotation", PLAIN))


def apart_from_stored(session: ReplaySession, replay_input: ReplayInput, plain: RolloutResult) -> float:
    """By how much the episode differs from the stored one; NaN where the run keeps no trajectory.

    Raises CaptureChangedActionError for another outcome.
    """
    stored = str(session.run.episodes.iloc[replay_input.row]["outcome"])
    if stored != plain.outcome:
        raise CaptureChangedActionError(
            f"{replay_input.episode_id}, played again with nothing changed, ended {plain.outcome}; the run has "
            f"{stored}. A closed loop is compared with the run's own outcomes, so that all must repeat: extract "
            "with --batch 1 on this machine (larger batches and other devices round otherwise), then intervene on "
            "that run"
        )
    try:
        frames = session.run.trajectory(replay_input.row).frames
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
