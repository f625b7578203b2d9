"""What out-of-fold decision values are worth: accuracy and its companions, and an interval."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def group_bootstrap(
    values: NDArray[np.floating] | NDArray[np.bool_], groups: ArrayLike, seed: int, draws: int = 2000
) -> tuple[Matrix, Matrix]:
    """95 % percentile interval of the mean over episodes, with whole groups resampled.

    values: (E, S), a score per episode in each of S columns. groups: (E,). Returns low and high, (S,) each.
    Where all of a column's truth values agree, resampling has no width and would claim certainty: there it is
    Clopper and Pearson's interval, with a group as one trial.
    """
    low, high = np.percentile(bootstrap_means(values, groups, seed, draws), [2.5, 97.5], axis=0)
    if values.dtype == np.bool_:
        reach = 0.025 ** (1 / np.unique(np.asarray(groups)).size)
        low = np.where(values.all(axis=0), reach, low)
        high = np.where(values.any(axis=0), high, 1 - reach)
    return low, high


def bootstrap_means(
    values: NDArray[np.floating] | NDArray[np.bool_], groups: ArrayLike, seed: int, draws: int = 2000
) -> Matrix:
    """Means over episodes in every draw of whole groups, (draws, S) from (E, S) values and (E,) groups.

    The same names of groups and seed draw the same groups, whatever the values.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.zeros((names.size, values.shape[1]))
    np.add.at(sums, group_of, values.astype(np.float64))
    sizes = np.bincount(group_of).astype(np.float64)
    times = draw_groups(names.size, seed, draws)
    means: Matrix = (times @ sums) / (times @ sizes)[:, None]
    return means


def draw_groups(count: int, seed: int, draws: int = 2000) -> NDArray[np.int64]:
    """How often each of `count` groups is drawn, (draws, count)."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)
