"""Runs, or groups of runs, against each other: what co-training, fine-tuning or training at all changed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour.paired_gains import gains_p
from probe_kit.retention.estimators.bootstrap_draws import Estimate, Estimates, Limits, average
from probe_kit.retention.rows.build import RowWithDraws
from probe_kit.retention.rows.category_mean import average_estimates
from probe_kit.retention.rows.row import MEAN
from probe_kit.statistics.multiple_testing import corrected

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Difference:
    """`group` minus `minus` in one category and view, each the mean of its runs; 95 % intervals.

    group, minus: names of groups, or of single runs, whose locations are then `run` and `minus_run`.
    paired: whether both ran the same items, which are then drawn together; otherwise each group's on its own.
    view: None where the two have no probed view in common.
    p: of `sr`, exact, signs of whole groups of items flipped, in the row `mean` of all items at once; None unless
    paired. p_holm: over the categories of all pairs of the table, or over the pairs in rows `mean`.
    `retention` is the debiased one, `retention_bounded` the one that tables lead with; None unless defined in both
    groups. call: the captured inference that both were probed at, None without probes or where they differ. In a
    row of category `mean`, numbers are averages over the `categories` that both groups have.
    """

    group: str
    minus: str
    category: str
    view: str | None
    paired: bool
    sr: float | None = None
    sr_ci: Limits | None = None
    backbone_accuracy: float | None = None
    backbone_ci: Limits | None = None
    action_accuracy: float | None = None
    action_ci: Limits | None = None
    retention: float | None = None
    retention_ci: Limits | None = None
    retention_bounded: float | None = None
    retention_bounded_ci: Limits | None = None
    retention_area: float | None = None
    retention_area_ci: Limits | None = None
    call: int | None = None
    p: float | None = None
    p_holm: float | None = None
    run: str | None = None
    minus_run: str | None = None
    categories: tuple[str, ...] = ()


@dataclass(frozen=True)
class Side:
    """One side of a comparison: what it is called, the rows of its runs, and where it lies if it is one run."""

    name: str
    drawn: Sequence[RowWithDraws]
    run: str | None = None

    def only(self, categories: Sequence[str]) -> "Side":
        """The same with some of its categories."""
        return replace(self, drawn=[one for one in self.drawn if one.row.category in categories])


def group_differences(
    groups: Mapping[str, Sequence[RowWithDraws]], against: str | None = None
) -> list[Difference]:
    """Every group minus every later one, or minus the group `against`, per view and category and over all.

    Raises UsageError for a group that is none of them.
    """
    if against is not None and against not in groups:
        raise UsageError(f"there is no group {against!r} to compare with; there are {', '.join(groups)}")
    names = [name for name in groups if name != against]
    chosen = combinations(groups, 2) if against is None else ((name, against) for name in names)
    return pair_differences([(Side(one, groups[one]), Side(other, groups[other])) for one, other in chosen])


def pair_differences(pairs: Sequence[tuple[Side, Side]]) -> list[Difference]:
    """The first of each pair minus the second, per view and category and over all, with Holm's p over the lot."""
    return _with_holm([row for here, there in pairs for row in _compare_sides(here, there)])


def _compare_sides(here: Side, there: Side) -> list[Difference]:
    calls = {one.row.run.call for one in (*here.drawn, *there.drawn)}
    call = calls.pop() if len(calls) == 1 else None
    mine, theirs = _by_view(here.drawn), _by_view(there.drawn)
    shared = [view for view in mine if view in theirs]
    if not shared:  # one was not probed, or in other views: behaviour can still be compared
        mine, theirs, shared = _behaviour(mine), _behaviour(theirs), [None]
    outcomes = _outcomes(here.drawn), _outcomes(there.drawn)
    found = [row for view in shared for row in _compare((here, there), view, mine[view], theirs[view], outcomes)]
    return [replace(row, call=call, run=here.run, minus_run=there.run) for row in found]


Outcomes = Mapping[str, Sequence["pd.DataFrame"]]
"""Per category, a table of outcomes of each run."""


