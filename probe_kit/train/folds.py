"""Folds that keep everything that shares a picture together."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.errors import TooFewGroupsError


@dataclass(frozen=True)
class Fold:
    """One split of the episodes: positions to train on and positions to test on."""

    train: NDArray[np.intp]
    test: NDArray[np.intp]


def grouped_folds(labels: ArrayLike, groups: ArrayLike, n_folds: int, seed: int) -> list[Fold]:
    """`n_folds` folds in which no group is split and every fold has nearly the same class shares.

    labels: (E,) class of every episode. groups: (E,) group of every episode; the layouts of an item, and all
    items that share a picture, are one group. Same arguments, same folds.
    Raises TooFewGroupsError if there are fewer groups than folds or a training side holds a single class.
    """
    fold_of = assign_folds(labels, groups, n_folds, seed)
    classes = np.unique(np.asarray(labels))
    folds = [Fold(np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)) for fold in range(n_folds)]
    if any(np.unique(np.asarray(labels)[fold.train]).size < max(2, classes.size) for fold in folds):
        raise TooFewGroupsError(
            f"{np.unique(np.asarray(groups)).size} groups leave a training fold with a single class; "
            f"{n_folds} folds need both classes in several groups each. "
            "Extract more items of this category."
        )
    return folds


def assign_folds(labels: ArrayLike, groups: ArrayLike, n_folds: int, seed: int) -> NDArray[np.intp]:
    """The fold of every episode, (E,) values 0 … n_folds − 1.

    Groups are placed one by one, the largest first and equals in an order drawn from `seed`, each where its
    classes are scarcest so far. Raises TooFewGroupsError if there are fewer groups than folds.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    if names.size < n_folds:
        raise TooFewGroupsError(
            f"{names.size} independent groups of items cannot fill {n_folds} folds: items that share a "
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
        fold = np.lexsort((filled.sum(axis=1), scarcity))[0]
        fold_of_group[group] = fold
        filled[fold] += shares[group]
    return fold_of_group[group_of]
