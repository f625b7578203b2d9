"""A score for each sample whose mean over samples is the metric of a task.

| task | score of sample i | mean |
|---|---|---|
| binary, classes | 1[prediction = label] / (K π), with K classes and the label's share π | balanced accuracy |
| continuous | 1 − (y − ŷ)² / mean (y − ȳ)², ȳ the mean of the fold's training labels | R² |
"""

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.statistics.bootstrap import explained_interval
from probe_kit.statistics.folds import SHARED_TRAINING, Fold
from probe_kit.statistics.intervals import Accuracy
from probe_kit.train.choices import Task

METRICS: dict[Task, str] = {"binary": "balanced accuracy", "classes": "balanced accuracy", "continuous": "R²"}


def balanced_scores(predicted: Matrix, truth: Matrix) -> Matrix:
    """Return the scores (n, K) of predicted classes (n, K); every column of truth has each class as often."""
    scores: Matrix = (predicted == truth) * class_weights(truth)
    return scores


def class_weights(labels: NDArray[np.floating]) -> Matrix:
    """Return the weights 1 / (K π) of coded labels (n,), with K classes and the label's share π.

    Labels may also be (n, K) columns, each of which has each class as often.
    """
    classes, counts = np.unique(labels.reshape(len(labels), -1)[:, 0], return_counts=True)
    weights: Matrix = (1 / (classes.size * (counts / len(labels))))[np.searchsorted(classes, labels)]
    return weights


def explained_scores(predicted: Matrix, truth: Matrix, folds: list[Fold]) -> Matrix:
    """Return the scores (n, K) of predicted quantities (n, K)."""
    scores: Matrix = 1 - (truth - predicted) ** 2 / squared_deviations(truth, folds).mean(axis=0)
    return scores


def squared_deviations(truth: Matrix, folds: list[Fold]) -> Matrix:
    """Return the squared deviations (n, K) of quantities from the mean of their fold's training labels."""
    deviations = np.empty_like(truth)
    for fold in folds:
        deviations[fold.test] = (truth[fold.test] - truth[fold.train].mean(axis=0)) ** 2
    return deviations


def fold_spearman(predicted: Matrix, truth: Matrix, folds: list[Fold]) -> float:
    """Return Spearman's ρ of (n,) predictions and labels within test folds, averaged; NaN where neither varies.

    It is taken within folds, because every fold's probe has its own mean.
    """
    from scipy.stats import rankdata  # type: ignore[import-untyped]

    correlations = []
    for fold in folds:
        ranks = [rankdata(values[fold.test]) for values in (predicted, truth)]
        if all(np.ptp(rank) > 0 for rank in ranks):
            correlations.append(float(np.corrcoef(*ranks)[0, 1]))
    return float(np.mean(correlations)) if correlations else float("nan")


def score_interval(
    scores: Matrix,
    labels: Matrix,
    groups: NDArray[np.str_],
    task: Task,
    deviations: Matrix | None = None,
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of (n,) scores, groups as the unit.

    Balanced accuracy has Wilson's interval (`Accuracy`), R² that of `explained_interval`, which is approximate.

    Args:
        scores: (n,) scores of the samples, see the module.
        labels: (n,) coded labels.
        groups: (n,) group of every sample.
        task: Task of the labels, which decides the metric.
        deviations: (n,) squared deviations of a quantity from the mean of its fold's training labels. None for a
            probe that was fitted elsewhere, whose R² compares with the mean of these labels.
    """
    if task == "continuous":
        if deviations is None:
            return explained_interval(scores, (labels - labels.mean()) ** 2, groups)
        return explained_interval(scores, deviations, groups, SHARED_TRAINING)
    weights = class_weights(labels)
    interval = Accuracy.of((scores / weights).clip(0, 1), groups, weights).interval()
    return interval.low, interval.high


# -- of sides: decision values of two classes ---------------------------------------------------------------


def correctness(decisions: Matrix, labels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return for each episode whether it is classified correctly; `decisions` and `labels` are of one shape."""
    right: NDArray[np.bool_] = (decisions > 0) == labels
    return right


def log_loss(decisions: Matrix, labels: NDArray[np.bool_]) -> Matrix:
    """Return the mean of −log P(label), in nats, over the first axis."""
    loss: Matrix = log_losses(decisions, labels).mean(axis=0)
    return loss


def log_losses(decisions: Matrix, labels: NDArray[np.bool_]) -> Matrix:
    """Return −log P(label), in nats, of decisions and labels of one shape."""
    losses: Matrix = np.logaddexp(0.0, np.where(labels, -decisions, decisions))
    return losses


def fold_auc(decisions: Matrix, labels: NDArray[np.bool_], folds: list[Fold]) -> float:
    """Return the area under the ROC curve within each test fold, averaged over folds that hold both classes.

    It is taken within folds, because every fold's probe has its own scale and intercept.
    """
    areas = [
        _auc(decisions[fold.test], labels[fold.test]) for fold in folds if np.unique(labels[fold.test]).size == 2
    ]
    return float(np.mean(areas)) if areas else float("nan")


def _auc(decisions: Matrix, labels: NDArray[np.bool_]) -> float:
    above = decisions[labels][:, None] - decisions[~labels][None, :]
    return float((above > 0).mean() + 0.5 * (above == 0).mean())


def chance_level(labels: NDArray[np.bool_]) -> float:
    """Return the accuracy of always naming the larger class: 0.5 when both layouts of every item are there."""
    share = float(labels.mean())
    return max(share, 1 - share)