def _outcomes(drawn: Sequence[RowWithDraws]) -> Outcomes:
    """Once per run, whatever number of views it has."""
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for one in drawn:
        if one.outcomes is not None:
            found.setdefault(one.row.category, {})[one.row.run.location] = one.outcomes
    return {category: list(tables.values()) for category, tables in found.items()}


def _behaviour(views: Mapping[str | None, Mapping[str, Estimates]]) -> dict[str | None, dict[str, Estimates]]:
    """What does not depend on the view, under the view None."""
    first = next(iter(views.values()), {})
    return {None: {name: {"sr": found["sr"]} if "sr" in found else {} for name, found in first.items()}}


def _by_view(drawn: Sequence[RowWithDraws]) -> dict[str | None, dict[str, Estimates]]:
    """Estimates per view and category, averaged over runs; a quantity that a run lacks is left out."""
    views: dict[str | None, dict[str, list[Estimates]]] = {}
    for one in drawn:
        views.setdefault(one.row.view, {}).setdefault(one.row.category, []).append(one.estimates)
    return {
        view: {category: _average_common(found) for category, found in categories.items()}
        for view, categories in views.items()
    }


def _average_common(found: Sequence[Estimates]) -> Estimates:
    return {name: average([one[name] for one in found]) for name in found[0] if all(name in one for one in found)}


def _compare(
    sides: tuple[Side, Side],
    view: str | None,
    here: Mapping[str, Estimates],
    there: Mapping[str, Estimates],
    outcomes: tuple[Outcomes, Outcomes],
) -> list[Difference]:
    common = [category for category in here if set(here[category]) & set(there.get(category, {}))]
    gaps = {
        category: {
            name: estimate - there[category][name]
            for name, estimate in here[category].items()
            if name in there[category]
        }
        for category in common
    }
    paired = {category: _drawn_alike(here[category], there[category]) for category in common}
    rows = [
        _row(sides, category, view, paired[category], gap, _p(outcomes, [category], paired[category], gap))
        for category, gap in gaps.items()
    ]
    if rows:
        gap, alike = average_estimates(list(gaps.values())), all(paired.values())
        mean = _row(sides, MEAN, view, alike, gap, _p(outcomes, common, alike, gap))
        rows.append(replace(mean, categories=tuple(common)))
    return rows


def _p(
    outcomes: tuple[Outcomes, Outcomes], categories: Sequence[str], paired: bool, gap: Estimates
) -> float | None:
    """Of success rates, if both sides have one on the same items."""
    if not paired or "sr" not in gap:
        return None
    here, there = ([table for name in categories for table in side.get(name, ())] for side in outcomes)
    return gains_p(here, there)


def _drawn_alike(here: Estimates, there: Estimates) -> bool:
    """Whether both drew the same items: seen at the first quantity that both have, SR where both acted."""
    name = next(name for name in here if name in there)
    return here[name].units == there[name].units


def _row(
    sides: tuple[Side, Side], category: str, view: str | None, paired: bool, gap: Estimates, p: float | None
) -> Difference:
    sr = _value(gap.get("sr"))
    backbone, action = (_value(gap.get(f"{part}_accuracy")) for part in ("backbone", "action"))
    debiased, bounded, area = (_value(gap.get(f"retention_{part}")) for part in ("debiased", "bounded", "area"))
    numbers = (*sr, *backbone, *action, *debiased, *bounded, *area)
    return Difference(sides[0].name, sides[1].name, category, view, paired, *numbers, p=p)


def _value(estimate: Estimate | None) -> tuple[float | None, Limits | None]:
    return (None, None) if estimate is None else (estimate.value, estimate.ci)


def _with_holm(rows: Sequence[Difference]) -> list[Difference]:
    """Categories of all pairs are one family, means of all pairs another; views do not multiply tests of SR."""
    found = corrected(rows, lambda row: row.p, lambda row: row.category == MEAN, _test)
    return [replace(row, p_holm=p) for row, p in zip(rows, found, strict=True)]


def _test(row: Difference) -> tuple[str, str, str]:
    return row.group, row.minus, row.category
