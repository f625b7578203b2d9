"""Probes of the three tasks against scikit-learn, and scores whose mean is the metric."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import balanced_accuracy_score, r2_score
from sklearn.preprocessing import StandardScaler

from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS, Fold, assign_folds
from probe_kit.train.crossval.nested_folds import STRENGTHS, NestedFold
from probe_kit.train.crossval.site_probe import probe_labels
from probe_kit.train.crossval.task_scores import explained_scores
from probe_kit.train.data.samples import Samples
from probe_kit.train.solver.ridge import PENALTIES

GROUPS = np.repeat([f"g{number}" for number in range(20)], 6)


def split(groups: NDArray[np.str_], count: int) -> list[Fold]:
    fold_of = assign_folds(np.zeros(groups.size), groups, count, 0)
    return [Fold(np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)) for fold in range(count)]


def nested(groups: NDArray[np.str_]) -> list[NestedFold]:
    return [
        NestedFold(
            outer,
            [Fold(outer.train[i.train], outer.train[i.test]) for i in split(groups[outer.train], INNER_FOLDS)],
        )
        for outer in split(groups, OUTER_FOLDS)
    ]


def problem(task: str, seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Features and (n, 3) labels: one that the features hold, and two permutations of it by groups."""
    draw = np.random.default_rng(seed)
    x = draw.normal(size=(GROUPS.size, 10))
    signal = x[:, 0] + x[:, 1] + 0.7 * draw.normal(size=GROUPS.size)
    y = {
        "binary": (signal > 0.8).astype(float),
        "classes": np.digitize(signal, [-0.5, 0.9]).astype(float),
        "continuous": signal,
    }[task]
    permuted = [y.reshape(20, 6)[draw.permutation(20)].ravel() for _ in range(2)]
    return x, np.column_stack([y, *permuted])


def scaled(x: NDArray[np.float64], fold: Fold) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    scaler = StandardScaler().fit(x[fold.train])
    return scaler.transform(x[fold.train]), scaler.transform(x[fold.test])


def by_scikit_learn(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    predict: Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float], NDArray[np.float64]],
    grid: list[float],
    loss: Callable[[NDArray[np.float64], NDArray[np.float64]], float],
) -> NDArray[np.float64]:
    """Held-out predictions with the strongest of the penalties whose inner loss is lowest."""
    predictions = np.empty_like(y)
    for fold in nested(GROUPS):
        losses = []
        for strength in grid:
            found = [loss(y[i.test], predict(*scaled(x, i), y[i.train], strength)) for i in fold.inner]
            losses.append(round(sum(found), 9))
        best = grid[int(np.argmin(losses))]
        predictions[fold.outer.test] = predict(*scaled(x, fold.outer), y[fold.outer.train], best)
    return predictions


def ridge(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], penalty: float
) -> NDArray[np.float64]:
    if np.isinf(penalty):
        return np.repeat(np.atleast_1d(y.mean(axis=0))[None, :], len(test), axis=0).squeeze()
    return np.asarray(Ridge(alpha=penalty).fit(train, y).predict(test))


def clipped_ridge(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], penalty: float
) -> NDArray[np.float64]:
    return ridge(train, test, y, penalty).clip(y.min(), y.max())


def indicators(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], penalty: float
) -> NDArray[np.float64]:
    targets = np.eye(3)[y.astype(int)]
    return ridge(train, test, targets / np.sqrt(targets.sum(axis=0)), penalty).argmax(axis=1).astype(float)


def logistic(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], strength: float
) -> NDArray[np.float64]:
    found = LogisticRegression(C=strength, tol=1e-12, max_iter=10_000).fit(train, y)
    return np.asarray(found.decision_function(test))


def squares(truth: NDArray[np.float64], predicted: NDArray[np.float64]) -> float:
    return float(((truth - predicted) ** 2).sum())


def log_loss(truth: NDArray[np.float64], decisions: NDArray[np.float64]) -> float:
    return float(np.logaddexp(0, np.where(truth == 1, -decisions, decisions)).sum())


def test_a_continuous_label_is_predicted_as_by_scikit_learn() -> None:
    x, columns = problem("continuous")
    columns = columns[:, :2]
    probe = probe_labels(Samples.pooled(x), columns, "continuous", nested(GROUPS))
    grid = sorted(PENALTIES.tolist(), reverse=True)
    found = [by_scikit_learn(x, column, clipped_ridge, grid, squares) for column in columns.T]
    np.testing.assert_allclose(probe.decisions, found[0], atol=1e-10)
    outer = [fold.outer for fold in nested(GROUPS)]
    null = [explained_scores(p[:, None], y[:, None], outer).mean() for p, y in zip(found, columns.T, strict=True)]
    np.testing.assert_allclose(probe.null, null[1:], atol=1e-10)
    assert probe.scores.mean() > 0.5 > max(probe.null)


