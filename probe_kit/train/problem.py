"""The probing problem of a category: samples, labels, folds, label permutations."""

import warnings
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.layout import START
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.folds import OUTER_FOLDS, fold_numbers, fold_units, stratified_folds, sums_by_group
from probe_kit.statistics.label_permutations import (
    exchange_blocks,
    exchange_groups,
    flip_groups,
    movable_share,
    shortage,
    smallest_p,
)
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.choices import EVERYWHERE, Task
from probe_kit.train.crossval.nested_folds import NestedFold, nested_folds
from probe_kit.train.crossval.site_probe import SiteProbe, probe_site
from probe_kit.train.crossval.task_scores import chance_level
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeSettings
from probe_kit.train.samples import Samples
from probe_kit.train.target import Target
from probe_kit.train.target_samples import GROUP, TargetSamples, dependent_episodes

# Choices, not measurements: stricter ones refuse runs with a few gaps, laxer ones give a p to few free labels.
MOST_OF_ONE_SIDE = 0.75
"""Share of episodes with the same correct side above which a category is refused; it is 0.5 if none is missing."""
LEAST_MOVABLE = 0.5
"""Share of the samples that must have another group to exchange with; below it there is no p."""


@dataclass(frozen=True)
class Problem:
    """The samples, labels, folds and label permutations that all sites of a category share.

    E counts the samples: episodes, or inferences where each has a label.

    Attributes:
        balanced: Whether accuracies are balanced between two sides, see `Target`.
        classes: Names of the classes, empty for a quantity.
        positions: (E,) places of the category's samples among those of the target.
        samples: The samples of the category.
        episodes: (E,) episode of every sample.
        items: (E,) item of every sample.
        folds: Nested folds that all sites share.
        labels: (E,) bool of a side (true: left), else coded.
        permuted_labels: (E, P) labels under P permutations.
        token_permutations: Number of permutations that are fitted where every token is a sample.
    """

    task: Task
    balanced: bool
    classes: tuple[str, ...]
    positions: NDArray[np.intp]
    samples: TargetSamples
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    labels: NDArray[Any]
    permuted_labels: NDArray[Any]
    folds: list[NestedFold]
    token_permutations: int = 0

    @property
    def groups(self) -> NDArray[np.str_]:
        """The group of every sample, (E,)."""
        return self.samples.groups

    @cached_property
    def fold_of(self) -> NDArray[np.int64]:
        """The outer fold that tests each sample, (E,)."""
        return fold_numbers([fold.outer for fold in self.folds])

    def probe(self, samples: Samples) -> SiteProbe:
        """Probe one site; `samples` are those of all samples of the target."""
        return self.fit(samples.of(self.positions), self.permuted_for(samples))

    def permuted_for(self, samples: Samples) -> NDArray[Any]:
        """Return the permuted labels (E, P) that a view is probed with: fewer where every token is a sample."""
        return self.permuted_labels if samples.pools else self.permuted_labels[:, : self.token_permutations]

    def fit(self, samples: Samples, permuted_labels: NDArray[Any] | None = None) -> SiteProbe:
        """Probe the samples of this category, and again for every column of (E, P) permuted labels."""
        permuted = self.permuted_labels[:, :0] if permuted_labels is None else permuted_labels
        return probe_site(samples, self.labels, permuted, self.folds, None if self.balanced else self.task)

    def curve(self, probes: Mapping[Site, SiteProbe], parts: tuple[str, ...] = ()) -> ProbeCurve:
        """Return the curve of the probes of some sites, in order."""
        fitted = list(probes.values())
        return ProbeCurve(
            sites=tuple(probes),
            labels=self.labels,
            episodes=self.episodes,
            items=self.items,
            groups=self.groups,
            fold_of=self.fold_of,
            decisions=np.stack([probe.decisions for probe in fitted]),
            strengths=np.stack([probe.strengths for probe in fitted]),
            null=np.stack([probe.null for probe in fitted]),
            inner=np.stack([sums_by_group(probe.inner, self.groups) for probe in fitted]).astype(np.float32),
            parts=parts,
            task=self.task,
            balanced=self.balanced,
            classes=self.classes,
            sample_scores=None if self.balanced else np.stack([probe.scores for probe in fitted]),
            inferences=self.samples.inferences.astype(np.int64),
            aligned=None if self.samples.aligned is None else self.samples.aligned.astype(np.int64),
            # As many permutations as were fitted: fewer where every token is a sample.
            smallest_p=None
            if self.balanced
            else smallest_p_of_labels(self.labels, self.permuted_labels[:, : fitted[0].null.size]),
        )

    def control_curve(self, probes: Sequence[SiteProbe]) -> ProbeCurve:
        """Return the curve of the probes of a control, at placeholder sites of the stream `control`."""
        return self.curve({Site("control", number): probe for number, probe in enumerate(probes)})


