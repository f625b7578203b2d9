"""Conditions: the ways in which one first inference is made again, and what each of them gives."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.capturing.edit_engine import LOG_FIELDS, EditLog
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.replay.session import Chunk, ReplayInput, ReplaySession
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP
from probe_kit.intervene.store.settings import InterventionSettings
from probe_kit.runs.run import Run


@dataclass
class ConditionContext:
    """One question on the bench, with what its conditions share.

    memo: what one condition computed and another needs as well, by its name. clean: (chunk, 7) of the first
    condition, empty before that was played.
    """

    session: ReplaySession
    replay_input: ReplayInput
    memo: dict[Any, Any] = field(default_factory=dict)
    clean: Chunk = field(default_factory=lambda: np.zeros((0, 7), np.float32))


@dataclass(frozen=True)
class ConditionResult:
    """The actions (chunk, 7) of one inference, and what was changed in it, if anything.

    mass: (B, I, H, R) the attention shares of it, if recorded; see `AttentionShares`. estimated: metres of lateral
    displacement that an estimate adds to the chunk's, without an inference that makes them.
    """

    chunk: Chunk
    edit_log: EditLog | None = None
    mass: NDArray[np.float32] | None = None
    estimated: float = 0.0


class Condition(Protocol):
    """One way of making an inference again."""

    @property
    def name(self) -> str:
        """What tells it from the others of its intervention."""

    def play(self, context: ConditionContext) -> ConditionResult:
        """Make the inference."""


class Intervention(InterventionSettings, ABC):
    """What is asked, and the conditions that answer it."""

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """What of the interventions a family must support for it."""
        return ("edit",)

    @property
    def fits_first(self) -> bool:
        """Whether items are inferred beforehand, for directions or erasers of their tokens."""
        return False

    def eligible_items(self, session: ReplaySession, items: Sequence[str]) -> list[str]:
        """Those of the items' ids that it can be asked of; the others are passed over, and counted."""
        del session
        return list(items)

    def play(self, session: ReplaySession, item: str, conditions: "Sequence[Condition]") -> "ReplayBatch":
        """What the conditions give for the episodes of one item."""
        return replay(session, session.replay_inputs(item), conditions)

    def certificate_entries(self, conditions: "Sequence[Condition]", found: "ReplayBatch") -> dict[str, Any]:
        """What else its certificate says of its conditions and what they gave, as plain JSON."""
        del conditions, found
        return {}

    def extra_files(self, run: Run, conditions: "Sequence[Condition]", found: "ReplayBatch") -> dict[str, bytes]:
        """What else is stored, by the file's name."""
        del run, conditions, found
        return {}

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """As the command builds it. options: of the command, those that are given. Raises UsageError."""
        del run
        return cls(**options)

    @abstractmethod
    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """All of them, in the order in which they are stored; the first is `CleanRun`."""


@dataclass(frozen=True)
class CleanRun:
    """As the run made it."""

    name: str = CLEAN

    def play(self, context: ConditionContext) -> ConditionResult:
        """Nothing is changed."""
        return ConditionResult(context.session.act(context.replay_input.seen, context.replay_input.seed))


@dataclass(frozen=True)
class ImagesSwapped:
    """The same state and noise before the same two pictures in each other's place."""

    name: str = IMAGE_SWAP

    def play(self, context: ConditionContext) -> ConditionResult:
        """Only what is seen is another."""
        return ConditionResult(context.session.act(context.replay_input.swapped, context.replay_input.seed))


AttentionRecord = tuple[int, int, NDArray[np.float32]]
"""The attention of one inference: row in the run's episodes, call, (B, I, H, R) shares."""


@dataclass(frozen=True)
class ReplayBatch:
    """What K conditions gave for E episodes.

    rows: (E,) in the run's episodes. displacement: (K, E) metres, see `ReplaySession.lateral_displacement`.
    max_action_change: (K, E) the largest difference of any action from the clean one's. edit_log: (K, E, 5) see
    `LOG_FIELDS`. replay_error: (E,) of the clean inference from the stored one; NaN where the
    run does not say. episode_outcomes: (K, E) where the cube ended, correct, wrong or oob, for episodes that were
    played to their end; then `displacement` is the cube's, and `max_action_change` and `replay_error` are of the
    trajectory; None where nothing was executed. mass: (N, B, I, H, R) the attention of N inferences, inferences:
    (N, 2) their rows and calls; None where attention was not recorded.
    """

    rows: NDArray[np.int64]
    displacement: NDArray[np.float64]
    max_action_change: NDArray[np.float64]
    edit_log: NDArray[np.float64]
    replay_error: NDArray[np.float64]
    episode_outcomes: NDArray[np.str_] | None = None
    mass: NDArray[np.float32] | None = None
    inferences: NDArray[np.int64] | None = None

    def with_mass(self, attention_records: "Sequence[AttentionRecord]") -> "ReplayBatch":
        """With the attention of its inferences, if any was recorded."""
        if not attention_records:
            return self
        rows, calls, masses = zip(*attention_records, strict=True)
        return replace(self, mass=np.stack(masses), inferences=np.stack([rows, calls], axis=1).astype(np.int64))

    @classmethod
    def none_yet(cls, replay_inputs: Sequence["ReplayInput"], conditions: Sequence["Condition"]) -> "ReplayBatch":
        """Room for what is going to be played."""
        shape = len(conditions), len(replay_inputs)
        return cls(
            np.array([replay_input.row for replay_input in replay_inputs], np.int64),
            np.empty(shape),
            np.zeros(shape),
            np.zeros((*shape, len(LOG_FIELDS))),
            np.empty(len(replay_inputs)),
        )

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Those that are there, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def joined(cls, parts: Sequence["ReplayBatch"]) -> "ReplayBatch":
        """One after the other."""
        axes = {"displacement": 1, "max_action_change": 1, "edit_log": 1, "episode_outcomes": 1}
        return cls(
            **{
                name: np.concatenate([getattr(part, name) for part in parts], axis=axes.get(name, 0))
                for name in parts[0].arrays
            }
        )


def replay(
    session: ReplaySession, replay_inputs: Sequence[ReplayInput], conditions: Sequence[Condition]
) -> ReplayBatch:
    """Play every condition on every question; the first one is the clean one."""
    found = ReplayBatch.none_yet(replay_inputs, conditions)
    attention_records: list[AttentionRecord] = []
    for column, replay_input in enumerate(replay_inputs):
        context = ConditionContext(session, replay_input)
        plain = context.clean = conditions[0].play(context).chunk
        found.replay_error[column] = session.replay_error(replay_input, plain)
        for number, condition in enumerate(conditions):
            played = condition.play(context) if number else ConditionResult(plain)
            moved = session.lateral_displacement(played.chunk, replay_input.seen) + played.estimated
            found.displacement[number, column] = moved
            found.max_action_change[number, column] = float(np.abs(played.chunk - plain).max())
            if played.edit_log is not None:
                found.edit_log[number, column] = played.edit_log.row()
            attention_records += [] if played.mass is None else [(replay_input.row, 0, played.mass)]
    return found.with_mass(attention_records)
