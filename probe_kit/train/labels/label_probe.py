"""The probe of one feature matrix for a label and all its permutations: nested cross-validation by groups."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.folds import Fold
from probe_kit.train.choices import Task
from probe_kit.train.crossval.nested_folds import InnerQuality, NestedFold
from probe_kit.train.crossval.site_probe import cross_validate
from probe_kit.train.data.samples import Samples
from probe_kit.train.labels.task_scores import balanced_scores, explained_scores
from probe_kit.train.solver.ridge import PENALTIES, RidgeFold

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LabelProbe:
    """Held-out predictions for n samples, and what label permutations reach.

    predictions: (n,) class numbers or quantities. scores: (n,), their mean is the metric. null: (P,) metric of
    every permutation. penalties: (F,) of each outer fold: λ of ridge, 1 / C of a binary label. inner: (F, n)
    quality of each sample's prediction in the inner folds of each outer fold, by which penalties are chosen, the
    larger the better, minus the mean of the permutations'; 0 for the samples that the outer fold tests.
    """

    predictions: Matrix
    scores: Matrix
    null: Matrix
    penalties: Matrix
    inner: Matrix

    @property
    def metric(self) -> float:
        """Balanced accuracy or R²."""
        return float(self.scores.mean())


def fit_label_probe(
    features: NDArray[np.floating], labels: Matrix, task: Task, folds: list[NestedFold]
) -> LabelProbe:
    """Probe (n, D) features for the first of (n, 1 + P) label columns, and for the permutations behind it.

    Raises ProbeNotConvergedError for a binary label.
    """
    labels, place = _distinct(labels)
    outer = [fold.outer for fold in folds]
    predictions, penalties, inner = _fit_of(task)(features, labels, folds)
    if task == "continuous":
        scores = explained_scores(predictions, labels, outer)
    else:
        scores = balanced_scores(predictions, labels)
    above = np.stack([
        _above_permutations(one, place[1:], fold.outer.train) for one, fold in zip(inner, folds, strict=True)
    ])  # fmt: skip
    return LabelProbe(predictions[:, 0], scores[:, 0], scores.mean(axis=0)[place[1:]], penalties, above)


def predict_once(
    features: NDArray[np.floating], labels: Matrix, task: Task, fold: NestedFold
) -> tuple[Matrix, float]:
    """Predictions (m,) for the test samples of one outer fold, and its penalty as in `LabelProbe`.

    features: (n, D). labels: (n,); those of test samples have no effect. Raises ProbeNotConvergedError.
    """
    predictions, penalties, _ = _fit_of(task)(features, labels[:, None], [fold])
    return predictions[fold.outer.test, 0], float(penalties[0])


def _above_permutations(inner: InnerQuality, columns: NDArray[np.intp], train: NDArray[np.intp]) -> Matrix:
    """(n,) of the first column minus the mean over `columns`, of which every training sample bears a share.

    Sites differ in what they reach with exchanged labels. Without permutations nothing is subtracted.
    """
    found = inner.first.copy()
    if columns.size:
        found[train] -= inner.total[columns].mean() / train.size
    return found


Fitted = tuple[Matrix, Matrix, list[InnerQuality]]
"""(n, K) held-out predictions, (F,) penalties of the first column, and the inner quality of every outer fold."""


def _fit_of(task: Task) -> Callable[[NDArray[np.floating], Matrix, list[NestedFold]], Fitted]:
    return {"binary": _logistic, "classes": _indicators, "continuous": _ridge}[task]


def _distinct(labels: Matrix) -> tuple[Matrix, NDArray[np.intp]]:
    """The different columns of (n, K) labels, the first one first, and the place of every column among them.

    Labels that are constant in a group have few different permutations.
    """
    first: dict[bytes, int] = {}
    place = [first.setdefault(column.tobytes(), len(first)) for column in labels.T.copy()]
    kept = [place.index(number) for number in range(len(first))]
    return labels[:, kept], np.array(place, np.intp)


def _logistic(features: NDArray[np.floating], labels: Matrix, folds: list[NestedFold]) -> Fitted:
    """The side probes' logistic regression, without what its intercept learns from unequal classes."""
    truth = labels == 1
    predictions, penalties, inner = np.empty_like(labels), [], []
    samples = Samples.pooled(features)
    for fold, fitted in zip(folds, cross_validate(samples, truth, folds), strict=True):
        share = truth[fold.outer.train].mean(axis=0)
        predictions[fold.outer.test] = fitted.decisions > np.log(share / (1 - share))
        penalties.append(1 / fitted.strengths[0])
        inner.append(fitted.inner)
    return predictions, np.array(penalties), inner