def make_problem(
    run: RunReader, target: Target, samples: TargetSamples, category: str, settings: ProbeSettings
) -> Problem:
    """Return the probing problem of one category, or of all samples for `all`.

    Raises:
        TooFewGroupsError: For fewer independent groups than folds, a class in too few groups, or a constant
            training fold.
        UnbalancedEpisodesError: For a side of which one is correct in more than `MOST_OF_ONE_SIDE` of the
            episodes.
        UsageError: For concept folds of episodes without concepts.
    """
    of_category = run.episodes["category"].to_numpy(dtype=str)[samples.rows] == category
    positions = np.flatnonzero(of_category | (category == EVERYWHERE))
    subset = samples.of(positions)
    table = run.episodes.iloc[subset.rows]
    if settings.folds != "groups":
        subset = replace(subset, groups=fold_units(table, settings.folds))
    # Of all categories together a class without samples is an error, of one category it is another's.
    pooled = target.balanced or category == EVERYWHERE
    coded = replace(target.coded, values=subset.values) if pooled else target.coded.of_values(subset.values)
    labels: NDArray[Any] = coded.values == 1 if target.balanced else coded.values
    draw = _side_folds_and_permutations if target.balanced else _block_folds_and_permutations
    folds, permuted = draw(run, replace(target, coded=coded), subset, labels, category, settings)
    return Problem(
        task=target.task,
        balanced=target.balanced,
        classes=coded.classes,
        positions=positions,
        samples=subset,
        episodes=table["episode_id"].to_numpy(dtype=str),
        items=table["item_id" if "item_id" in table else "episode_id"].to_numpy(dtype=str),
        labels=labels,
        permuted_labels=permuted,
        folds=folds,
        token_permutations=settings.token_permutations,
    )


def smallest_p_of_labels(labels: NDArray[Any], permuted_labels: NDArray[Any]) -> float:
    """Return the share of labellings, permuted (E, P) or real (E,), that equal the real one: no p is lower."""
    same = (permuted_labels == labels[:, None]).all(axis=0)
    return float((1 + same.sum()) / (1 + same.size))


Drawn = tuple[list[NestedFold], NDArray[Any]]
"""The folds, and permuted labels (E, P)."""


# -- the side of a picture -------------------------------------------------------------------------------------


