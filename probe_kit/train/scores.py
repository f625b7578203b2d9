"""What out-of-fold decision values are worth: accuracy and its companions, and an interval."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.identity import derive_seed
from probe_kit.train.folds import Fold

Matrix = NDArray[np.float64]


def correctness(decisions: Matrix, labels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each episode is classified correctly; `decisions` and `labels` of one shape."""
    right: NDArray[np.bool_] = (decisions > 0) == labels
    return right


def balanced_accuracy(decisions: Matrix, labels: NDArray[np.bool_]) -> float:
    """Mean of the two classes' accuracies, for (E,) decisions."""
    right = correctness(decisions, labels)
    return float((right[labels].mean() + right[~labels].mean()) / 2)


def log_loss(decisions: Matrix, labels: NDArray[np.bool_]) -> Matrix:
    """Mean of −log P(label), in nats, over the first axis."""
    loss: Matrix = np.logaddexp(0.0, np.where(labels, -decisions, decisions)).mean(axis=0)
    return loss


def fold_auc(decisions: Matrix, labels: NDArray[np.bool_], folds: list[Fold]) -> float:
    """Area under the ROC curve within each test fold, averaged over folds that hold both classes.

    Within, because every fold's probe has its own scale and intercept.
    """
    areas = [
        _auc(decisions[fold.test], labels[fold.test]) for fold in folds if np.unique(labels[fold.test]).size == 2
    ]
    return float(np.mean(areas)) if areas else float("nan")


def _auc(decisions: Matrix, labels: NDArray[np.bool_]) -> float:
    above = decisions[labels][:, None] - decisions[~labels][None, :]
    return float((above > 0).mean() + 0.5 * (above == 0).mean())


def chance_level(labels: NDArray[np.bool_]) -> float:
    """Accuracy of always naming the larger class: 0.5 when both layouts of every item are there."""
    share = float(labels.mean())
    return max(share, 1 - share)


Bounds = tuple[float, float]
"""The least and the largest value a score can have."""

SHARES: Bounds = (0.0, 1.0)
GAINS: Bounds = (-1.0, 1.0)
"""What the difference of two shares can be."""
DRAWS = 2000


def group_bootstrap(
    values: NDArray[np.floating] | NDArray[np.bool_],
    groups: ArrayLike,
    seed: int,
    draws: int = DRAWS,
    bounds: Bounds = SHARES,
) -> tuple[Matrix, Matrix]:
    """95 % interval of the mean over episodes, with whole groups resampled.

    values: (E, S), a score per episode in each of S columns, within `bounds`. groups: (E,). Returns low and high,
    (S,) each. Where all groups of a column agree resampling has no width and would claim certainty; see `unseen`.
    """
    return interval(bootstrap_means(values, groups, seed, draws, bounds), values.mean(axis=0))


def interval(draws: Matrix, value: Matrix) -> tuple[Matrix, Matrix]:
    """95 % percentile interval of (B, S) draws, (S,) low and high; it holds the (S,) `value` itself."""
    low, high = np.percentile(draws, [2.5, 97.5], axis=0)
    return np.minimum(low, value), np.maximum(high, value)


def bootstrap_means(
    values: NDArray[np.floating] | NDArray[np.bool_],
    groups: ArrayLike,
    seed: int,
    draws: int = DRAWS,
    bounds: Bounds = SHARES,
) -> Matrix:
    """Means over episodes in every draw of whole groups, (draws, S) from (E, S) values and (E,) groups.

    The same names of groups and seed draw the same groups, whatever the values. A column whose groups all agree
    is drawn from what `unseen` groups may hold.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.zeros((names.size, values.shape[1]))
    np.add.at(sums, group_of, values.astype(np.float64))
    sizes = np.bincount(group_of).astype(np.float64)
    times = draw_groups(names.size, seed, draws)
    means: Matrix = (times @ sums) / (times @ sizes)[:, None]
    for column in np.flatnonzero(constant(means)):
        means[:, column] = unseen(float(means[0, column]), names.size, seed, draws, bounds)
    return means


def constant(draws: Matrix) -> NDArray[np.bool_]:
    """(S,) whether all (B, S) draws agree, up to rounding."""
    agree: NDArray[np.bool_] = np.ptp(draws, axis=0) < 1e-12
    return agree


def unseen(value: float, count: int, seed: int, draws: int = DRAWS, bounds: Bounds = SHARES) -> Matrix:
    """(draws,) means that `count` groups are consistent with that all have `value`.

    The share t of groups that are otherwise is Beta(1, count) given that none was seen: its 97.5 % point is that
    of Clopper and Pearson. They lie at either bound, by turns; at the value itself where that is a bound.
    """
    share = 1 - np.linspace(0, 1, draws) ** (1 / count)
    low, high = bounds
    ends = [end for end in (low, high) if abs(end - value) > 1e-9]
    end = np.resize(ends, draws)
    means: Matrix = value + share * (end - value)
    return np.random.default_rng(derive_seed("unseen", seed)).permutation(means)


def units_seed(names: ArrayLike, suite: str) -> int:
    """The seed by which groups or items of these names are drawn, wherever an interval is made of them.

    One number then has one interval, in whatever table it stands; and runs on the same units are paired.
    """
    return derive_seed("units", 0, suite, *np.unique(np.asarray(names)).tolist())


def draw_groups(count: int, seed: int, draws: int = DRAWS) -> NDArray[np.int64]:
    """How often each of `count` groups is drawn, (draws, count)."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)
