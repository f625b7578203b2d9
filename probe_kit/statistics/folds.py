"""Cross-validation folds that keep items with a shared picture together."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.counting import plural
from probe_kit.errors import TooFewGroupsError, UsageError

if TYPE_CHECKING:
    import pandas as pd

OUTER_FOLDS, INNER_FOLDS = 5, 4
"""Number of folds that score probes, and of folds of a training side that choose C.

Every fold needs a group of its own.
"""

SHARED_TRAINING = sqrt(1 + OUTER_FOLDS / (OUTER_FOLDS - 1))
"""Factor, 1.5, by which folds that share training groups widen the standard error of a held-out mean.

With K folds, the variance is 1/K + n_test/n_train in place of 1/K, which is 1 + K / (K − 1) times as much. See
Nadeau and Bengio, “Inference for the generalization error”, Machine Learning 52 (2003).
"""

FoldUnit = Literal["groups", "concepts"]
FOLD_UNITS: dict[str, str] = {
    "groups": "items that share a picture stay together",
    "concepts": "so do items about the same two concepts: no pair of the test fold was trained on",
}


@dataclass(frozen=True)
class Fold:
    """One split of the episodes: positions to train on and positions to test on."""

    train: NDArray[np.intp]
    test: NDArray[np.intp]


def grouped_folds(labels: ArrayLike, groups: ArrayLike, n_folds: int, seed: int) -> list[Fold]:
    """Make `n_folds` folds in which no group is split and every fold has nearly the same class shares.

    The same arguments give the same folds.

    Args:
        labels: (E,) class of every episode.
        groups: (E,) group of every episode. The layouts of an item, and all items that share a picture, are one
            group.
        n_folds: Number of folds.
        seed: Seed of the order in which groups of equal size are placed.

    Raises:
        TooFewGroupsError: If there are fewer groups than folds or a training side holds a single class.
    """
    fold_of = assign_folds(labels, groups, n_folds, seed)
    classes = np.unique(np.asarray(labels))
    folds = split_by_fold(fold_of, range(n_folds))
    if any(np.unique(np.asarray(labels)[fold.train]).size < max(2, classes.size) for fold in folds):
        raise TooFewGroupsError(
            f"{np.unique(np.asarray(groups)).size} groups leave a training fold with a single class; "
            f"{n_folds} folds need both classes in several groups each. "
            "Extract more items of this category."
        )
    return folds


def stratified_folds(strata: ArrayLike, groups: ArrayLike, n_folds: int, seed: int) -> list[Fold]:
    """Return `n_folds` folds of whole groups, balanced by stratum and size.

    Folds that do not depend on labels keep p-values exact where groups exchange labels. A training side may hold a
    single class.

    Args:
        strata: (E,) stratum of every episode.
        groups: (E,) group of every episode.
        n_folds: Number of folds.
        seed: Seed of the order in which groups of equal size are placed.

    Raises:
        TooFewGroupsError: If there are fewer groups than folds.
    """
    return split_by_fold(assign_folds(strata, groups, n_folds, seed), range(n_folds))


def split_by_fold(fold_of: NDArray[np.integer], numbers: Iterable[int]) -> list[Fold]:
    """Return the splits of (E,) fold numbers, one for each of `numbers`."""
    return [Fold(np.flatnonzero(fold_of != number), np.flatnonzero(fold_of == number)) for number in numbers]


def fold_numbers(folds: Sequence[Fold]) -> NDArray[np.int64]:
    """Return (E,) the number of the fold that tests an episode; `split_by_fold` makes the same folds from it."""
    fold_of = np.empty(folds[0].train.size + folds[0].test.size, np.int64)
    for number, fold in enumerate(folds):
        fold_of[fold.test] = number
    return fold_of


def fold_of_groups(fold_of: ArrayLike, groups: ArrayLike) -> NDArray[np.intp]:
    """Return the fold of each of G groups, sorted by their names, from the (E,) folds and groups of episodes."""
    folds: NDArray[np.intp] = np.asarray(fold_of, np.intp)[np.unique(np.asarray(groups), return_index=True)[1]]
    return folds


def sums_by_group(values: NDArray[np.floating], groups: ArrayLike) -> NDArray[np.float64]:
    """Return the sums (..., G) of values (..., E) over the episodes of each group, sorted by the groups' names."""
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    return np.asarray(values, np.float64) @ np.eye(names.size)[group_of]


