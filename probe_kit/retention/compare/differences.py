"""Runs, or groups of runs, against each other: what co-training, fine-tuning or training at all changed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from math import inf, isfinite
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour.paired_gains import gains_p
from probe_kit.retention.behaviour.success_rate import units_of
from probe_kit.retention.compare.common_items import CommonItems
from probe_kit.retention.estimators.stream_scores import (
    ACTION,
    BACKBONE,
    Limits,
    PooledScores,
    Rate,
    RowEstimates,
    limits,
)
from probe_kit.retention.rows.build import RowWithEstimates
from probe_kit.retention.rows.parts import Mode
from probe_kit.retention.rows.row import MEAN
from probe_kit.statistics.estimates.retention import Ratio, retention, retention_difference
from probe_kit.statistics.estimates.scores import Scores
from probe_kit.statistics.model_groups import exchange_p, is_exchangeable, welch_interval
from probe_kit.statistics.multiple_testing import corrected

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ModelTest:
    """Two groups of models compared with the model as the unit.

    n, n_minus: models of either group; runs of one origin are of one. difference: of the groups' means, with
    Welch's 95 % interval. p: exact and two-sided, of exchanging the models' labels, which tests equal
    distributions and not only equal means; smallest_p: the least that so few models allow. Both are None where the
    smaller group has the larger spread, see `is_exchangeable`.
    """

    n: int
    n_minus: int
    difference: float
    ci: Limits
    p: float | None
    smallest_p: float | None

    @classmethod
    def of(cls, first: Sequence[float], second: Sequence[float], largest: float = inf) -> "ModelTest | None":
        """From one value per model; None for two single models, or where one has no value.

        largest: the difference that no two groups can exceed, see `welch_interval`.
        """
        if len(first) + len(second) < 3 or not (first and second and all(map(isfinite, (*first, *second)))):
            return None
        gap, interval = float(np.mean(first) - np.mean(second)), limits(welch_interval(first, second, largest))
        if not is_exchangeable(first, second):
            return cls(len(first), len(second), gap, interval, None, None)
        test = exchange_p(first, second)
        return cls(len(first), len(second), gap, interval, test.p, test.smallest)


@dataclass(frozen=True)
class Difference:
    """`group` minus `minus` in one category and view, each the mean of its runs; 95 % intervals.

    group, minus: names of groups, or of single runs, whose locations are then `run` and `minus_run`. paired:
    whether both ran the same items, which then count as pairs. view: None where the two have no probed view in
    common. sr, backbone, action: success rate and cross-fitted accuracies. retention: None unless defined on
    both sides. p: of `sr`, exact, signs of whole groups of items flipped, in the row `mean` of all items at
    once; None unless paired. p_holm: over the categories of all pairs of the table, or over the pairs in rows
    `mean`. Intervals and p are of these models on other items. sr_models, retention_models: of other models,
    where a side is a group of several. call: the captured inference that both were probed at, None without
    probes or where they differ. mode: what the models of both did. n_items: items that all runs of both sides have
    and that the numbers are of; of_items: items that any of them has. None where that is not known. n_groups:
    independent groups of items whose signs `p` flips, None without a p. In a row of category `mean`, numbers are
    averages over the `categories` that both groups have.
    """

    group: str
    minus: str
    category: str
    view: str | None
    paired: bool
    sr: float | None = None
    sr_ci: Limits | None = None
    backbone: float | None = None
    backbone_ci: Limits | None = None
    action: float | None = None
    action_ci: Limits | None = None
    retention: float | None = None
    retention_ci: Limits | None = None
    sr_models: ModelTest | None = None
    retention_models: ModelTest | None = None
    call: int | None = None
    p: float | None = None
    p_holm: float | None = None
    run: str | None = None
    minus_run: str | None = None
    mode: Mode = "acts"
    categories: tuple[str, ...] = ()
    n_items: int | None = None
    of_items: int | None = None
    n_groups: int | None = None


@dataclass(frozen=True)
class Side:
    """One side of a comparison: what it is called, the rows of its runs, and where it lies if it is one run.

    origins: what the model of each run grew from, by location; by default its weights.
    """

    name: str
    drawn: Sequence[RowWithEstimates]
    run: str | None = None
    origins: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ComparedSides:
    """The first side minus the second. items: by category, what both have in common, as far as that is known."""

    here: Side
    there: Side
    items: Mapping[str, CommonItems] = field(default_factory=dict)

    def counts(self, row: Difference) -> tuple[int | None, int | None]:
        """`n_items` and `of_items` of a row."""
        names = row.categories or (row.category,)
        if not all(name in self.items for name in names):
            return None, None
        found = [self.items[name] for name in names]
        return sum(one.n_items for one in found), sum(one.of_items for one in found)


def group_pairs(groups: Sequence[str], against: str | None = None) -> list[tuple[str, str]]:
    """Return every group with every earlier one, or every other group with `against`: minuend, subtrahend.

    Raises UsageError for a group that is none of them.
    """
    if against is None:
        return [(later, earlier) for earlier, later in combinations(groups, 2)]
    if against not in groups:
        raise UsageError(f"there is no group {against!r} to compare with; there are {', '.join(groups)}")
    return [(name, against) for name in groups if name != against]


def pair_differences(pairs: Sequence[ComparedSides]) -> list[Difference]:
    """The first of each pair minus the second, per view and category and over all, with Holm's p over the lot."""
    return _with_holm([row for pair in pairs for row in _compare_sides(pair)])


