"""The probing problem of a label: samples, folds of groups, and exchanges of groups as label permutations."""

import warnings
from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import TooFewGroupsError
from probe_kit.hashing import derive_seed
from probe_kit.statistics.folds import OUTER_FOLDS, fold_numbers, stratified_folds
from probe_kit.statistics.label_permutations import exchange_blocks, movable_share, smallest_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.choices import Task
from probe_kit.train.crossval.nested_folds import NestedFold, nested_folds
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.data.samples import Samples
from probe_kit.train.labels.label_probe import LabelProbe, fit_label_probe
from probe_kit.train.labels.labelled_samples import LabelledSamples
from probe_kit.train.labels.labels import Labels
from probe_kit.train.solver.backend import to_numpy

LEAST_MOVABLE = 0.5
"""Share of the samples that must have another group to exchange with; below it there is no p."""


@dataclass(frozen=True)
class LabelProblem:
    """What all sites share. columns: (n, 1 + P) the labels, and every permutation of them."""

    target: str
    task: Task
    classes: tuple[str, ...]
    samples: LabelledSamples
    folds: list[NestedFold]
    columns: NDArray[np.float64]

    def probe(self, samples: Samples) -> LabelProbe:
        """The probe of n pooled samples, and of every label permutation."""
        return fit_label_probe(to_numpy(samples.features), self.columns, self.task, self.folds)

    def score(self, features: NDArray[np.floating]) -> LabelProbe:
        """The probe of (n, D) features, without label permutations."""
        return fit_label_probe(features, self.columns[:, :1], self.task, self.folds)

    @cached_property
    def fold_of(self) -> NDArray[np.int64]:
        """(n,) outer fold that tests a sample."""
        return fold_numbers([fold.outer for fold in self.folds])

    @property
    def smallest_p(self) -> float:
        """No p can be lower: the share of the labellings, real one included, that equal the real one."""
        same = (self.columns == self.columns[:, :1]).all(axis=0)
        return float(same.mean())


def label_problem(
    run: RunReader, labels: Labels, samples: LabelledSamples, permutations: int, seed: int
) -> LabelProblem:
    """The probing problem of `labels` on `samples`.

    Folds know strata and sizes of groups, not labels: only so is every exchange of labels as likely as the real
    ones. Raises TooFewGroupsError for fewer than five groups, a class in fewer than five, and a fold that is
    trained on one value.
    """
    _check_groups(labels, samples)
    folds = nested_folds(samples.strata, samples.groups, derive_seed("label folds", seed), stratified_folds)
    blocks, kinds = _blocks(run, samples)
    share = movable_share(blocks, kinds)
    if permutations and share < LEAST_MOVABLE:
        warnings.warn(
            f"label {labels.target!r}: {100 * share:.0f} % of the samples are in groups that have another one to "
            "exchange labels with; expected half or more, so there is no p. Groups exchange where they have the "
            "same layouts, labelled inferences and value of --exchange-within. Label the same inferences in every "
            "group, or leave groups with gaps out",
            stacklevel=3,
        )
        permutations = 0
    source = exchange_blocks(blocks, kinds, permutations, derive_seed("label exchanges", seed))
    columns = np.column_stack([samples.values, samples.values[source]])
    columns = columns[:, _trainable(columns, folds, labels)]
    problem = LabelProblem(labels.target, labels.task, labels.coded.classes, samples, folds, columns)
    if columns.shape[1] > 1 and (columns == columns[:, :1]).all():
        _warn_of_one_pattern(labels, samples, blocks)
    elif problem.smallest_p >= SIGNIFICANCE and problem.smallest_p > 1.001 * smallest_p(permutations):
        warnings.warn(
            f"label {labels.target!r}: its groups allow no p below {problem.smallest_p:.3f}, so nothing can be "
            f"below {SIGNIFICANCE}. Label more groups",
            stacklevel=3,
        )
    return problem