def _ridge(features: NDArray[np.floating], labels: Matrix, folds: list[NestedFold]) -> Fitted:
    """Ridge within the range of the training labels; λ by squared error."""
    return _nested(
        labels,
        folds,
        lambda fold: _quantities(features, labels, fold),
        lambda truth: lambda predicted: -((truth - predicted) ** 2),
    )


def _indicators(features: NDArray[np.floating], labels: Matrix, folds: list[NestedFold]) -> Fitted:
    """Ridge on class indicators, the best class; λ by balanced accuracy."""
    classes = int(labels.max()) + 1

    def gain(truth: Matrix) -> Gain:
        worth = _worth(truth, classes)
        return lambda predicted: (predicted == truth) * worth

    return _nested(labels, folds, lambda fold: _best_classes(features, labels, classes, fold), gain)


Gain = Callable[[Matrix], Matrix]
"""How good every one of (m, K) predictions of a test fold is."""


def _nested(
    labels: Matrix,
    folds: list[NestedFold],
    predict: Callable[[Fold], Iterator[Matrix]],
    gain_of: Callable[[Matrix], Gain],
) -> Fitted:
    """Return held-out predictions, each column of an outer fold at the λ that is best in its inner folds.

    predict: predictions (m, K) of a fold at each penalty.
    """
    predictions, penalties, qualities = np.empty_like(labels), [], []
    for fold in folds:
        quality = np.zeros((PENALTIES.size, labels.shape[1]))
        by_sample = np.zeros((PENALTIES.size, len(labels)))
        for inner in fold.inner:
            gain = gain_of(labels[inner.test])
            for step, predicted in enumerate(predict(inner)):
                gains = gain(predicted)
                quality[step] += gains.sum(axis=0)
                by_sample[step, inner.test] = gains[:, 0]
        chosen = _largest_of_best(quality)
        for step, predicted in enumerate(predict(fold.outer)):
            columns = np.flatnonzero(chosen == step)
            predictions[np.ix_(fold.outer.test, columns)] = predicted[:, columns]
        penalties.append(PENALTIES[chosen[0]])
        qualities.append(InnerQuality.of(quality, by_sample, chosen))
    return predictions, np.array(penalties), qualities


def _quantities(features: NDArray[np.floating], labels: Matrix, fold: Fold) -> Iterator[Matrix]:
    """(m, K) predictions of one fold at each penalty."""
    train = labels[fold.train]
    low, high = train.min(axis=0), train.max(axis=0)
    for predicted in RidgeFold.fit(features[fold.train], features[fold.test]).predictions(train):
        yield predicted.clip(low, high)


def _worth(truth: Matrix, classes: int) -> Matrix:
    """(m, K) one over the number of samples of each one's class."""
    counts = np.stack([(truth == number).sum(axis=0) for number in range(classes)])
    found: Matrix = 1 / np.take_along_axis(counts, truth.astype(np.intp), axis=0)
    return found


def _best_classes(features: NDArray[np.floating], labels: Matrix, classes: int, fold: Fold) -> Iterator[Matrix]:
    """(m, K) most likely classes of one fold at each penalty; a class without training samples is never one."""
    train = labels[fold.train]
    targets = [(train == number).astype(np.float64) for number in range(classes)]
    counts = np.stack([target.sum(axis=0) for target in targets])
    scaled = np.hstack([target / np.sqrt(count.clip(1)) for target, count in zip(targets, counts, strict=True)])
    absent = np.where(counts == 0, -np.inf, 0.0)
    shape = (fold.test.size, classes, labels.shape[1])
    for predicted in RidgeFold.fit(features[fold.train], features[fold.test]).predictions(scaled):
        yield (predicted.reshape(shape) + absent).argmax(axis=1).astype(np.float64)


def _largest_of_best(quality: Matrix) -> NDArray[np.intp]:
    """(K,) position of the best of (L, K) along the grid, the larger penalty on ties."""
    scale = np.abs(quality).max(axis=0) + 1e-300
    rounded = (quality / scale).round(12)[::-1]
    chosen: NDArray[np.intp] = len(quality) - 1 - rounded.argmax(axis=0)
    return chosen