def _compare_sides(pair: ComparedSides) -> list[Difference]:
    here, there = pair.here, pair.there
    calls = {one.row.run.call for one in (*here.drawn, *there.drawn)}
    call = calls.pop() if len(calls) == 1 else None
    mine, theirs = _by_view(here.drawn), _by_view(there.drawn)
    shared: list[str | None] = [view for view in mine if view in theirs]
    if not shared:  # one was not probed, or in other views: behaviour can still be compared
        mine, theirs, shared = _behaviour(mine), _behaviour(theirs), [None]
    outcomes = _outcomes(here.drawn), _outcomes(there.drawn)
    found = [row for view in shared for row in _compare((here, there), view, mine[view], theirs[view], outcomes)]
    mode = here.drawn[0].row.run.mode
    found = [replace(row, call=call, run=here.run, minus_run=there.run, mode=mode) for row in found]
    counts = [pair.counts(row) for row in found]
    return [replace(row, n_items=n, of_items=of) for row, (n, of) in zip(found, counts, strict=True)]


Outcomes = Mapping[str, Sequence["pd.DataFrame"]]
"""Per category, a table of outcomes of each run."""
Drawn = Mapping[str, Sequence[RowWithEstimates]]
"""Per category, the row of each run."""


def _outcomes(drawn: Sequence[RowWithEstimates]) -> Outcomes:
    """Once per run, whatever number of views it has."""
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for one in drawn:
        if one.outcomes is not None:
            found.setdefault(one.row.category, {})[one.row.run.location] = one.outcomes
    return {category: list(tables.values()) for category, tables in found.items()}


def _behaviour(views: Mapping[str | None, Drawn]) -> dict[str | None, Drawn]:
    """What does not depend on the view, under the view None."""
    first = next(iter(views.values()), {})
    return {
        None: {
            category: [replace(one, estimates=RowEstimates(one.estimates.rates)) for one in of_category]
            for category, of_category in first.items()
        }
    }


def _by_view(drawn: Sequence[RowWithEstimates]) -> dict[str | None, Drawn]:
    """Rows per view and category."""
    views: dict[str | None, dict[str, list[RowWithEstimates]]] = {}
    for one in drawn:
        views.setdefault(one.row.view, {}).setdefault(one.row.category, []).append(one)
    return dict(views)


