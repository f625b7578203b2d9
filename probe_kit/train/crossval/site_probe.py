"""One site's probe: nested, grouped cross-validation for the labels and all their permutations at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NonFiniteActivationError
from probe_kit.train.choices import Task
from probe_kit.train.crossval.logistic_folds import cross_validate
from probe_kit.train.crossval.nested_folds import FittedFold, InnerQuality, Matrix, NestedFold
from probe_kit.train.crossval.ridge_folds import predict_classes, predict_quantities
from probe_kit.train.crossval.task_scores import balanced_scores, correctness, explained_scores
from probe_kit.train.data.samples import Samples


@dataclass(frozen=True)
class SiteProbe:
    """The results of a site's probe on E samples, with F outer folds and P label permutations.

    decisions: (E,) out-of-fold decision values of a side (positive: left), else predicted class numbers or
    quantities. scores: (E,) their mean is the metric; of a side whether the decision is right. strengths: (F,) the
    C or λ chosen in each outer fold. weights, intercepts: (F, D) float32 and (F,) of each outer fold's probe of a
    side, on raw features; D is 0 for other targets. spreads: (F,) deviation of the fold's training samples along
    its weights, in units of the features. null: (P,) metric under the label permutations. inner: (F, E) quality of
    each sample's prediction in the inner folds of each outer fold, by which penalties are chosen, the larger the
    better; 0 for the samples that the outer fold tests. Of a side the log-likelihood of its label, else minus the
    mean of the permutations'.
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
    labels: NDArray[np.bool_],
    permuted_labels: NDArray[np.bool_],
    folds: list[NestedFold],
) -> SiteProbe:
    """Probe the samples of E episodes for (E,) sides, and again for every column of (E, P) label permutations.

    Raises ProbeNotConvergedError, and NonFiniteActivationError for NaN or infinity.
    """
    check_non_finite(samples)
    columns = np.column_stack([labels, permuted_labels])
    fitted = cross_validate(samples, columns, folds)
    decisions = _out_of_fold(fitted, folds)
    right = correctness(decisions, columns)
    return SiteProbe(
        decisions=decisions[:, 0],
        scores=right[:, 0].astype(np.float64),
        strengths=np.array([fold.strengths[0] for fold in fitted]),
        weights=np.stack([fold.weights for fold in fitted]).astype(np.float32),
        intercepts=np.array([fold.intercept for fold in fitted]),
        spreads=np.array([fold.spread for fold in fitted]),
        null=right[:, 1:].mean(axis=0),
        inner=np.stack([fold.inner.first for fold in fitted]).astype(np.float32),
    )


def probe_labels(samples: Samples, labels: Matrix, task: Task, folds: list[NestedFold]) -> SiteProbe:
    """Probe samples for the first of (E, 1 + P) columns of coded labels, and for the permutations behind it.

    Raises ProbeNotConvergedError for a binary label, and NonFiniteActivationError for NaN or infinity.
    """
    check_non_finite(samples)
    labels, column_of = _distinct(labels)
    predictions, strengths, inner = _predict(samples, labels, task, folds)
    if task == "continuous":
        scores = explained_scores(predictions, labels, [fold.outer for fold in folds])
    else:
        scores = balanced_scores(predictions, labels)
    none = np.zeros(len(folds))
    return SiteProbe(
        decisions=predictions[:, 0],
        scores=scores[:, 0],
        strengths=strengths,
        weights=np.zeros((len(folds), 0), np.float32),
        intercepts=none,
        spreads=none,
        null=scores.mean(axis=0)[column_of[1:]],
        inner=np.stack([
            _above_permutations(quality, column_of[1:], fold.outer.train)
            for quality, fold in zip(inner, folds, strict=True)
        ]),
    )  # fmt: skip


def predict_once(samples: Samples, labels: Matrix, task: Task, fold: NestedFold) -> tuple[Matrix, float]:
    """Return predictions (m,) for the test samples of one outer fold, and its C or λ.

    labels: (E,); those of test samples have no effect. Raises ProbeNotConvergedError.
    """
    predictions, strengths, _ = _predict(samples, labels[:, None], task, [fold])
    return predictions[fold.outer.test, 0], float(strengths[0])


def check_non_finite(samples: Samples) -> None:
    """Raise NonFiniteActivationError, naming the first broken episode by its number, if there is any."""
    broken = samples.broken()
    if broken.size:
        raise NonFiniteActivationError(
            f"{broken.size} of {len(samples.counts)} episodes hold NaN or infinity, first number {broken[0]}, "
            "from 0 on; expected finite features. Leave these episodes out, or extract them again."
        )


def _predict(
    samples: Samples, labels: Matrix, task: Task, folds: list[NestedFold]
) -> tuple[Matrix, Matrix, list[InnerQuality]]:
    """(E, K) held-out class numbers or quantities, (F,) C or λ of the first column, and the inner quality."""
    if task == "binary":
        return _predict_binary(samples, labels, folds)
    return (predict_classes if task == "classes" else predict_quantities)(samples, labels, folds)


def _predict_binary(
    samples: Samples, labels: Matrix, folds: list[NestedFold]
) -> tuple[Matrix, Matrix, list[InnerQuality]]:
    """The side probes' logistic regression, without what its intercept learns from unequal classes."""
    truth = labels == 1
    predictions, fitted = np.empty_like(labels), cross_validate(samples, truth, folds)
    for fold, probe in zip(folds, fitted, strict=True):
        # Less the log-odds of the training classes: balanced accuracy takes both as equally frequent.
        share = truth[fold.outer.train].mean(axis=0)
        predictions[fold.outer.test] = probe.decisions > np.log(share / (1 - share))
    return predictions, np.array([probe.strengths[0] for probe in fitted]), [probe.inner for probe in fitted]


def _above_permutations(inner: InnerQuality, columns: NDArray[np.intp], train: NDArray[np.intp]) -> Matrix:
    """(E,) of the first column minus the mean over `columns`, of which every training sample bears a share.

    Sites differ in what they reach with exchanged labels. Without permutations nothing is subtracted.
    """
    above = inner.first.copy()
    if columns.size:
        above[train] -= inner.total[columns].mean() / train.size
    return above


def _distinct(labels: Matrix) -> tuple[Matrix, NDArray[np.intp]]:
    """The different columns of (E, K) labels, the first one first, and the place of every column among them.

    Labels that are constant in a group have few different permutations.
    """
    first: dict[bytes, int] = {}
    column_of = [first.setdefault(column.tobytes(), len(first)) for column in labels.T.copy()]
    different = [column_of.index(number) for number in range(len(first))]
    return labels[:, different], np.array(column_of, np.intp)


def _out_of_fold(fitted: list[FittedFold], folds: list[NestedFold]) -> Matrix:
    """(E, K) decisions, each episode's from the fold that tests it."""
    tested = np.concatenate([fold.outer.test for fold in folds])
    decisions: Matrix = np.concatenate([fold.decisions for fold in fitted])[np.argsort(tested)]
    return decisions
