"""Metrics of out-of-fold decision values: accuracy, AUC and others, with an interval."""

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.folds import Fold

Matrix = NDArray[np.float64]


def correctness(decisions: Matrix, labels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return for each episode whether it is classified correctly; `decisions` and `labels` are of one shape."""
    right: NDArray[np.bool_] = (decisions > 0) == labels
    return right


def log_loss(decisions: Matrix, labels: NDArray[np.bool_]) -> Matrix:
    """Mean of −log P(label), in nats, over the first axis."""
    loss: Matrix = log_losses(decisions, labels).mean(axis=0)
    return loss


def log_losses(decisions: Matrix, labels: NDArray[np.bool_]) -> Matrix:
    """Return −log P(label), in nats, of decisions and labels of one shape."""
    losses: Matrix = np.logaddexp(0.0, np.where(labels, -decisions, decisions))
    return losses


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
