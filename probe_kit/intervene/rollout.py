"""Playing of episodes step by step: with an edit at every inference, or along the unedited episode.

The per-step readout is teacher-forced. Where one inference is one action in greedy bins, the first one carries
little information about where the hand will go. There every condition is evaluated at every state of the unedited
episode, and the lateral displacements of its actions are summed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureChangedActionError
from probe_kit.extract.rollout.controllers import executed_actions
from probe_kit.extract.sources.player import Answer, Ending
from probe_kit.hooks.capturing.edits import EditLog
from probe_kit.hooks.contract.declared import PLAIN
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.outcomes import ConditionOutcomes
from probe_kit.intervene.pairs import Chunk, Pair
from probe_kit.intervene.replay import (
    AttentionRecord,
    Condition,
    ConditionContext,
    count_tokens,
    room_for,
    with_attention,
)
from probe_kit.intervene.scene_session import SceneSession
from probe_kit.intervene.sessions import ReplaySession, largest_difference


@dataclass(frozen=True)
class RolloutResult:
    """One episode that was played to its end.

    Attributes:
        ending: End of the episode.
        actions: Executed actions (n, D) of every inference.
        edit_log: Log of all edits.
        token_counts: Numbers of cut and of other tokens at the first inference; None where no attention is cut.
    """

    ending: Ending
    actions: tuple[Chunk, ...]
    edit_log: EditLog
    token_counts: tuple[int, int] | None = None

    @property
    def outcome(self) -> str:
        """The zone where the cube ended, correct, wrong or oob; in an environment success or failure."""
        return str(self.ending.outcome["outcome"])

    @property
    def frames(self) -> NDArray[np.float32]:
        """The frames (T + 1, C) of the trajectory, as in `env.trajectory`; in an environment actions (T, D)."""
        return np.concatenate(self.actions) if self.ending.trajectory is None else self.ending.trajectory


def play_episodes(
    session: ReplaySession, pairs: Sequence[Pair], conditions: Sequence[Condition]
) -> ConditionOutcomes:
    """Play every episode under every condition; the first one changes nothing and repeats the run.

    `displacement` is where the cube ends, in an environment 1 for success and 0 without. `max_action_change` is
    the largest difference of any number of the trajectory, or of the actions, from the first condition's.
    `replay_error` is that of the first condition's from the stored one's.

    Raises:
        CaptureChangedActionError: If an outcome is not the stored one.
    """
    ends = np.zeros((len(conditions), len(pairs)), "U7")
    outcomes = replace(room_for(pairs, conditions), episode_outcomes=ends)
    counted: dict[tuple[int, int], tuple[int, int]] = {}
    for column, pair in enumerate(pairs):
        clean = roll_out(session, pair, conditions[0], swapping=False)
        outcomes.replay_error[column] = apart_from_stored(session, pair, clean)
        for number, condition in enumerate(conditions):
            played = roll_out(session, pair, condition) if number else clean
            outcomes.displacement[number, column] = session.end_position(played.ending)
            outcomes.max_action_change[number, column] = largest_difference(played.frames, clean.frames)
            outcomes.edit_log[number, column] = played.edit_log.row()
            ends[number, column] = played.outcome
            if played.token_counts is not None:
                counted[number, column] = played.token_counts
    return count_tokens(outcomes, counted)


def roll_out(session: ReplaySession, pair: Pair, condition: Condition, swapping: bool = True) -> RolloutResult:
    """Play one episode under a condition that applies at every inference.

    Args:
        session: Session of the run.
        pair: First pair of the episode.
        condition: Condition to play.
        swapping: Whether the condition needs swapped images; they are then drawn at every inference.
    """
    edit_logs: list[EditLog] = []
    counts: list[tuple[int, int]] = []

    def act(current: Pair, past: Sequence[Chunk]) -> Chunk:
        del past
        played = condition.play(ConditionContext(session, current))
        edit_logs.extend([] if played.edit_log is None else [played.edit_log])
        counts.extend([] if played.token_counts is None else [played.token_counts])
        return played.chunk

    stepped = _step_through(session, pair, act, swapping)
    return replace(stepped, edit_log=EditLog.sum(edit_logs), token_counts=next(iter(counts), None))


def evaluate_per_step(
    session: ReplaySession, pairs: Sequence[Pair], conditions: Sequence[Condition]
) -> ConditionOutcomes:
    """Evaluate every condition along every episode; the first one, which edits nothing, is executed.

    `displacement` is the start of the hand plus what the actions of all calls would add laterally, in metres from
    the middle, left positive.

    Raises:
        CaptureChangedActionError: If an outcome is not the stored one.
    """
    assert isinstance(session, SceneSession), "only the scene is played again; other runs are refused before"
    outcomes = room_for(pairs, conditions)
    attention_records: list[AttentionRecord] = []
    for column, pair in enumerate(pairs):
        _evaluate(session, pair, conditions, outcomes, column, attention_records)
    return with_attention(outcomes, attention_records)


def _evaluate(
    session: SceneSession,
    pair: Pair,
    conditions: Sequence[Condition],
    outcomes: ConditionOutcomes,
    column: int,
    attention_records: list[AttentionRecord],
) -> None:
    """Evaluate one episode and fill its column of the outcomes."""
    edit_logs: list[list[EditLog]] = [[] for _ in conditions]
    outcomes.displacement[:, column] = _offset(session, pair.clean)

    def act(current: Pair, past: Sequence[Chunk]) -> Chunk:
        context, start = ConditionContext(session, current), _offset(session, current.clean)
        clean = conditions[0].play(context)
        for number, condition in enumerate(conditions):
            played = condition.play(context) if number else clean
            actions = executed_chunk(session, [*past, played.chunk])
            outcomes.displacement[number, column] += session.displacement(actions, current) - start
            change = float(np.abs(played.chunk - clean.chunk).max())
            outcomes.max_action_change[number, column] = max(outcomes.max_action_change[number, column], change)
            edit_logs[number] += [] if played.edit_log is None else [played.edit_log]
            if played.mass is not None:
                attention_records.append((current.row, current.step, played.mass, played.patches))
        return clean.chunk

    outcomes.replay_error[column] = apart_from_stored(session, pair, _step_through(session, pair, act, True))
    outcomes.edit_log[:, column] = [EditLog.sum(logs).row() for logs in edit_logs]


def _step_through(
    session: ReplaySession, pair: Pair, act: Callable[[Pair, Sequence[Chunk]], Chunk], swapping: bool
) -> RolloutResult:
    """Play one episode with the chunks that `act` gives for every inference's pair and the chunks before."""
    player = session.player
    answer: Answer = player.answer("begin", (session.planned(pair), False))
    past: list[Chunk] = []
    actions: list[Chunk] = []
    for call in count():
        assert isinstance(answer, Observation)
        past.append(act(session.pair_at(pair, answer, call, swapping), past))
        actions.append(executed_chunk(session, past))
        answer = player.answer("advance", (actions[-1],))
        if isinstance(answer, Ending):
            break
    assert isinstance(answer, Ending)
    return RolloutResult(answer, tuple(actions), EditLog())


def _offset(session: SceneSession, observation: object) -> float:
    assert isinstance(observation, Observation)
    return session.lateral_offset(observation.state[:2].astype(np.float64))


def executed_chunk(session: ReplaySession, past: Sequence[Chunk]) -> Chunk:
    """Return the executed actions: the head of the newest chunk, or one averaged over all chunks."""
    settings, exponent = session.run.settings, session.policy.card.ensemble
    return executed_actions(past, int(settings["execute"]), exponent, settings.get("rotation", PLAIN))


def apart_from_stored(session: ReplaySession, pair: Pair, clean: RolloutResult) -> float:
    """Return by how much the episode differs from the stored one; NaN where the run keeps no trajectory.

    Raises:
        CaptureChangedActionError: For another outcome.
    """
    stored = str(session.run.episodes.iloc[pair.row]["outcome"])
    if stored != clean.outcome:
        raise CaptureChangedActionError(
            f"{pair.episode}, played again with nothing changed, ended {clean.outcome}; the run has "
            f"{stored}. A closed loop is compared with the run's own outcomes, so that all must repeat: extract "
            "with --batch 1 on this machine (larger batches and other devices round otherwise), then intervene on "
            "that run"
        )
    return session.trajectory_difference(pair, clean.ending, clean.actions)