def test_classes_are_predicted_as_by_scikit_learn() -> None:
    x, columns = problem("classes")
    columns = columns[:, :2]
    probe = probe_labels(Samples.pooled(x), columns, "classes", nested(GROUPS))
    grid = sorted(PENALTIES.tolist(), reverse=True)

    def wrong(truth: NDArray[np.float64], predicted: NDArray[np.float64]) -> float:
        return -sum((predicted == c)[truth == c].mean() for c in np.unique(truth))

    found = [by_scikit_learn(x, column, indicators, grid, wrong) for column in columns.T]
    assert (probe.decisions == found[0]).all()
    null = [balanced_accuracy_score(y, p) for p, y in zip(found, columns.T, strict=True)]
    np.testing.assert_allclose([probe.scores.mean(), *probe.null], null, atol=1e-12)
    assert probe.scores.mean() > 0.6 > max(probe.null)


def test_a_binary_label_is_predicted_as_by_scikit_learn_without_the_prior_of_the_fold() -> None:
    x, columns = problem("binary")
    probe = probe_labels(Samples.pooled(x), columns, "binary", nested(GROUPS))
    y = columns[:, 0]
    decisions = by_scikit_learn(x, y, logistic, STRENGTHS.tolist(), log_loss)
    prior = np.empty_like(y)
    for fold in nested(GROUPS):
        share = y[fold.outer.train].mean()
        prior[fold.outer.test] = np.log(share / (1 - share))
    assert (probe.decisions == (decisions > prior)).all()
    assert 0.1 < y.mean() < 0.4, "classes are unequal, so that the prior matters"
    assert probe.scores.mean() == pytest.approx(balanced_accuracy_score(y, decisions > prior), abs=1e-12)


@pytest.mark.parametrize("task", ["binary", "classes", "continuous"])
def test_inner_qualities_are_those_by_which_penalties_are_chosen_above_the_permutations(task: str) -> None:
    """Of every outer fold, by the same loops over scikit-learn, at the penalty that was chosen."""
    x, columns = problem(task)
    grid = 1 / STRENGTHS if task == "binary" else PENALTIES

    def qualities(fold: NestedFold, y: NDArray[np.float64], penalty: float) -> NDArray[np.float64]:
        found = np.zeros(y.size)
        for i in fold.inner:
            train, test = scaled(x, i)
            truth = y[i.test]
            if task == "binary":
                decisions = logistic(train, test, y[i.train], 1 / penalty)
                found[i.test] = -np.logaddexp(0, np.where(truth == 1, -decisions, decisions))
            elif task == "classes":
                right = indicators(train, test, y[i.train], penalty) == truth
                found[i.test] = right / np.array([(truth == one).sum() for one in truth])
            else:
                found[i.test] = -((truth - clipped_ridge(train, test, y[i.train], penalty)) ** 2)
        return found

    folds = nested(GROUPS)
    probe = probe_labels(Samples.pooled(x), columns, task, folds)  # type: ignore[arg-type]
    penalties = 1 / probe.strengths if task == "binary" else probe.strengths
    for fold, penalty, inner in zip(folds, penalties, probe.inner, strict=True):
        best = [max(qualities(fold, y, one).sum() for one in grid) for y in columns.T[1:]]
        expected = qualities(fold, columns[:, 0], penalty)
        expected[fold.outer.train] -= np.mean(best) / fold.outer.train.size
        np.testing.assert_allclose(inner, expected, atol=1e-6)


def test_the_mean_of_the_scores_is_the_metric_of_scikit_learn() -> None:
    x, columns = problem("continuous")
    one = [Fold(np.arange(40, 120), np.arange(40)), Fold(np.arange(40), np.arange(40, 120))]
    centred = columns[:, 0].copy()
    for fold in one:
        centred[fold.train] -= centred[fold.train].mean()  # so that every training mean is the overall one
    predicted = x[:, 0]
    scores = explained_scores(predicted[:, None], centred[:, None], one)
    assert scores.mean() == pytest.approx(r2_score(centred, predicted), abs=1e-12)


def test_one_sample_far_away_does_not_ruin_the_score() -> None:
    x, columns = problem("continuous")
    far = np.column_stack([x, 1e-5 * np.random.default_rng(1).normal(size=len(x))])
    whole = probe_labels(Samples.pooled(far), columns[:, :1], "continuous", nested(GROUPS)).scores.mean()
    far[7, -1] = 1.0  # a hundred thousand deviations where it is not trained on
    outside = probe_labels(Samples.pooled(far), columns[:, :1], "continuous", nested(GROUPS))
    train = np.setdiff1d(np.arange(len(x)), next(f.outer.test for f in nested(GROUPS) if 7 in f.outer.test))
    assert columns[train, 0].min() <= outside.decisions[7] <= columns[train, 0].max()
    assert outside.scores.mean() > whole - 0.2


def test_equal_label_permutations_are_fitted_once_and_scored_alike() -> None:
    x, columns = problem("classes")
    repeated = columns[:, [0, 1, 0, 1, 2]]
    probe = probe_labels(Samples.pooled(x), repeated, "classes", nested(GROUPS))
    apart = probe_labels(Samples.pooled(x), columns, "classes", nested(GROUPS))
    expected = [apart.null[0], apart.scores.mean(), apart.null[0], apart.null[1]]
    np.testing.assert_allclose(probe.null, expected, atol=1e-12)
