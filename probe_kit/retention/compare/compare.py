"""One comparison: the first side minus the second, on the same items, with one exact test.

A side is a run, a group of models, a VLM or its policy, or one wording of a run. Rows pair by item, layout and
content. Groups of items are the unit of intervals and p.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import reduce
from itertools import combinations, product
from math import lcm
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._tables.numbers import Limits
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import TableRun, shares_of, success_share, units_of
from probe_kit.retention.compare.models import (
    ModelTest,
    Relation,
    compare_models,
    grew_from,
    origins_of,
    retention_of_model,
    success_of_model,
)
from probe_kit.retention.estimators import ACTION, BACKBONE, PooledScores, Rate, limits
from probe_kit.retention.rows.build import RowSettings, RowWithEstimates, run_rows
from probe_kit.retention.rows.row import MEAN, Mode
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader
from probe_kit.runs.run_view import view_run
from probe_kit.statistics.paired_tests import flip_gains_p, holm_corrected
from probe_kit.statistics.retention import Ratio, Scores, retention_difference

if TYPE_CHECKING:
    import pandas as pd


# -- items in common -----------------------------------------------------------------------------------------

MANY = 0.8
"""Share of items in common below which groups of runs are not paired."""
OWN_WORDS = "knowledge"
"""The wording of a run in the items' own words."""
_CONTENT = "item_content_sha256"
EpisodeKey = tuple[str, str, str]
"""Item, layout and content of the item."""


@dataclass(frozen=True)
class CommonItems:
    """The episodes of one category that several runs have in common.

    Attributes:
        episodes: The episodes as (item, layout).
        n_items: Number of their items.
        of_items: Number of items that any of the runs has.
        is_complete: Whether every run has these episodes and no others.
    """

    episodes: frozenset[tuple[str, str]]
    n_items: int
    of_items: int
    is_complete: bool

    def select(self, episodes: "pd.DataFrame") -> "pd.DataFrame":
        """Return the rows of a table of episodes that are among these, with their index."""
        keys = zip(episodes["item_id"].astype(str), episodes["layout"].astype(str), strict=True)
        return episodes[[key in self.episodes for key in keys]]

    @property
    def is_many(self) -> bool:
        """Whether at least 80 % of the items are in common, so that the others are worth leaving out."""
        return self.n_items >= MANY * self.of_items


def common_items(runs: Sequence[RunReader]) -> dict[str, CommonItems]:
    """Return by category the items that all runs have in common, of which there may be none.

    Items are the same where id and content hash are equal. Runs of one suite need no hashes. Nothing is in common
    of runs of several suites if one of them holds no hashes, as arrays do.
    """
    by_content = all(has_item_content(run) for run in runs)
    if not by_content and len({run.suite for run in runs}) > 1:
        return {}
    episodes = [_episodes(run.episodes, by_content) for run in runs]
    shared = [name for name in episodes[0] if all(name in of_run for of_run in episodes)]
    return {name: _common([of_run[name] for of_run in episodes]) for name in shared}


def has_item_content(run: RunReader) -> bool:
    """Whether a run declares the content of each of its items."""
    return _CONTENT in run.episodes and not bool(run.episodes[_CONTENT].isna().any())


def wording_of(run: RunReader) -> str:
    """Return the wordings of a run's episodes, comma-separated."""
    wordings = run.episodes["wording"].unique() if "wording" in run.episodes else [OWN_WORDS]
    return ", ".join(map(str, wordings))


def _common(of_runs: Sequence[frozenset[EpisodeKey]]) -> CommonItems:
    common = reduce(frozenset.intersection, of_runs)
    every = reduce(frozenset.union, of_runs)
    return CommonItems(
        frozenset((item, layout) for item, layout, _ in common),
        len({item for item, _, _ in common}),
        len({(item, content) for item, _, content in every}),
        all(episodes == common for episodes in of_runs),
    )


def _episodes(episodes: "pd.DataFrame", by_content: bool) -> Mapping[str, frozenset[EpisodeKey]]:
    return {
        str(name): frozenset(
            zip(
                table["item_id"].astype(str),
                table["layout"].astype(str),
                table[_CONTENT].astype(str) if by_content else [""] * len(table),
                strict=True,
            )
        )
        for name, table in episodes.groupby("category", sort=False)
    }


# -- the test of success rates -------------------------------------------------------------------------------