def _warn_of_one_pattern(labels: Labels, samples: LabelledSamples, blocks: dict[str, NDArray[np.intp]]) -> None:
    classes, first = labels.coded.classes, samples.values[next(iter(blocks.values()))].tolist()
    shown = [classes[int(value)] if classes else f"{value:g}" for value in first[:4]]
    more = ", …" if len(first) > len(shown) else ""
    warnings.warn(
        f"label {labels.target!r} is the same in every group: each of the {len(blocks)} groups holds "
        f"{', '.join(shown)}{more} in this order. Exchanging labels between groups changes nothing, so every "
        "p is 1. Give groups in which the label differs (--group-by; `groups` in Python), or a label that differs "
        "between the groups",
        stacklevel=4,
    )


def _check_groups(labels: Labels, samples: LabelledSamples) -> None:
    groups = np.unique(samples.groups)
    by = labels.group_by or "group_id"
    if groups.size < OUTER_FOLDS:
        raise TooFewGroupsError(
            f"label {labels.target!r}: {groups.size} groups ({by}) have labels; expected at least {OUTER_FOLDS}. "
            "Label more episodes, or give smaller groups (--group-by; `groups` in Python)"
        )
    for number, name in enumerate(labels.coded.classes):
        having = np.unique(samples.groups[samples.values == number]).size
        if having < OUTER_FOLDS:
            raise TooFewGroupsError(
                f"label {labels.target!r}: the class {name!r} is in {having} of {groups.size} groups ({by}); "
                f"expected at least {OUTER_FOLDS}. Label more episodes of it, merge it "
                "with another class, or leave its cells empty"
            )


def _blocks(
    run: RunReader, samples: LabelledSamples
) -> tuple[dict[str, NDArray[np.intp]], dict[str, tuple[Hashable, ...]]]:
    """The samples of every group in an order that corresponds between groups, and what makes two groups alike.

    Episodes correspond by their layout and labelled inferences, then by item.
    """
    places: dict[int, list[int]] = {}
    for position, row in enumerate(samples.rows.tolist()):
        places.setdefault(row, []).append(position)
    members: dict[str, list[int]] = {}
    for row, own in places.items():
        members.setdefault(str(samples.groups[own[0]]), []).append(row)
    table = run.episodes
    items = table["item_id" if "item_id" in table else "episode_id"].to_numpy(dtype=str)
    layouts = table["layout"].to_numpy(dtype=str) if "layout" in table else np.full(len(table), "")
    shown = {row: (str(layouts[row]), tuple(samples.steps[own].tolist())) for row, own in places.items()}
    blocks: dict[str, NDArray[np.intp]] = {}
    kinds: dict[str, tuple[Hashable, ...]] = {}
    for group, rows in members.items():
        by_item: dict[str, list[int]] = {}
        for row in rows:
            by_item.setdefault(str(items[row]), []).append(row)
        ordered = sorted((sorted((shown[row], row) for row in own), item) for item, own in by_item.items())
        chain: list[tuple[Any, int]] = [pair for own, _ in ordered for pair in own]
        blocks[group] = np.array([place for _, row in chain for place in places[row]], np.intp)
        stratum = str(samples.strata[blocks[group][0]])
        kinds[group] = stratum, tuple(tuple(look for look, _ in own) for own, _ in ordered)
    return blocks, kinds


def _trainable(columns: NDArray[np.float64], folds: list[NestedFold], labels: Labels) -> NDArray[np.bool_]:
    """(1 + P,) whether a labelling leaves no training fold with a single value. Raises TooFewGroupsError."""
    fine = np.ones(columns.shape[1], bool)
    for fold in folds:
        for one in (fold.outer, *fold.inner):
            fine &= np.ptp(columns[one.train], axis=0) > 0
    if not fine[0]:
        raise TooFewGroupsError(
            f"label {labels.target!r} is constant in a training fold, so there is nothing to learn; expected both "
            "values in most groups. Label more groups, or draw other folds with --seed"
        )
    return fine
