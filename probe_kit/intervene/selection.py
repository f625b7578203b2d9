"""The choice among a run's stored interventions: by what each is about, never by when it was made.

Another map, role, direction, coefficient, or a try on fewer episodes replaces nothing. Conditions that were played
on the same episodes are pooled, whichever intervention they came with. Reads what is stored; needs no model.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probe_kit.intervene.outcomes import (
    BY_CONDITION,
    CLEAN,
    IMAGE_SWAP,
    UNCHANGED,
    ConditionOutcomes,
    StoredIntervention,
    stored_interventions,
)
from probe_kit.intervene.settings import FIRST_CHUNK, PER_STEP
from probe_kit.runs.reader import RunReader

Rank = tuple[bool, int, bool]


@dataclass(frozen=True)
class StoredResult:
    """The part of one stored intervention that is of one category. outcomes: of its episodes alone.

    own_readout: whether it was read as its family says it should be. wrong_readout: whether it was not, and the
    family is one whose first inference says little (`per-step`).
    """

    stored: StoredIntervention
    category: str
    outcomes: ConditionOutcomes
    own_readout: bool
    wrong_readout: bool

    @classmethod
    def all_of(cls, stored: StoredIntervention) -> "list[StoredResult]":
        """One per category. Raises RunDamagedError if it was changed."""
        readout = stored.settings.get("readout", FIRST_CHUNK)
        family = stored.certificate().get("supported", {}).get("readout", FIRST_CHUNK)
        return [
            cls(stored, category, outcomes, readout == family, family == PER_STEP != readout)
            for category, outcomes in stored.outcomes().by_category()
        ]

    @property
    def readout(self) -> str:
        """`first-chunk` or `per-step`."""
        return str(self.stored.settings.get("readout", FIRST_CHUNK))

    @property
    def rank(self) -> Rank:
        """The larger, the more it says: rightly read, then of more episodes."""
        return not self.wrong_readout, self.outcomes.episodes.size, self.own_readout

    @property
    def newest(self) -> tuple[str, str]:
        """Return the time, which decides between what says as much."""
        return self.stored.created, self.stored.key


def stored_results(run: RunReader, kind: str) -> list[StoredResult]:
    """Return results by category as the run has them; of each what says most comes last.

    Of what says as much the newest. Raises RunDamagedError.
    """
    order = {name: at for at, name in enumerate(dict.fromkeys(run.episodes["category"].astype(str)))}
    every = [result for stored in stored_interventions(run, kind) for result in StoredResult.all_of(stored)]
    return sorted(
        every,
        key=lambda result: (order.get(result.category, len(order)), result.category, result.rank, result.newest),
    )


def preferred_by_category(run: RunReader, kind: str, readout: str | None = None) -> dict[str, StoredResult]:
    """Return by category, of all that is stored of a kind, the result that says most. Raises RunDamagedError.

    readout: of those alone; None for any.
    """
    results = stored_results(run, kind)
    return {result.category: result for result in results if readout in (None, result.readout)}


@dataclass(frozen=True)
class PooledConditions:
    """Conditions that several interventions played on the same episodes of one category.

    like: one of them. sources: by condition, of whom it is; without those in which nothing was changed.
    """

    like: StoredResult
    sources: dict[str, StoredResult]

    def outcomes(self, conditions: Sequence[str]) -> ConditionOutcomes:
        """Some of the conditions, in the order that is asked for, behind what was unchanged."""
        base = self.like.outcomes
        unchanged = [name for name in (CLEAN, IMAGE_SWAP) if name in base.conditions]
        every = [(base, name) for name in unchanged] + [(self.sources[name].outcomes, name) for name in conditions]
        rows = [(outcomes, outcomes.conditions.index(name)) for outcomes, name in every]
        stacked = {field: _stacked(field, rows) for field in BY_CONDITION}
        return replace(base, conditions=tuple(name for _, name in every), **stacked)


def _stacked(field: str, rows: Sequence[tuple[ConditionOutcomes, int]]) -> Any:
    """A field of the conditions in these rows, (K, …); None where any of them was stored without it."""
    values = [getattr(outcomes, field) for outcomes, _ in rows]
    if any(value is None for value in values):
        return None
    return np.stack([value[row] for value, (_, row) in zip(values, rows, strict=True)])


def pool_conditions(results: Iterable[StoredResult], setting: Sequence[str] = ()) -> list[PooledConditions]:
    """Pool what was played on the same episodes, with the same actions where nothing was changed.

    results: as `stored_results` orders them. setting: names of settings in which they must agree as well.
    """
    pooled: dict[tuple[object, ...], PooledConditions] = {}
    for result in results:
        outcomes = result.outcomes
        agreed = tuple(str(result.stored.settings.get(name)) for name in ("readout", *setting))
        unchanged = [outcomes.of(name).tobytes() for name in (CLEAN, IMAGE_SWAP) if name in outcomes.conditions]
        same = (result.category, *agreed, tuple(outcomes.episodes.tolist()), *unchanged)
        sources = pooled.setdefault(same, PooledConditions(result, {})).sources
        sources.update({name: result for name in outcomes.conditions if name not in UNCHANGED})
    return list(pooled.values())