_FINEST = 1000
"""Parts that an outcome is counted in, where several last steps or several runs make shares of it."""


def gains(first: "Sequence[pd.DataFrame]", second: "Sequence[pd.DataFrame]") -> dict[str, Any]:
    """Return an exact, two-sided test of both sides being right equally often, as fields of `Difference`.

    Whole groups of items are turned together. Empty unless every run of both sides has the same episodes.

    Args:
        first: Tables of episodes, each of one run and category; runs of a side count by their mean.
        second: Tables of the other side.
    """
    sides = [_side_shares(tables) for tables in (first, second)]
    if None in sides:
        return {}
    (mine, units), (theirs, _) = (side for side in sides if side is not None)
    if not mine or set(mine) != set(theirs):
        return {}
    leads = [mine[episode] - theirs[episode] for episode in mine]
    # The exact test counts in whole units, as coarse as the gains allow: its time grows with their number.
    scale = min(_FINEST, lcm(*(lead.denominator for lead in leads)))
    scaled: NDArray[np.int64] = np.array([round(lead * scale) for lead in leads])
    groups = [units[episode] for episode in mine]
    return {
        "p": flip_gains_p(scaled, groups),
        "n_groups": len(set(groups)),
        "only": int((scaled > 0).sum()),
        "only_minus": int((scaled < 0).sum()),
    }


def _side_shares(tables: "Sequence[pd.DataFrame]") -> tuple[dict[str, Fraction], dict[str, str]] | None:
    """Return by episode the share that was right, averaged over runs, and its group.

    None if runs differ in episodes.
    """
    by_episode: dict[str, list[Fraction]] = {}
    units: dict[str, str] = {}
    for table in tables:
        names = table["item_id"].astype(str) + ":" + table["layout"].astype(str)
        for name, share, unit in zip(names, shares_of(table, "correct"), units_of(table), strict=True):
            by_episode.setdefault(name, []).append(Fraction(float(share)).limit_denominator(_FINEST))
            units[name] = unit
    runs = {len(shares) for shares in by_episode.values()}
    if len(runs) > 1:
        return None
    return {name: sum(shares, Fraction(0)) / len(shares) for name, shares in by_episode.items()}, units


