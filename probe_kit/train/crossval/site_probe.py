"""The probe of one site: nested cross-validation by groups, for the labels and all their permutations at once.

Sides and binary labels are decoded by logistic regression, see `logistic_folds`; classes and quantities by ridge.
Ridge solves many targets and penalties with one factorisation of the training samples. For standardised training
samples Z, test samples T and centred targets Y, the predictions at penalty λ are

    T Zᵀ (Z Zᵀ + λ)⁻¹ Y = T (Zᵀ Z + λ)⁻¹ Zᵀ Y

(Hoerl and Kennard, Technometrics 12, 1970), plus the mean of the targets. Z Zᵀ or Zᵀ Z, whichever is smaller, is
factorised once. Each permutation of the labels then costs one matrix product.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import NonFiniteActivationError
from probe_kit.statistics.folds import Fold
from probe_kit.train.choices import Task
from probe_kit.train.crossval.distinct_labels import distinct_columns
from probe_kit.train.crossval.logistic_folds import cross_validate
from probe_kit.train.crossval.nested_folds import FittedFold, InnerQuality, NestedFold
from probe_kit.train.crossval.task_scores import balanced_scores, correctness, explained_scores
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Standardiser, threads_for, to_numpy

# -- ridge ---------------------------------------------------------------------------------------------------

PENALTIES: Matrix = np.array([*10.0 ** np.arange(-2, 6), np.inf])
"""The grid of λ; at infinity the prediction is the mean of the training labels."""


@dataclass(frozen=True)
class RidgeFold:
    """The training and test samples of one fold, factorised.

    Attributes:
        spectrum: (R,) eigenvalues.
        to_coordinates: (R, n) turns centred training targets into coordinates.
        to_predictions: (m, R) turns shrunken coordinates into predictions of the test samples.
    """

    spectrum: Matrix
    to_coordinates: Matrix
    to_predictions: Matrix

    @classmethod
    def fit(cls, train: NDArray[np.floating], test: NDArray[np.floating]) -> "RidgeFold":
        """Factorise (n, D) training samples for (m, D) test samples. Features are standardised by the former."""
        from scipy.linalg import eigh  # type: ignore[import-untyped]

        standardise = Standardiser.fit(train)
        z, t = standardise(train), standardise(test)
        if z.shape[1] == 0:  # nothing varies: the prediction is the mean
            return cls(np.zeros(0), np.zeros((0, len(z))), np.zeros((len(t), 0)))
        if len(z) <= z.shape[1]:
            spectrum, axes = eigh(z @ z.T)
            return cls(spectrum.clip(0.0), axes.T, (t @ z.T) @ axes)  # rounding can make eigenvalues negative
        spectrum, axes = eigh(z.T @ z)
        return cls(spectrum.clip(0.0), axes.T @ z.T, t @ axes)

    def predictions(self, targets: Matrix, penalties: Matrix = PENALTIES) -> Iterator[Matrix]:
        """Yield the predictions (m, K) of the test samples at each penalty, from (n, K) training targets."""
        mean = targets.mean(axis=0)
        coordinates = self.to_coordinates @ (targets - mean)
        for penalty in penalties:
            if np.isinf(penalty):
                yield np.repeat(mean[None, :], len(self.to_predictions), axis=0)
            else:
                yield mean + self.to_predictions @ (coordinates / (self.spectrum + penalty)[:, None])


@dataclass(frozen=True)
class Predictions:
    """The held-out predictions of E samples for K columns of labels.

    Attributes:
        values: (E, K) decision values of a side, else class numbers or quantities.
        strengths: (F,) C or λ of the first column.
        inner: Inner quality of every fold.
        folds: The logistic probes of the folds; empty for ridge.
    """

    values: Matrix
    strengths: Matrix
    inner: list[InnerQuality]
    folds: Sequence[FittedFold] = ()


def _predict_by_ridge(samples: Samples, labels: Matrix, task: Task, folds: list[NestedFold]) -> Predictions:
    """Return quantities within the range of the training labels, or the best class by ridge on class indicators.

    Each column of an outer fold is predicted at the λ that is best in its inner folds. The best λ has the least
    squared error of quantities, or the largest balanced accuracy of classes; the larger λ on ties.
    """
    classes = 0 if task == "continuous" else int(labels.max()) + 1
    predictions, penalties, qualities = np.empty_like(labels), [], []
    for fold in folds:
        quality = np.zeros((PENALTIES.size, labels.shape[1]))
        by_sample = np.zeros((PENALTIES.size, len(labels)))
        for inner in fold.inner:
            truth = labels[inner.test]
            weights: Matrix = np.ones(1)
            if classes:  # one over the number of samples of each sample's class: the sum is balanced accuracy
                counts = np.stack([(truth == number).sum(axis=0) for number in range(classes)])
                weights = 1 / np.take_along_axis(counts, truth.astype(np.intp), axis=0)
            for step, predicted in enumerate(_along_penalties(samples, labels, classes, inner)):
                gains = (predicted == truth) * weights if classes else -((truth - predicted) ** 2)
                quality[step] += gains.sum(axis=0)
                by_sample[step, inner.test] = gains[:, 0]
        scale = np.abs(quality).max(axis=0) + 1e-300  # not zero
        # Rounded, so that sums in another order are still ties; of these argmax takes the first, the largest λ.
        best = len(quality) - 1 - (quality / scale).round(12)[::-1].argmax(axis=0)
        for step, predicted in enumerate(_along_penalties(samples, labels, classes, fold.outer)):
            columns = np.flatnonzero(best == step)
            predictions[np.ix_(fold.outer.test, columns)] = predicted[:, columns]
        penalties.append(PENALTIES[best[0]])
        qualities.append(InnerQuality.of(quality, by_sample, best))
    return Predictions(predictions, np.array(penalties), qualities)


def _along_penalties(samples: Samples, labels: Matrix, classes: int, fold: Fold) -> Iterator[Matrix]:
    """Yield the predictions (m, K) of one fold at each penalty.

    Every token of the training episodes is a sample, and an episode decides by their mean.

    Args:
        samples: Samples of the E episodes.
        labels: (E, K) class numbers or quantities.
        classes: Number of classes, 0 for quantities.
        fold: Training and test episodes, of which m are tested.
    """
    train, training_samples = labels[fold.train], samples.of(fold.train)
    ridge = RidgeFold.fit(training_samples.read(), to_numpy(samples.means)[fold.test])
    if not classes:
        # A linear probe extrapolates without bound, and one prediction far outside would decide R².
        low, high = train.min(axis=0), train.max(axis=0)
        for predicted in ridge.predictions(training_samples.repeat(train)):
            yield predicted.clip(low, high)
        return
    targets = [(train == number).astype(np.float64) for number in range(classes)]
    counts = np.stack([target.sum(axis=0) for target in targets])
    # Indicators of rare classes are larger, so that the largest prediction is not always the commonest class.
    scaled = np.hstack([target / np.sqrt(count.clip(1)) for target, count in zip(targets, counts, strict=True)])
    absent = np.where(counts == 0, -np.inf, 0.0)  # a class without training samples is never the best
    shape = (fold.test.size, classes, labels.shape[1])
    for predicted in ridge.predictions(training_samples.repeat(scaled)):
        yield (predicted.reshape(shape) + absent).argmax(axis=1).astype(np.float64)


# -- the probe -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SiteProbe:
    """The results of a site's probe on E samples, with F outer folds and P label permutations.

    Attributes:
        decisions: (E,) out-of-fold decision values of a side (positive: left), else predicted class numbers or
            quantities.
        scores: (E,) scores whose mean is the metric; of a side whether the decision is right.
        strengths: (F,) strength chosen in each outer fold: C of logistic probes, λ of ridge, of which the larger
            penalises more.
        weights: (F, D) float32 weights of each outer fold's probe of a side, on raw features; D is 0 for other
            targets.
        intercepts: (F,) intercepts of each outer fold's probe of a side, on raw features.
        spreads: (F,) deviation of the fold's training samples along its weights, in units of the features.
        null: (P,) metric under the label permutations.
        inner: (F, E) quality of each sample's prediction in the inner folds of each outer fold, by which penalties
            are chosen, the larger the better; 0 for the samples that the outer fold tests. For a side it is the
            log-likelihood of its label. For others it is the gain of `_predict_by_ridge` or the log-likelihood,
            minus the mean over the label permutations.
    """

    decisions: Matrix
    scores: Matrix
    strengths: Matrix
    weights: NDArray[np.float32]
    intercepts: Matrix
    spreads: Matrix
    null: Matrix
    inner: NDArray[np.floating]


def probe_site(
    samples: Samples,
    labels: NDArray[Any],
    permuted_labels: NDArray[Any],
    folds: list[NestedFold],
    task: Task | None = None,
) -> SiteProbe:
    """Probe the samples of E episodes for (E,) labels, and again for every column of (E, P) label permutations.

    Args:
        samples: Features of one site.
        labels: (E,) bool of a side, else coded.
        permuted_labels: (E, P) labels under P permutations.
        folds: Outer folds with their inner folds.
        task: None for a side, whose score is not balanced: its layouts are.

    Raises:
        ProbeNotConvergedError: If a logistic probe stops before its optimum.
        NonFiniteActivationError: For NaN or infinity.
    """
    check_non_finite(samples)
    columns = np.column_stack([labels, permuted_labels])
    # Labels that are constant in a group have few different permutations.
    different, column_of = distinct_columns(columns)
    columns = columns[:, different]
    predictions = _predict(samples, columns, task, folds)
    scores = _scores(predictions.values, columns, task, folds)
    inner: NDArray[np.floating]
    # Only directions of a side are stored; other probes are refitted where they are transferred.
    directions: Sequence[FittedFold] = ()
    if task is None:
        directions = predictions.folds
        inner = np.stack([quality.first for quality in predictions.inner]).astype(np.float32)
    else:
        trained = zip(predictions.inner, folds, strict=True)
        inner = np.stack(
            [_above_permutations(quality, column_of[1:], fold.outer.train) for quality, fold in trained]
        )
    none = np.zeros(len(folds))
    return SiteProbe(
        decisions=predictions.values[:, 0],
        scores=scores[:, 0],
        strengths=predictions.strengths,
        weights=np.array([fold.weights for fold in directions] or np.zeros((len(folds), 0)), np.float32),
        intercepts=np.array([fold.intercept for fold in directions] or none),
        spreads=np.array([fold.spread for fold in directions] or none),
        null=scores.mean(axis=0)[column_of[1:]],
        inner=inner,
    )


def predict_once(samples: Samples, labels: Matrix, task: Task, fold: NestedFold) -> tuple[Matrix, float]:
    """Return predictions (m,) for the test samples of one outer fold, and its C or λ.

    Args:
        samples: Features of E episodes at one site.
        labels: (E,) coded labels; those of test samples have no effect.
        task: Task of the labels, which decides between ridge and logistic regression.
        fold: Outer fold whose m test samples are predicted, with the inner folds that choose C or λ.

    Raises:
        ProbeNotConvergedError: If a logistic probe stops before its optimum.
    """
    predictions = _predict(samples, labels[:, None], task, [fold])
    return predictions.values[fold.outer.test, 0], float(predictions.strengths[0])


def check_non_finite(samples: Samples) -> None:
    """Raise NonFiniteActivationError if an episode holds NaN or infinity, with the number of the first one."""
    broken = samples.broken()
    if broken.size:
        raise NonFiniteActivationError(
            f"{broken.size} of {len(samples.counts)} episodes hold NaN or infinity, first number {broken[0]}, "
            "from 0 on; expected finite features. Leave these episodes out, or extract them again."
        )


def _predict(samples: Samples, labels: NDArray[Any], task: Task | None, folds: list[NestedFold]) -> Predictions:
    """Predict by ridge, or by logistic regression for a side or a binary label."""
    with threads_for(samples.features):
        if task is not None and task != "binary":
            return _predict_by_ridge(samples, labels, task, folds)
        return _predict_by_logistic(samples, labels, task, folds)


def _predict_by_logistic(
    samples: Samples, labels: NDArray[Any], task: Task | None, folds: list[NestedFold]
) -> Predictions:
    """Predict a side, or a binary label, whose threshold is shifted by the log-odds of its training classes."""
    truth = labels == 1
    values, fitted = np.empty(labels.shape), cross_validate(samples, truth, folds, all_qualities=task is not None)
    for fold, probe in zip(folds, fitted, strict=True):
        decisions = probe.decisions
        if task == "binary":
            # Less the log-odds of the training classes: balanced accuracy takes both as equally frequent.
            share = truth[fold.outer.train].mean(axis=0)
            decisions = decisions > np.log(share / (1 - share))
        values[fold.outer.test] = decisions
    strengths = np.array([probe.strengths[0] for probe in fitted])
    return Predictions(values, strengths, [probe.inner for probe in fitted], fitted)


def _scores(predicted: Matrix, labels: NDArray[Any], task: Task | None, folds: list[NestedFold]) -> Matrix:
    """Return the score of every sample, (E, K), whose mean is the metric."""
    if task is None:
        return correctness(predicted, labels).astype(np.float64)
    if task == "continuous":
        return explained_scores(predicted, labels, [fold.outer for fold in folds])
    return balanced_scores(predicted, labels)


def _above_permutations(inner: InnerQuality, columns: NDArray[np.intp], train: NDArray[np.intp]) -> Matrix:
    """Return the first column's quality (E,) minus the mean over `columns`.

    Every training sample bears a share of this mean. Sites differ in the quality that they reach with exchanged
    labels. Without permutations nothing is subtracted.
    """
    above = inner.first.copy()
    if columns.size:
        above[train] -= inner.total[columns].mean() / train.size
    return above