@dataclass(frozen=True)
class _Gap:
    """One category of two sides. accuracies: by stream. pooled: scores of either side, None without probes."""

    paired: bool
    sr: Rate | None
    accuracies: Mapping[str, Rate] = field(default_factory=dict)
    pooled: tuple[PooledScores, PooledScores] | None = None

    @classmethod
    def of(cls, here: Sequence[RowWithEstimates], there: Sequence[RowWithEstimates]) -> "_Gap":
        """Means over the runs of either side; a number that a run lacks is left out."""
        rates = [_rate(side) for side in (here, there)]
        pooled = [_pooled(side) for side in (here, there)]
        mine, theirs = rates
        sr = None if mine is None or theirs is None else mine.minus(theirs)
        first, second = pooled
        if first is None or second is None:
            return cls(mine is not None and theirs is not None and mine.paired_with(theirs), sr)
        same = first.shares_groups_with(second)
        paired = same if mine is None or theirs is None else mine.paired_with(theirs)
        names = [name for name in first.names if name in second.names]
        gaps = {name: first.accuracy_difference(second, name) for name in names}
        return cls(paired, sr, gaps, (first, second))

    @property
    def has_retention(self) -> bool:
        """Whether both sides have both streams."""
        return self.pooled is not None and all(side.names == (ACTION, BACKBONE) for side in self.pooled)


def _rate(rows: Sequence[RowWithEstimates]) -> Rate | None:
    shares = [one.estimates.rates["sr"] for one in rows if "sr" in one.estimates.rates]
    return Rate.pooled(shares) if shares and len(shares) == len(rows) else None


def _pooled(rows: Sequence[RowWithEstimates]) -> PooledScores | None:
    streams = [one.estimates.streams for one in rows if one.estimates.streams is not None]
    return PooledScores.of(streams) if streams and len(streams) == len(rows) else None


def _compare(
    sides: tuple[Side, Side], view: str | None, here: Drawn, there: Drawn, outcomes: tuple[Outcomes, Outcomes]
) -> list[Difference]:
    gaps = {category: _Gap.of(here[category], there[category]) for category in here if category in there}
    gaps = {category: gap for category, gap in gaps.items() if gap.sr is not None or gap.accuracies}
    rows = [
        _row(sides, [category], view, [gap], (here, there), _p(outcomes, [category], [gap]))
        for category, gap in gaps.items()
    ]
    if rows:
        common, found = list(gaps), list(gaps.values())
        mean = _row(sides, common, view, found, (here, there), _p(outcomes, common, found))
        rows.append(replace(mean, category=MEAN, categories=tuple(common)))
    return rows


def _p(
    outcomes: tuple[Outcomes, Outcomes], categories: Sequence[str], gaps: Sequence[_Gap]
) -> tuple[float | None, int | None]:
    """Of success rates, if both sides have one on the same items, and how many groups of items it rests on."""
    if not all(gap.paired and gap.sr is not None for gap in gaps):
        return None, None
    here, there = ([table for name in categories for table in side.get(name, ())] for side in outcomes)
    p = gains_p(here, there)
    return p, None if p is None else len({unit for table in here for unit in units_of(table)})


def _row(
    sides: tuple[Side, Side],
    categories: Sequence[str],
    view: str | None,
    gaps: Sequence[_Gap],
    drawn: tuple[Drawn, Drawn],
    tested: tuple[float | None, int | None],
) -> Difference:
    """Of one category, or of the mean of several."""
    rows = [[of_side[category] for category in categories] for of_side in drawn]
    sr, backbone, action = (
        _mean_rate(found)
        for found in (
            [gap.sr for gap in gaps],
            [gap.accuracies.get(BACKBONE) for gap in gaps],
            [gap.accuracies.get(ACTION) for gap in gaps],
        )
    )
    defined = all(any(one.row.retention.defined for found in side for one in found) for side in rows)
    ratio = _retention([gap for gap in gaps if gap.has_retention]) if defined else None
    numbers: dict[str, float | Limits | None] = {}
    for name, found in (("sr", sr), ("backbone", backbone), ("action", action), ("retention", ratio)):
        if found is not None:
            numbers |= {name: found.value, f"{name}_ci": limits(found.interval)}
    return Difference(
        sides[0].name,
        sides[1].name,
        categories[0],
        view,
        all(gap.paired for gap in gaps),
        **numbers,  # type: ignore[arg-type]
        sr_models=_models(sides, rows, _sr_of_model, largest=1.0),
        retention_models=None if ratio is None else _models(sides, rows, _retention_of_model),
        p=tested[0],
        n_groups=tested[1],
    )