# -- the comparison ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Difference:
    """`group` minus `minus` in one category and view, each the mean of its runs; 95 % intervals.

    Intervals and p are of these models on other items. In a row of category `mean`, numbers are averages over the
    `categories` that both groups have.

    Attributes:
        group: Name of a group, or of a single run, whose location is then `run`.
        minus: Name of the group or run that is subtracted; the run's location is then `minus_run`.
        view: None where the two have no probed view in common.
        paired: Whether both ran the same items, which then count as pairs.
        sr: Difference of the success rates.
        backbone: Difference of the cross-fitted accuracies in the backbone.
        action: Difference of the cross-fitted accuracies in the action.
        retention: None unless defined on both sides.
        sr_models: Test with the model as the unit, where a side is a group of several.
        retention_models: The same test of retention.
        call: The captured inference that both were probed at, None without probes or where they differ.
        p: Exact p of `sr`, signs of whole groups of items flipped, in the row `mean` of all items at once; None
            unless paired.
        p_holm: Corrected over the categories of all pairs of the table, or over the pairs in rows `mean`.
        mode: Whether the models of both acted or answered.
        n_items: Items that all runs of both sides have and that the numbers are of; None where that is not known.
        of_items: Items that any of them has; None where that is not known.
        n_groups: Independent groups of items whose signs `p` flips, None without a p.
        sr_group: Success rate of `group`.
        sr_minus: Success rate of `minus`.
        only: Episodes in which `group` alone is right, or more often than the other; None unless paired.
        only_minus: The same of `minus`.
        same_frames: Of a VLM minus a policy, whether all began with the same frames; None of others, and where
            unknown.
        source: Of a VLM minus a policy, whether the policy's network grew from the weights that were asked; None
            of others.
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
    sr_group: float | None = None
    sr_minus: float | None = None
    only: int | None = None
    only_minus: int | None = None
    same_frames: bool | None = None
    source: Relation | None = None


@dataclass(frozen=True)
class Side:
    """One side of a comparison: its name, its runs and their rows.

    Attributes:
        run: Location of the run, if the side is a single one.
        origins: See `compare_models`.
    """

    name: str
    runs: tuple[RunReader, ...]
    rows: tuple[RowWithEstimates, ...]
    run: str | None = None
    origins: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, run: RunReader, rows: Sequence[RowWithEstimates]) -> "Side":
        """Return the side of a single run.

        Args:
            name: Name of the run in tables.
            run: The only run of the side.
            rows: Rows of several runs, of which the run's own are taken.
        """
        location = str(run.location)
        return cls(name, (run,), tuple(row for row in rows if row.row.run.location == location), location)


def compare(
    first: Side,
    second: Side,
    of: Literal["all", "success"] = "all",
    *,
    items: Mapping[str, CommonItems] | None = None,
    others_too: bool = False,
) -> list[Difference]:
    """Return the first side minus the second, per view and category, and over all categories.

    `p_holm` is not set: `with_holm` sets it, over all rows that are shown together.

    Args:
        first: The side that the other one is subtracted from.
        second: The side that is subtracted.
        of: Success rates, backbone, action and retention; or success rates (answers of a VLM) alone.
        items: Items that all runs have in common by category, see `common_items`; None computes them.
        others_too: Compare categories without such items, each side on its own.
    """
    runs = [*first.runs, *second.runs]
    shared = common_items(runs) if items is None else items
    sides = tuple(_on_common_items(side, shared, runs, others_too) for side in (first, second))
    mine, theirs = (_by_view(side.rows) for side in sides)
    views: list[str | None] = [view for view in mine if view in theirs]
    if of == "success" or not views:  # not probed, or in other views: behaviour can still be compared
        mine, theirs, views = _behaviour(mine), _behaviour(theirs), [None]
    outcomes = _outcomes(sides[0].rows), _outcomes(sides[1].rows)
    calls = {row.row.run.call for side in sides for row in side.rows}
    differences = [
        row for view in views for row in _compare((sides[0], sides[1]), view, (mine[view], theirs[view]), outcomes)
    ]
    call = next(iter(calls)) if len(calls) == 1 and of == "all" else None
    mode = sides[0].rows[0].row.run.mode if differences else "acts"
    common: dict[str, Any] = {"call": call, "run": first.run, "minus_run": second.run, "mode": mode}
    return [replace(row, **common, **_counts(row, shared)) for row in differences]


def with_holm(rows: Sequence[Difference]) -> list[Difference]:
    """Return the rows, which are shown together, with `p_holm`.

    Categories of all pairs are one family, means of all pairs another; views do not multiply tests of success.
    """

    def test(row: Difference) -> tuple[str | None, str, str, str]:
        return row.run, row.group, row.minus, row.category

    p_values = holm_corrected(rows, lambda row: row.p, lambda row: row.category == MEAN, test)
    return [replace(row, p_holm=p) for row, p in zip(rows, p_values, strict=True)]


def _counts(row: Difference, items: Mapping[str, CommonItems]) -> dict[str, Any]:
    """Return `n_items` and `of_items` of a row, where they are known."""
    names = row.categories or (row.category,)
    if not all(name in items for name in names):
        return {}
    return {name: sum(getattr(items[category], name) for category in names) for name in ("n_items", "of_items")}


def _on_common_items(
    side: Side, items: Mapping[str, CommonItems], runs: Sequence[RunReader], others_too: bool
) -> Side:
    """Return the side on the items in common, with the draws of the first of `runs`.

    Runs of several suites then have the same groups and are paired. Probes of other items take no part in it.
    """
    seed_texts = {str(run.location): run.seed_text for run in runs}
    seed_text = runs[0].seed_text

    def common(row: RowWithEstimates) -> RowWithEstimates:
        in_common = items.get(row.row.category)
        if in_common is None or (in_common.is_complete and seed_texts[row.row.run.location] == seed_text):
            return row
        outcomes = None if row.outcomes is None else in_common.select(row.outcomes)
        rates = {} if outcomes is None else {"sr": success_share(outcomes, seed_text)}
        streams = row.streams if in_common.is_complete else None
        streams = None if streams is None else streams.as_of(seed_text)
        return replace(row, rates=rates, streams=streams, outcomes=outcomes)

    shared = {name for name, items_of in items.items() if items_of.n_items}
    return replace(
        side,
        rows=tuple(common(row) for row in side.rows if others_too or row.row.category in shared),
    )


Outcomes = Mapping[str, Sequence["pd.DataFrame"]]
"""By category, a table of outcomes of each run."""
RowsOfRuns = Mapping[str, Sequence[RowWithEstimates]]
"""By category, the row of each run."""


def _outcomes(rows: Sequence[RowWithEstimates]) -> Outcomes:
    """Return the outcomes once per run, whatever number of views it has."""
    by_category: dict[str, dict[str, pd.DataFrame]] = {}
    for row in rows:
        if row.outcomes is not None:
            by_category.setdefault(row.row.category, {})[row.row.run.location] = row.outcomes
    return {category: list(tables.values()) for category, tables in by_category.items()}


def _behaviour(views: Mapping[str | None, RowsOfRuns]) -> dict[str | None, RowsOfRuns]:
    """Return the parts that do not depend on the view, under the view None."""
    first = next(iter(views.values()), {})
    return {
        None: {
            category: [replace(row, streams=None) for row in of_category]
            for category, of_category in first.items()
        }
    }


def _by_view(rows: Sequence[RowWithEstimates]) -> dict[str | None, RowsOfRuns]:
    """Return the rows per view and category."""
    views: dict[str | None, dict[str, list[RowWithEstimates]]] = {}
    for row in rows:
        views.setdefault(row.row.view, {}).setdefault(row.row.category, []).append(row)
    return dict(views)


@dataclass(frozen=True)
class _Gap:
    """One category of two sides.

    Attributes:
        rates: Success of either side, None where a run has none.
        sr: Difference of the two rates.
        accuracies: Differences of accuracy by stream.
        pooled: Scores of either side, None without probes.
    """

    paired: bool
    rates: tuple[Rate | None, Rate | None]
    sr: Rate | None
    accuracies: Mapping[str, Rate] = field(default_factory=dict)
    pooled: tuple[PooledScores, PooledScores] | None = None

    @classmethod
    def of(cls, minuends: Sequence[RowWithEstimates], subtrahends: Sequence[RowWithEstimates]) -> "_Gap":
        """Return the means over the runs of either side; a number that a run lacks is left out."""
        rates = mine, theirs = _rate(minuends), _rate(subtrahends)
        first, second = _pool_scores(minuends), _pool_scores(subtrahends)
        sr = None if mine is None or theirs is None else mine.minus(theirs)
        if first is None or second is None:
            return cls(mine is not None and theirs is not None and mine.paired_with(theirs), rates, sr)
        same = first.shares_groups_with(second)
        paired = same if mine is None or theirs is None else mine.paired_with(theirs)
        names = [name for name in first.names if name in second.names]
        gaps = {name: first.accuracy_difference(second, name) for name in names}
        return cls(paired, rates, sr, gaps, (first, second))

    @property
    def has_retention(self) -> bool:
        """Whether both sides have both streams."""
        return self.pooled is not None and all(side.names == (ACTION, BACKBONE) for side in self.pooled)


def _rate(rows: Sequence[RowWithEstimates]) -> Rate | None:
    shares = [row.rates["sr"] for row in rows if "sr" in row.rates]
    return Rate.pooled(shares) if shares and len(shares) == len(rows) else None


def _pool_scores(rows: Sequence[RowWithEstimates]) -> PooledScores | None:
    streams = [row.streams for row in rows if row.streams is not None]
    return PooledScores.of(streams) if streams and len(streams) == len(rows) else None


def _compare(
    sides: tuple[Side, Side],
    view: str | None,
    rows_of_sides: tuple[RowsOfRuns, RowsOfRuns],
    outcomes: tuple[Outcomes, Outcomes],
) -> list[Difference]:
    minuends, subtrahends = rows_of_sides
    gaps = {
        category: _Gap.of(minuends[category], subtrahends[category])
        for category in minuends
        if category in subtrahends
    }
    gaps = {category: gap for category, gap in gaps.items() if gap.sr is not None or gap.accuracies}
    rows = [_row(sides, [category], view, [gap], rows_of_sides, outcomes) for category, gap in gaps.items()]
    if rows:
        mean = _row(sides, list(gaps), view, list(gaps.values()), rows_of_sides, outcomes)
        rows.append(replace(mean, category=MEAN, categories=tuple(gaps)))
    return rows


def _row(
    sides: tuple[Side, Side],
    categories: Sequence[str],
    view: str | None,
    gaps: Sequence[_Gap],
    rows_of_sides: tuple[RowsOfRuns, RowsOfRuns],
    outcomes: tuple[Outcomes, Outcomes],
) -> Difference:
    """Return the difference in one category, or in the mean of several."""
    first, second = ([of_side[category] for category in categories] for of_side in rows_of_sides)
    estimates: dict[str, Rate | Ratio | None] = {
        "sr": _mean_rate([gap.sr for gap in gaps]),
        "backbone": _mean_rate([gap.accuracies.get(BACKBONE) for gap in gaps]),
        "action": _mean_rate([gap.accuracies.get(ACTION) for gap in gaps]),
    }
    if all(any(row.row.retention.defined for of_runs in side for row in of_runs) for side in (first, second)):
        estimates["retention"] = _retention([gap for gap in gaps if gap.has_retention])
    numbers: dict[str, Any] = {}
    for name, estimate in estimates.items():
        if estimate is not None:
            numbers |= {name: estimate.value, f"{name}_ci": limits(estimate.interval)}
    if "sr" in numbers:
        for at, name in enumerate(("sr_group", "sr_minus")):
            numbers[name] = float(np.mean([rate.value for gap in gaps if (rate := gap.rates[at]) is not None]))
    if all(gap.paired and gap.sr is not None for gap in gaps):
        numbers |= gains(*([table for name in categories for table in side.get(name, ())] for side in outcomes))
    origins = {**sides[0].origins, **sides[1].origins}
    if "retention" in numbers:
        numbers["retention_models"] = compare_models((first, second), origins, retention_of_model)
    return Difference(
        sides[0].name,
        sides[1].name,
        categories[0],
        view,
        all(gap.paired for gap in gaps),
        sr_models=compare_models((first, second), origins, success_of_model, largest=1.0),
        **numbers,
    )


def _mean_rate(rates: Sequence[Rate | None]) -> Rate | None:
    defined = [rate for rate in rates if rate is not None]
    return Rate.mean(defined) if defined else None


def _retention(gaps: Sequence[_Gap]) -> Ratio | None:
    """Return the difference of the ratios of the sides' mean scores."""
    pairs = [gap.pooled for gap in gaps if gap.pooled is not None]
    if not pairs:
        return None
    minuend, subtrahend = (Scores.mean([pair[side].scores for pair in pairs]) for side in (0, 1))
    between = np.sum([mine.covariance_with(theirs) for mine, theirs in pairs], axis=0) / len(pairs) ** 2
    return retention_difference(minuend, subtrahend, between)