def fold_units(episodes: "pd.DataFrame", unit: FoldUnit) -> NDArray[np.str_]:
    """Return (E,) the name of what folds must not separate: the group, or all groups about the same two concepts.

    Args:
        episodes: The run's episodes, with the column `group_id`. For concepts also `target_concept` and
            `distractor_concept`, whose order does not matter.
        unit: A key of FOLD_UNITS.

    Raises:
        UsageError: For an unknown unit or a missing column.
    """
    groups = episodes["group_id"].to_numpy(dtype=str)
    if unit == "groups":
        return groups
    if unit != "concepts":
        raise UsageError(f"unknown fold unit {unit!r}; expected one of {', '.join(FOLD_UNITS)}")
    columns = ["target_concept", "distractor_concept"]
    if not set(columns) <= set(episodes):
        raise UsageError(
            f"folds by concepts need the columns {' and '.join(columns)}, which these episodes lack. Use folds by "
            "groups, or add the columns."
        )
    concepts = np.sort(episodes[columns].to_numpy(dtype=str), axis=1)
    _, pair_of = np.unique(concepts, axis=0, return_inverse=True)
    return np.array([f"concepts-{component}" for component in _components(groups, pair_of.ravel())])


def _components(groups: NDArray[np.str_], pairs: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the connected component (E,) of every episode; a group or a pair of concepts in common connects."""
    from scipy.sparse import coo_array  # type: ignore[import-untyped]
    from scipy.sparse.csgraph import connected_components  # type: ignore[import-untyped]

    names, group_of = np.unique(groups, return_inverse=True)
    nodes = names.size + int(pairs.max()) + 1
    ties = coo_array((np.ones(pairs.size), (group_of, names.size + pairs)), shape=(nodes, nodes))
    component: NDArray[np.intp] = connected_components(ties, directed=False)[1][group_of].astype(np.intp)
    return component


def assign_folds(labels: ArrayLike, groups: ArrayLike, n_folds: int, seed: int) -> NDArray[np.intp]:
    """Return the fold of every episode, (E,) values 0 … n_folds − 1.

    Groups are placed one by one, the largest first, and those of equal size in an order drawn from `seed`. Each is
    placed in the fold where its classes are scarcest so far.

    Raises:
        TooFewGroupsError: If there are fewer groups than folds.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    if names.size < n_folds:
        raise TooFewGroupsError(
            f"{plural(names.size, 'independent group')} of items cannot fill {n_folds} folds: items that share a "
            "picture and both layouts of an item stay together. Extract more items of this category."
        )
    classes, class_of = np.unique(np.asarray(labels), return_inverse=True)
    counts = np.zeros((names.size, classes.size))
    np.add.at(counts, (group_of, class_of), 1)
    shares = counts / counts.sum(axis=0)

    drawn = np.random.default_rng(seed).permutation(names.size)
    order = drawn[np.argsort(-counts.sum(axis=1)[drawn], kind="stable")]
    filled = np.zeros((n_folds, classes.size))
    fold_of_group = np.empty(names.size, dtype=np.intp)
    for group in order:
        scarcity = np.round(filled @ shares[group], 12)  # rounded, so that ties do not hang on summation order
        fold = np.lexsort((filled.sum(axis=1), scarcity))[0]  # by scarcity, its last key; of equals the emptiest
        fold_of_group[group] = fold
        filled[fold] += shares[group]
    return fold_of_group[group_of]
