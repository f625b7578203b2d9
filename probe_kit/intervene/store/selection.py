"""Which of a run's stored interventions stands for what: by what each is about, never by when it was made.

Another map, role, direction, dose, or a try on fewer episodes takes nothing's place. Conditions that were played
on the same episodes stand side by side, whichever intervention they came with. Reads what is stored; needs no
model.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from probe_kit.intervene.store.answers import EXCHANGED, PLAIN, UNCHANGED, Answers, Stored, stored_interventions
from probe_kit.intervene.store.settings import CHUNK, SHADOW
from probe_kit.train.data.run_reader import RunReader

Rank = tuple[bool, int, bool]


@dataclass(frozen=True)
class Told:
    """What one stored intervention says of one category. answers: of its episodes alone.

    own_readout: whether it was read as its family says it should be. misread: whether it was not, and the family
    is one whose first inference says little (`shadow`).
    """

    stored: Stored
    category: str
    answers: Answers
    own_readout: bool
    misread: bool

    @classmethod
    def all_of(cls, stored: Stored) -> "list[Told]":
        """One per category. Raises RunDamagedError if it was changed."""
        readout = stored.settings.get("readout", CHUNK)
        family = stored.certificate().get("supported", {}).get("readout", CHUNK)
        return [
            cls(stored, category, answers, readout == family, family == SHADOW != readout)
            for category, answers in stored.answers().by_category()
        ]

    @property
    def rank(self) -> Rank:
        """The larger, the more it says: rightly read, then of more episodes."""
        return not self.misread, self.answers.episodes.size, self.own_readout

    @property
    def made(self) -> tuple[str, str]:
        """When; decides between what says as much."""
        return self.stored.created, self.stored.key


def told_of(run: RunReader, kind: str) -> list[Told]:
    """By category as the run has them; of each what says most last, and of what says as much the newest.

    Raises RunDamagedError.
    """
    order = {name: at for at, name in enumerate(dict.fromkeys(run.episodes["category"].astype(str)))}
    every = [own for stored in stored_interventions(run, kind) for own in Told.all_of(stored)]
    return sorted(every, key=lambda own: (order.get(own.category, len(order)), own.category, own.rank, own.made))


def foremost(run: RunReader, kind: str) -> dict[str, Told]:
    """By category, of all that is stored of a kind the one that says most. Raises RunDamagedError."""
    return {own.category: own for own in told_of(run, kind)}


@dataclass(frozen=True)
class Joined:
    """Conditions that several interventions played on the same episodes of one category.

    like: one of them. sources: by condition, of whom it is; without those in which nothing was changed.
    """

    like: Told
    sources: dict[str, Told]

    def answers(self, conditions: Sequence[str]) -> Answers:
        """Some of the conditions, in the order that is asked for, behind what was unchanged."""
        base = self.like.answers
        unchanged = [name for name in (PLAIN, EXCHANGED) if name in base.conditions]
        every = [(base, name) for name in unchanged] + [(self.sources[own].answers, own) for own in conditions]
        rows = [(own, own.conditions.index(name)) for own, name in every]
        return replace(
            base,
            conditions=tuple(name for _, name in every),
            lateral=np.stack([own.lateral[row] for own, row in rows]),
            changed=np.stack([own.changed[row] for own, row in rows]),
            ledger=np.stack([own.ledger[row] for own, row in rows]),
        )


def joined(told: Iterable[Told], setting: Sequence[str] = ()) -> list[Joined]:
    """What was played on the same episodes, with the same actions where nothing was changed, together.

    told: as `told_of` orders them. setting: names of settings in which they must agree as well.
    """
    found: dict[tuple[object, ...], Joined] = {}
    for own in told:
        answers = own.answers
        agreed = tuple(str(own.stored.settings.get(name)) for name in ("readout", *setting))
        unchanged = [answers.of(name).tobytes() for name in (PLAIN, EXCHANGED) if name in answers.conditions]
        same = (own.category, *agreed, tuple(answers.episodes.tolist()), *unchanged)
        sources = found.setdefault(same, Joined(own, {})).sources
        sources.update({name: own for name in answers.conditions if name not in UNCHANGED})
    return list(found.values())