def _side_folds_and_permutations(
    run: RunReader, target: Target, samples: TargetSamples, labels: NDArray[Any], category: str,
    settings: ProbeSettings,
) -> Drawn:  # fmt: skip
    """Return folds balanced by side, or by layout for `side.chosen`, and the permuted labels.

    Groups flip their sides in a permutation; of `side.chosen` they exchange them.

    Raises:
        TooFewGroupsError: For too few groups, and for chosen sides of which a training fold holds one only.
        UnbalancedEpisodesError: If one side is correct in more than `MOST_OF_ONE_SIDE` of the episodes.
    """
    table, groups = run.episodes.iloc[samples.rows], samples.groups
    if settings.call > 0 and groups.size == 0:
        raise TooFewGroupsError(f"category {category!r}: {_why_fewer(0, settings.call)}")
    if target.null == "flip_groups":
        _check_balance(labels, category, settings.call)
    seed = derive_seed("folds", settings.seed, category)
    try:
        if target.null == "flip_groups":
            folds = nested_folds(labels, groups, seed)
        else:
            # Groups exchange their chosen sides, so folds that knew the real ones would make them easier than any
            # exchange: these are balanced by layout.
            folds = nested_folds(table["layout"].to_numpy(dtype=str), groups, seed, stratified_folds)
            shares = [labels[inner.train].mean() for fold in folds for inner in fold.inner]
            if min(shares) == 0 or max(shares) == 1:
                raise TooFewGroupsError(
                    f"{labels.sum()} of {labels.size} episodes chose the left side, and a training fold holds one "
                    "side only; expected both in several groups. Extract more items of this category"
                )
    except TooFewGroupsError as error:
        if settings.call > 0:
            reason = (
                f"{_why_fewer(labels.size, settings.call)}: {np.unique(groups).size} independent groups of items"
            )
            raise TooFewGroupsError(f"category {category!r}: {reason}, too few for folds") from error
        raise TooFewGroupsError(f"category {category!r}, target {settings.target!r}: {error}") from error
    seed = derive_seed("relabelling", settings.seed, category)
    count = max(settings.permutations, settings.token_permutations)
    if target.null == "exchange_groups":
        drawn = exchange_groups(labels, groups, table["item_id"], table["layout"], count, seed)
    else:
        drawn = flip_groups(labels, groups, count, seed)
    # Permutations that leave a training fold with a single class have no probe.
    permuted = np.array([drawn[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    drawn = drawn[:, ((permuted > 0) & (permuted < 1)).all(axis=0)]
    smallest = smallest_p(drawn.shape[1])
    if shortage(smallest, settings.permutations) == "groups":
        warnings.warn(
            f"category {category!r}: its groups allow {drawn.shape[1]} label permutations, the smallest possible "
            f"p is {smallest:.3f}: nothing can be below {SIGNIFICANCE}. Extract more items.",
            stacklevel=3,
        )
    return folds, drawn


def _check_balance(labels: NDArray[np.bool_], category: str, call: int) -> None:
    """Warn of sides that are not equally often correct.

    Raises:
        UnbalancedEpisodesError: If one side is correct in more than `MOST_OF_ONE_SIDE` of the episodes.
    """
    share = chance_level(labels) if labels.size else 0.5
    if share == 0.5:
        return
    why = "Episodes are missing from the run" if call == 0 else _why_fewer(labels.size, call)
    finding = (
        f"category {category!r}: classes are not balanced, chance is {share:.3f}; expected 0.5 with both layouts "
        f"of every item. {why}."
    )
    pair = "leave out the other layout of their items (--incomplete drop, incomplete='drop')."
    if share > MOST_OF_ONE_SIDE:
        instead = "Extract the missing episodes again" if call == 0 else "Probe an earlier inference (--call)"
        raise UnbalancedEpisodesError(
            f"{finding} Beyond {MOST_OF_ONE_SIDE} nothing is left to be read. {instead}, or {pair}"
        )
    warnings.warn(f"{finding} Leave out the other layout of their items with incomplete='drop'.", stacklevel=4)


def _why_fewer(episodes: int, call: int) -> str:
    """Return why there are no more episodes at a later inference."""
    number = {0: "no episode", 1: "only 1 episode"}.get(episodes, f"only {episodes} episodes")
    return f"{number} got as far as captured inference {call}, counted from 0, and the others ended before"


# -- every other target ------------------------------------------------------------------------------------------


def _block_folds_and_permutations(
    run: RunReader, target: Target, samples: TargetSamples, labels: NDArray[Any], category: str,
    settings: ProbeSettings,
) -> Drawn:  # fmt: skip
    """Return the folds, and the labels of groups that exchange them as blocks.

    Folds are drawn from strata and sizes of groups, not from labels: only so is every exchange of labels as likely
    as the real ones.

    Raises:
        TooFewGroupsError: For fewer than five groups, a class in fewer than five, and a fold that is trained on
            one value.
    """
    name = f"label {target.name!r}" + (f", category {category!r}" if category != EVERYWHERE else "")
    classes = target.coded.classes
    if len(classes) == 1:
        raise TooFewGroupsError(
            f"{name} has one class, {classes[0]!r}; expected two or more. Leave the category out"
        )
    _check_groups(name, run, target, labels, classes, samples)
    warn_of_equal_starts(name, run, target, samples)
    scope = () if category == EVERYWHERE else (category,)
    seed = derive_seed("label folds", settings.seed, *scope)
    folds = nested_folds(samples.strata, samples.groups, seed, stratified_folds)
    blocks, kinds = _blocks(run, samples)
    permutations, share = max(settings.permutations, settings.token_permutations), movable_share(blocks, kinds)
    if permutations and share < LEAST_MOVABLE:
        warnings.warn(
            f"{name}: {100 * share:.0f} % of the samples are in groups that have another one to "
            "exchange labels with; expected half or more, so there is no p. Groups exchange where they have the "
            "same layouts, labelled inferences and value of --exchange-within. Label the same inferences in every "
            "group, or leave groups with gaps out",
            stacklevel=3,
        )
        permutations = 0
    source = exchange_blocks(blocks, kinds, permutations, derive_seed("label exchanges", settings.seed, *scope))
    columns = np.column_stack([labels, labels[source]])
    # An exchange that leaves a training fold with one value has no probe. The real labels are column 0, and stay.
    is_fit = np.ones(columns.shape[1], bool)
    for fold in folds:
        for split in (fold.outer, *fold.inner):
            is_fit &= np.ptp(columns[split.train], axis=0) > 0
    if not is_fit[0]:
        raise TooFewGroupsError(
            f"{name} is constant in a training fold, so there is nothing to learn; expected both "
            "values in most groups. Label more groups, or draw other folds with --seed"
        )
    columns = columns[:, is_fit]
    smallest = smallest_p_of_labels(columns[:, 0], columns[:, 1:])
    if columns.shape[1] > 1 and (columns == columns[:, :1]).all():
        first = labels[next(iter(blocks.values()))].tolist()
        listed = [classes[int(value)] if classes else f"{value:g}" for value in first[:4]]
        more = ", …" if len(first) > len(listed) else ""
        warnings.warn(
            f"{name} is the same in every group: each of the {len(blocks)} groups holds "
            f"{', '.join(listed)}{more} in this order. Exchanging labels between groups changes nothing, so every "
            "p is 1. Give groups in which the label differs (--group-by; `groups` in Python), or a label that "
            "differs between the groups",
            stacklevel=3,
        )
    elif shortage(smallest, permutations) == "groups":
        warnings.warn(
            f"{name}: its groups allow no p below {smallest:.3f}, so nothing can be below {SIGNIFICANCE}. Label "
            "more groups",
            stacklevel=3,
        )
    return folds, columns[:, 1:]


def _check_groups(
    name: str, run: RunReader, target: Target, labels: Matrix, classes: tuple[str, ...], samples: TargetSamples
) -> None:
    groups = samples.groups
    count, by = np.unique(groups).size, target.group_by or GROUP
    if count < OUTER_FOLDS:
        column, independent = dependent_episodes(run)
        smaller = np.unique(independent[samples.rows]).size
        advice = "Label episodes of other groups"
        if smaller >= OUTER_FOLDS and column != by:
            advice += f", or give --group-by {column}, which has {smaller} groups here"
        raise TooFewGroupsError(
            f"{name}: {count} groups ({by}) have labels; expected at least {OUTER_FOLDS}. {advice}"
        )
    for number, of_class in enumerate(classes):
        having = np.unique(groups[labels == number]).size
        if having < OUTER_FOLDS:
            raise TooFewGroupsError(
                f"{name}: the class {of_class!r} is in {having} of {count} groups ({by}); "
                f"expected at least {OUTER_FOLDS}. Label more episodes of it, merge it "
                "with another class, or leave its cells empty"
            )


def warn_of_equal_starts(name: str, run: RunReader, target: Target, samples: TargetSamples) -> None:
    """Warn where groups of an environment hold episodes that start with the same observation."""
    column, starts = dependent_episodes(run)
    if column != START or target.group_by is not None:
        return
    by_start: dict[str, set[str]] = {}
    for start, group in zip(starts[samples.rows].tolist(), samples.groups.tolist(), strict=True):
        by_start.setdefault(start, set()).add(group)
    shared = sum(len(groups) for groups in by_start.values() if len(groups) > 1)
    if shared:
        warnings.warn(
            f"{name}: {shared} groups start with the same observation as another one, so that they depend on each "
            f"other and p is too small. Give --group-by {START}: episodes of one start are then a group, "
            f"{len(by_start)} in all",
            stacklevel=4,
        )


def _blocks(
    run: RunReader, samples: TargetSamples
) -> tuple[dict[str, NDArray[np.intp]], dict[str, tuple[Hashable, ...]]]:
    """Return the samples of every group in an order that corresponds between groups, and each group's kind.

    Groups of one kind can exchange labels. Episodes correspond by their layout and labelled inferences, then by
    item.
    """
    positions_of: dict[int, list[int]] = {}
    for position, row in enumerate(samples.rows.tolist()):
        positions_of.setdefault(row, []).append(position)
    members: dict[str, list[int]] = {}
    for row, positions in positions_of.items():
        members.setdefault(str(samples.groups[positions[0]]), []).append(row)
    table = run.episodes
    items = table["item_id" if "item_id" in table else "episode_id"].to_numpy(dtype=str)
    layouts = table["layout"].to_numpy(dtype=str) if "layout" in table else np.full(len(table), "")
    looks = {row: (str(layouts[row]), tuple(samples.steps[at].tolist())) for row, at in positions_of.items()}
    blocks: dict[str, NDArray[np.intp]] = {}
    kinds: dict[str, tuple[Hashable, ...]] = {}
    for group, rows in members.items():
        by_item: dict[str, list[int]] = {}
        for row in rows:
            by_item.setdefault(str(items[row]), []).append(row)
        # By look first, so that the n-th sample of one group corresponds to the n-th of another.
        ordered = sorted((sorted((looks[row], row) for row in of_item), item) for item, of_item in by_item.items())
        chain: list[tuple[Any, int]] = [pair for pairs, _ in ordered for pair in pairs]
        blocks[group] = np.array([position for _, row in chain for position in positions_of[row]], np.intp)
        stratum = str(samples.strata[blocks[group][0]])
        kinds[group] = stratum, tuple(tuple(look for look, _ in pairs) for pairs, _ in ordered)
    return blocks, kinds