# -- which sides are compared ---------------------------------------------------------------------------------


PairedRuns = tuple[list[Difference], tuple[str, ...]]
"""Differences of runs or groups on the items that they have in common, and sentences.

The sentences give the reasons why others have no difference, and the items that were left out.
"""


def compare_runs(
    runs: Sequence[TableRun],
    rows: Sequence[RowWithEstimates],
    against: str | None = None,
    vlm_vla: bool = False,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> PairedRuns:
    """Return every other run minus the run `against`, by default the first; VLM runs and policy runs apart.

    Runs of one seed and wording are compared, on the items that both have. Success rates are those on these items
    alone. Probes are compared where no run has other items.

    Args:
        runs: Runs of the table in the order in which they were named.
        rows: The rows of these runs.
        against: A run's name in tables, its folder's name or its location; None for the first run.
        vlm_vla: Whether VLM runs are compared with policy runs elsewhere.
        pairs: Pairs of locations that are compared instead, each the first minus the second.

    Raises:
        UsageError: For a name that is none of the runs, or several.
    """
    if against is not None and len(runs) < 2:
        raise UsageError(f"--reference {against} needs a second run to compare with it")
    differences: list[Difference] = []
    unpaired: list[str] = []
    for minuend, subtrahend in _pairs(runs, against, pairs):
        both = f"{minuend.name} and {subtrahend.name}"
        items = common_items([minuend.run, subtrahend.run])
        if why := _why_not(minuend.run, subtrahend.run, items):
            unpaired.append(f"{both} are not compared: {why}.")
            continue
        unpaired += _left_out(both, items)
        first, second = (Side.of(run.name, run.run, rows) for run in (minuend, subtrahend))
        differences += compare(first, second, items=items)
    if not vlm_vla and pairs is None and len({run.answers for run in runs}) == 2:
        unpaired.append(
            "VLM runs and policy runs are not compared with each other; `probe-kit compare --kind vlm-vla` does "
            "that."
        )
    return with_holm(differences), tuple(unpaired)


def compare_groups(
    groups: Mapping[str, Sequence[TableRun]],
    rows: Sequence[RowWithEstimates],
    against: str | None = None,
    origins: Mapping[str, str] | None = None,
) -> PairedRuns:
    """Return every group of runs minus every earlier one, or minus the group `against`; see `compare_runs`.

    Two groups count as pairs in categories in which all of their runs have at least 80 % of the items in common.
    They are then compared on these items alone. In other categories each group has its own items.

    Args:
        groups: Runs by the name of their group.
        rows: The rows of these runs.
        against: Name of a group; None compares every two groups.
        origins: Declared origins by location, see `origins_of`.

    Raises:
        UsageError: For a group that is none of them, and a declared origin of no run.
    """
    differences: list[Difference] = []
    notes: list[str] = []
    runs_of = {name: tuple(run.run for run in of_group) for name, of_group in groups.items()}
    grown = origins_of([run for of_group in runs_of.values() for run in of_group], origins)
    for names in group_pairs(list(groups), against):
        in_common = common_items([run for name in names for run in runs_of[name]])
        items = {category: common for category, common in in_common.items() if common.is_many}
        first, second = (
            Side(name, runs_of[name], tuple(row for row in rows if row.row.group == name), origins=grown)
            for name in names
        )
        notes += _left_out(" and ".join(names), items)
        differences += compare(first, second, items=items, others_too=True)
    return with_holm(differences), tuple(notes)


def group_pairs(groups: Sequence[str], against: str | None = None) -> list[tuple[str, str]]:
    """Return pairs (minuend, subtrahend): every group with every earlier one, or every other group with `against`.

    Args:
        groups: Names of the groups in order.
        against: Name of a group; None for every two groups.

    Raises:
        UsageError: For a group that is none of them.
    """
    if against is None:
        return [(later, earlier) for earlier, later in combinations(groups, 2)]
    if against not in groups:
        raise UsageError(f"there is no group {against!r} to compare with; there are {', '.join(groups)}")
    return [(name, against) for name in groups if name != against]


def compare_with_vlms(
    runs: Sequence[TableRun],
    rows: Sequence[RowWithEstimates],
    pairs: Sequence[tuple[str, str]] | None = None,
) -> list[Difference]:
    """Return every VLM run minus every acting one that it can be compared with, in answers and success alone.

    A policy whose network grew from weights that were asked is not compared with VLMs of other weights.

    Args:
        runs: Runs of the table.
        rows: The rows of these runs.
        pairs: Pairs of locations, a VLM run's and a policy run's, that are compared instead.
    """
    vlms, policies = ([run for run in runs if run.answers == kind] for kind in (True, False))
    related = [(vlm, policy, grew_from(policy.run, vlm.run)) for vlm, policy in product(vlms, policies)]
    grown = {policy.location for _, policy, source in related if source == "yes"}
    differences: list[Difference] = []
    for vlm, policy, source in related:
        is_left_out = source == "no" and policy.location in grown
        if is_left_out if pairs is None else (vlm.location, policy.location) not in pairs:
            continue
        items = common_items([vlm.run, policy.run]) if wording_of(vlm.run) == wording_of(policy.run) else {}
        items = {name: in_common for name, in_common in items.items() if in_common.n_items}
        first, second = (Side.of(run.label, run.run, rows) for run in (vlm, policy))
        differences += [
            replace(
                row,
                source=source,
                paired=row.n_items is not None,
                same_frames=_same_frames(vlm.run, policy.run, row.categories or (row.category,), items),
            )
            for row in compare(first, second, "success", items=items, others_too=True)
        ]
    return with_holm(differences)


def _same_frames(
    vlm: RunReader, policy: RunReader, categories: Sequence[str], items: Mapping[str, CommonItems]
) -> bool | None:
    """Return whether all episodes of both began with the same frames; None where a run has no hashes."""
    if FIRST_FRAME not in vlm.episodes or FIRST_FRAME not in policy.episodes:
        return None
    are_same = []
    for category in categories:
        first, second = (run.episodes[run.episodes["category"] == category] for run in (vlm, policy))
        if category in items:
            first, second = items[category].select(first), items[category].select(second)
        both = first[["episode_id", FIRST_FRAME]].merge(second[["episode_id", FIRST_FRAME]], on="episode_id")
        are_same.append(bool(len(both) and (both[f"{FIRST_FRAME}_x"] == both[f"{FIRST_FRAME}_y"]).all()))
    return all(are_same)


# -- wordings ----------------------------------------------------------------------------------------------------


def compare_wordings(runs: Sequence[RunReader]) -> list[Difference]:
    """Return every two wordings of each run against each other, the earlier one minus the later.

    The comparison separates not knowing from not being able. A policy that places the cube by "the left picture",
    and not by the content of the picture, can act and does not know.

    Args:
        runs: Runs that acted, judged by the rule of the table.
    """
    settings = RowSettings(None, "all", ())
    differences: list[Difference] = []
    for run in runs:
        every_wording: RunReader = run.all_wordings
        sides = {}
        for wording in run.wordings:
            episodes = every_wording.episodes
            in_wording = view_run(every_wording, episodes[episodes["wording"] == wording])
            if len(in_wording.episodes):
                rows = run_rows(TableRun.of(in_wording, with_behaviour=False), None, settings)
                sides[wording] = Side.of(wording, in_wording, rows)
        for first, second in combinations(sides.values(), 2):
            differences += compare(first, second, "success")
    return with_holm(differences)


def _left_out(both: str, items: Mapping[str, CommonItems]) -> list[str]:
    """Return a sentence or two on what a comparison leaves out."""
    none = [name for name, in_common in items.items() if not in_common.n_items]
    part = {
        name: in_common for name, in_common in items.items() if in_common.n_items and not in_common.is_complete
    }
    some = [f"{in_common.n_items} of {in_common.of_items} in {name}" for name, in_common in part.items()]
    sentences = [f"{both} are not compared in {', '.join(none)}: no item in common."] if none else []
    if some:
        sentences.append(
            f"{both} are compared on the items in common: {', '.join(some)}. Probes are not compared there: they "
            "were fitted on other items."
        )
    return sentences


def _pairs(
    runs: Sequence[TableRun], name: str | None, pairs: Sequence[tuple[str, str]] | None
) -> list[tuple[TableRun, TableRun]]:
    if pairs is not None:
        by_location = {run.location: run for run in runs}
        if strange := [location for pair in pairs for location in pair if location not in by_location]:
            raise UsageError(f"{strange[0]} is none of the runs {', '.join(by_location)}")
        return [(by_location[minuend], by_location[subtrahend]) for minuend, subtrahend in pairs]
    against = None if name is None else _run_called(name, runs)
    if against is not None:
        return [(run, against) for run in runs if run is not against and run.answers == against.answers]
    with_first = []
    for are_vlms in (True, False):
        alike = [run for run in runs if run.answers == are_vlms]
        with_first += [(subtrahend, alike[0]) for subtrahend in alike[1:]]
    return with_first


def _run_called(name: str, runs: Sequence[TableRun]) -> TableRun:
    ways: tuple[Callable[[TableRun], str], ...] = (
        lambda run: run.location,
        lambda run: run.name,
        lambda run: run.run.location.name,
        lambda run: run.run.label,
    )
    for called in ways:
        matches = [run for run in runs if called(run) == name.rstrip("/")]
        if len(matches) == 1:
            return matches[0]
    candidates = ", ".join(f"{run.run.location.name} ({run.name})" for run in runs)
    raise UsageError(f"--reference {name!r} is {'several' if matches else 'none'} of the runs {candidates}")


def _why_not(minuend: RunReader, subtrahend: RunReader, items: Mapping[str, CommonItems]) -> str:
    """Return the reason why two runs cannot be paired, in words that follow a colon; empty if they can."""
    for what, read in _SAME.items():
        mine, theirs = read(minuend), read(subtrahend)
        if None not in (mine, theirs) and mine != theirs:
            return f"other {what} ({mine} and {theirs})"
    if any(in_common.n_items for in_common in items.values()):
        return ""
    if minuend.suite != subtrahend.suite:
        hashed = has_item_content(minuend) and has_item_content(subtrahend)
        unknown = "" if hashed else ", without item hashes in both runs to pair items by"
        return f"other suites ({minuend.suite} and {subtrahend.suite}){unknown}"
    return "no item in common in any category" if items else "no category in common"


_SAME: Mapping[str, Callable[[RunReader], Any]] = {
    "seeds": lambda run: run.settings.get("seed"),
    "wordings": wording_of,
}
"""Settings that two runs must share for the episodes of an item to be the same questions; None where unknown."""
