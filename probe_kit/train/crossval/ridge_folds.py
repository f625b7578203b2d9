"""Nested ridge probes of a site: λ by the inner folds, for every column of labels at once."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.nested_folds import InnerQuality, Matrix, NestedFold
from probe_kit.train.data.samples import Samples
from probe_kit.train.solver.backend import to_numpy
from probe_kit.train.solver.ridge import PENALTIES, RidgeFold

Fitted = tuple[Matrix, Matrix, list[InnerQuality]]
"""(E, K) held-out predictions, (F,) λ of the first column, and the inner quality of every outer fold."""


def predict_quantities(samples: Samples, labels: Matrix, folds: list[NestedFold]) -> Fitted:
    """Return ridge predictions within the range of the training labels; λ by squared error."""
    return _nested(
        labels,
        folds,
        lambda fold: _quantities(samples, labels, fold),
        lambda truth: lambda predicted: -((truth - predicted) ** 2),
    )


def predict_classes(samples: Samples, labels: Matrix, folds: list[NestedFold]) -> Fitted:
    """Return the best class by ridge on class indicators; λ by balanced accuracy."""
    classes = int(labels.max()) + 1

    def gain(truth: Matrix) -> Gain:
        worth = _worth(truth, classes)
        return lambda predicted: (predicted == truth) * worth

    return _nested(labels, folds, lambda fold: _best_classes(samples, labels, classes, fold), gain)


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
        best = _largest_of_best(quality)
        for step, predicted in enumerate(predict(fold.outer)):
            columns = np.flatnonzero(best == step)
            predictions[np.ix_(fold.outer.test, columns)] = predicted[:, columns]
        penalties.append(PENALTIES[best[0]])
        qualities.append(InnerQuality.of(quality, by_sample, best))
    return predictions, np.array(penalties), qualities


def _quantities(samples: Samples, labels: Matrix, fold: Fold) -> Iterator[Matrix]:
    """(m, K) predictions of one fold at each penalty."""
    train = labels[fold.train]
    # A linear probe extrapolates without bound, and one prediction far outside would decide R².
    low, high = train.min(axis=0), train.max(axis=0)
    for predicted in _fitted(samples, fold).predictions(samples.of(fold.train).repeat(train)):
        yield predicted.clip(low, high)


def _worth(truth: Matrix, classes: int) -> Matrix:
    """(m, K) one over the number of samples of each one's class."""
    counts = np.stack([(truth == number).sum(axis=0) for number in range(classes)])
    worth: Matrix = 1 / np.take_along_axis(counts, truth.astype(np.intp), axis=0)
    return worth


def _best_classes(samples: Samples, labels: Matrix, classes: int, fold: Fold) -> Iterator[Matrix]:
    """(m, K) most likely classes of one fold at each penalty; a class without training samples is never one."""
    train = labels[fold.train]
    targets = [(train == number).astype(np.float64) for number in range(classes)]
    counts = np.stack([target.sum(axis=0) for target in targets])
    # Indicators of rare classes are larger, so that the largest prediction is not always the commonest class.
    scaled = np.hstack([target / np.sqrt(count.clip(1)) for target, count in zip(targets, counts, strict=True)])
    absent = np.where(counts == 0, -np.inf, 0.0)
    shape = (fold.test.size, classes, labels.shape[1])
    for predicted in _fitted(samples, fold).predictions(samples.of(fold.train).repeat(scaled)):
        yield (predicted.reshape(shape) + absent).argmax(axis=1).astype(np.float64)


def _largest_of_best(quality: Matrix) -> NDArray[np.intp]:
    """(K,) position of the best of (L, K) along the grid, the larger penalty on ties."""
    scale = np.abs(quality).max(axis=0) + 1e-300  # not zero
    rounded = (quality / scale).round(12)[::-1]
    best: NDArray[np.intp] = len(quality) - 1 - rounded.argmax(axis=0)
    return best


def _fitted(samples: Samples, fold: Fold) -> RidgeFold:
    """Factorise a fold: every token of the training episodes is a sample, and an episode decides by their mean."""
    return RidgeFold.fit(samples.of(fold.train).read(), to_numpy(samples.means)[fold.test])
