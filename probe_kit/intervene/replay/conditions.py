"""Conditions: the ways in which one first inference is made again, and what each of them gives."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract.store.run import Run
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.edits.patching import LEDGER, Ledger
from probe_kit.intervene.replay.session import Bench, Chunk, Question
from probe_kit.intervene.store.answers import EXCHANGED, PLAIN
from probe_kit.intervene.store.settings import Asked


@dataclass
class Turn:
    """One question on the bench, with what its conditions share.

    memo: what one condition computed and another needs as well, by its name.
    """

    bench: Bench
    question: Question
    memo: dict[Any, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Played:
    """The actions (chunk, 7) of one inference, and what was changed in it, if anything.

    mass: (B, I, H, R) what attention was paid in it, if it was asked for; see `weighed.Weighed`.
    """

    chunk: Chunk
    ledger: Ledger | None = None
    mass: NDArray[np.float32] | None = None


class Condition(Protocol):
    """One way of making an inference again."""

    @property
    def name(self) -> str:
        """What tells it from the others of its intervention."""

    def play(self, turn: Turn) -> Played:
        """Make the inference."""


class Intervention(Asked, ABC):
    """What is asked, and the conditions that answer it."""

    @property
    def needs(self) -> tuple[InterventionKind, ...]:
        """What of the interventions a family must support for it."""
        return ("edit",)

    @property
    def learns(self) -> bool:
        """Whether items are inferred beforehand, for directions or erasers of their tokens."""
        return False

    def playable(self, bench: Bench, items: Sequence[str]) -> list[str]:
        """Those of the items' ids that it can be asked of; the others are passed over, and counted."""
        del bench
        return list(items)

    def play(self, bench: Bench, item: str, conditions: "Sequence[Condition]") -> "Replayed":
        """What the conditions give for the episodes of one item."""
        return replay(bench, bench.questions(item), conditions)

    def told(self, conditions: "Sequence[Condition]", found: "Replayed") -> dict[str, Any]:
        """What else its certificate says of its conditions and what they gave, as plain JSON."""
        del conditions, found
        return {}

    def files(self, run: Run, conditions: "Sequence[Condition]", found: "Replayed") -> dict[str, bytes]:
        """What else is stored, by the file's name."""
        del run, conditions, found
        return {}

    @abstractmethod
    def conditions(self, bench: Bench) -> Sequence[Condition]:
        """All of them, in the order in which they are stored; the first is `Plain`."""


@dataclass(frozen=True)
class Plain:
    """As the run made it."""

    name: str = PLAIN

    def play(self, turn: Turn) -> Played:
        """Nothing is changed."""
        return Played(turn.bench.act(turn.question.seen, turn.question.seed))


@dataclass(frozen=True)
class Exchanged:
    """The same state and noise before the same two pictures in each other's place."""

    name: str = EXCHANGED

    def play(self, turn: Turn) -> Played:
        """Only what is seen is another."""
        return Played(turn.bench.act(turn.question.exchanged, turn.question.seed))


Noted = tuple[int, int, NDArray[np.float32]]
"""The attention of one inference: row in the run's episodes, call, (B, I, H, R) shares."""


@dataclass(frozen=True)
class Replayed:
    """What K conditions gave for E episodes.

    rows: (E,) in the run's episodes. lateral: (K, E) metres, see `Bench.lateral`. changed: (K, E) the largest
    difference of any action from the plain one's. ledger: (K, E, 5) what was changed, see `patching.LEDGER`.
    apart: (E,) of the plain one from the stored one; NaN where the run does not say. outcomes: (K, E) where the
    cube ended, correct, wrong or oob, for episodes that were played to their end; then `lateral` is the cube's,
    and `changed` and `apart` are of the trajectory. None where nothing was carried out. mass: (N, B, I, H, R) the
    attention of N inferences, inferences: (N, 2) of which row and call they are; None where nobody asked for it.
    """

    rows: NDArray[np.int64]
    lateral: NDArray[np.float64]
    changed: NDArray[np.float64]
    ledger: NDArray[np.float64]
    apart: NDArray[np.float64]
    outcomes: NDArray[np.str_] | None = None
    mass: NDArray[np.float32] | None = None
    inferences: NDArray[np.int64] | None = None

    def with_mass(self, noted: "Sequence[Noted]") -> "Replayed":
        """With the attention of its inferences, if any was noted."""
        if not noted:
            return self
        rows, calls, masses = zip(*noted, strict=True)
        return replace(self, mass=np.stack(masses), inferences=np.stack([rows, calls], axis=1).astype(np.int64))

    @classmethod
    def none_yet(cls, questions: Sequence["Question"], conditions: Sequence["Condition"]) -> "Replayed":
        """Room for what is going to be played."""
        shape = len(conditions), len(questions)
        return cls(
            np.array([question.row for question in questions], np.int64),
            np.empty(shape),
            np.zeros(shape),
            np.zeros((*shape, len(LEDGER))),
            np.empty(len(questions)),
        )

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Those that are there, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def joined(cls, parts: Sequence["Replayed"]) -> "Replayed":
        """One after the other."""
        axes = {"lateral": 1, "changed": 1, "ledger": 1, "outcomes": 1}
        return cls(
            **{
                name: np.concatenate([getattr(part, name) for part in parts], axis=axes.get(name, 0))
                for name in parts[0].arrays
            }
        )


def replay(bench: Bench, questions: Sequence[Question], conditions: Sequence[Condition]) -> Replayed:
    """Play every condition on every question; the first one is the plain one."""
    found = Replayed.none_yet(questions, conditions)
    noted: list[Noted] = []
    for column, question in enumerate(questions):
        turn = Turn(bench, question)
        plain = conditions[0].play(turn).chunk
        found.apart[column] = bench.apart(question, plain)
        for number, condition in enumerate(conditions):
            played = condition.play(turn) if number else Played(plain)
            found.lateral[number, column] = bench.lateral(played.chunk, question.seen)
            found.changed[number, column] = float(np.abs(played.chunk - plain).max())
            if played.ledger is not None:
                found.ledger[number, column] = played.ledger.row()
            noted += [] if played.mass is None else [(question.row, 0, played.mass)]
    return found.with_mass(noted)