def _mean_rate(found: Sequence[Rate | None]) -> Rate | None:
    known = [rate for rate in found if rate is not None]
    return Rate.mean(known) if known else None


def _retention(gaps: Sequence[_Gap]) -> Ratio | None:
    """The difference of the ratios of the sides' mean scores."""
    pairs = [gap.pooled for gap in gaps if gap.pooled is not None]
    if not pairs:
        return None
    here, there = (Scores.mean([pair[side].scores for pair in pairs]) for side in (0, 1))
    between = np.sum([mine.covariance_with(theirs) for mine, theirs in pairs], axis=0) / len(pairs) ** 2
    return retention_difference(here, there, between)


# -- models as the unit --------------------------------------------------------------------------------------


def _models(
    sides: tuple[Side, Side],
    rows: Sequence[Sequence[Sequence[RowWithEstimates]]],
    value: Callable[[Sequence[RowWithEstimates]], float | None],
    largest: float = inf,
) -> ModelTest | None:
    """Return the test of two sides with a value per origin of models.

    rows: of each side and per category, the row of each run. largest: see `ModelTest`. None where a model has no
    value, or is on both sides: its labels cannot be exchanged.
    """
    first, second = (_by_model(own, value) for own in rows)
    if first is None or second is None or first.keys() & second.keys():
        return None
    here, there = sides
    return ModelTest.of(
        _by_origin(first, rows[0], here.origins), _by_origin(second, rows[1], there.origins), largest
    )


def _by_model(
    side: Sequence[Sequence[RowWithEstimates]], value: Callable[[Sequence[RowWithEstimates]], float | None]
) -> dict[str, float] | None:
    """Return the value of each model over its categories, see `_model`.

    Runs of one model, such as of several seeds, are averaged: they are no further models.
    """
    if len({len(one) for one in side}) != 1:
        return None
    values: dict[str, list[float]] = {}
    for of_run in zip(*side, strict=True):
        found = value(of_run)
        if found is None:
            return None
        values.setdefault(_model(of_run[0]), []).append(found)
    return {model: float(np.mean(own)) for model, own in values.items()} or None


def _by_origin(
    values: Mapping[str, float], side: Sequence[Sequence[RowWithEstimates]], origins: Mapping[str, str]
) -> list[float]:
    """Return a value per origin: the mean of its models, which resemble each other."""
    origin_of: dict[str, str] = {}
    for one in side[0]:
        origin_of.setdefault(_model(one), origins.get(one.row.run.location, _model(one)))
    grouped: dict[str, list[float]] = {}
    for model, origin in origin_of.items():
        grouped.setdefault(origin, []).append(values[model])
    return [float(np.mean(models)) for models in grouped.values()]


def _model(one: RowWithEstimates) -> str:
    """Return the hash of a run's weights, or its location where that is unknown."""
    return one.row.run.weights_sha256 or one.row.run.location


def _sr_of_model(rows: Sequence[RowWithEstimates]) -> float | None:
    rates = [one.row.success.sr for one in rows if one.row.success.sr is not None]
    return float(np.mean(rates)) if len(rates) == len(rows) else None


def _retention_of_model(rows: Sequence[RowWithEstimates]) -> float | None:
    pooled = [_pooled([one]) for one in rows]
    scores = [one.scores for one in pooled if one is not None and one.names == (ACTION, BACKBONE)]
    return retention(Scores.mean(scores)).value if scores else None


def _with_holm(rows: Sequence[Difference]) -> list[Difference]:
    """Categories of all pairs are one family, means of all pairs another; views do not multiply tests of SR."""
    found = corrected(rows, lambda row: row.p, lambda row: row.category == MEAN, _test)
    return [replace(row, p_holm=p) for row, p in zip(rows, found, strict=True)]


def _test(row: Difference) -> tuple[str, str, str]:
    return row.group, row.minus, row.category
