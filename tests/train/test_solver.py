"""scikit-learn's logistic regression is the oracle."""

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression

from probe_kit.errors import ProbeNotConvergedError, TooFewGroupsError
from probe_kit.train import solver
from probe_kit.train.design import DenseDesign
from probe_kit.train.features import Coordinates
from probe_kit.train.probe import STRENGTHS
from probe_kit.train.solver import LogisticSolver

GENERATOR = np.random.default_rng(0)
NOISE = GENERATOR.standard_normal((90, 200))
LABELS = GENERATOR.random(90) < 0.5
SIGNS = np.where(LABELS, 1.0, -1.0)[:, None]


@pytest.fixture(params=["whole Hessians", "conjugate gradients"], autouse=True)
def _both_ways(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small problems are solved in one way, large ones in the other; every test holds for both."""
    monkeypatch.setattr(solver, "FEW_COLUMNS", 32 if request.param == "whole Hessians" else 0)


def near_duplicates() -> np.ndarray:
    return np.repeat(NOISE[:45], 2, axis=0) + 1e-7 * NOISE


def outliers_and_constants() -> np.ndarray:
    features = NOISE.copy()
    features[:, 3] = 2.0
    features[:, 5] *= 1e5
    features[:, 7] = 1e6 + 1e-3 * features[:, 7]
    return features


CASES: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
    "more features than samples": lambda: (NOISE, LABELS),
    "more samples than features": lambda: (NOISE[:, :20], LABELS),
    "separable, many features": lambda: (NOISE + 3 * SIGNS * NOISE[:1], LABELS),
    "separable, few features": lambda: (NOISE[:, :8] + 9 * SIGNS, LABELS),
    "one class in fourteen": lambda: (NOISE, GENERATOR.random(90) < 0.07),
    "outlier and constant features": lambda: (outliers_and_constants(), LABELS),
    "nearly equal pairs of samples": lambda: (near_duplicates(), LABELS),
    "float32 far from zero": lambda: ((1e3 * NOISE + 5e4).astype(np.float32), LABELS),
    "a few huge samples": lambda: (
        NOISE[:, :30] * np.where(np.arange(90) % 9, 1, 50)[:, None] + 4 * SIGNS,
        LABELS,
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_decisions_equal_scikit_learn_at_its_own_optimum(
    case: Callable[[], tuple[np.ndarray, np.ndarray]],
) -> None:
    features, labels = case()
    coordinates = Coordinates.fit(features)
    others = features.mean(axis=0) + features.std(axis=0) * GENERATOR.standard_normal((25, features.shape[1]))
    samples = np.vstack([coordinates.standardise(features), coordinates.standardise(others)])
    ours = np.vstack([coordinates(features), coordinates(others)])

    both = np.column_stack([labels, ~labels])
    for strength, weights in zip(STRENGTHS, LogisticSolver(coordinates.train).path(both, STRENGTHS), strict=True):
        oracle = LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
        expected = oracle.fit(samples[:90], labels).decision_function(samples)
        found = ours @ weights
        np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(found[:, 1], -expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        assert ((found[:, 0] > 0) == (expected > 0)).all()


def test_columns_solved_together_equal_columns_solved_alone() -> None:
    samples = Coordinates.fit(NOISE).train
    labels = GENERATOR.random((90, 7)) < 0.5
    together = list(LogisticSolver(samples).path(labels, STRENGTHS))
    for column in range(7):
        alone = list(LogisticSolver(samples).path(labels[:, [column]], STRENGTHS))
        for many, one in zip(together, alone, strict=True):
            assert np.linalg.norm(many[:, column] - one[:, 0]) < 1e-8 * np.linalg.norm(one)


def test_exact_newton_steps_take_over_where_conjugate_gradients_do_not_settle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = Coordinates.fit(NOISE).train
    (expected,) = LogisticSolver(samples).path(LABELS[:, None], np.array([10.0]))
    monkeypatch.setattr(solver, "MAX_CG_STEPS", 1)
    (found,) = LogisticSolver(samples).path(LABELS[:, None], np.array([10.0]))
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_an_unfinished_probe_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "MAX_NEWTON_STEPS", 2)
    with pytest.raises(ProbeNotConvergedError, match=r"1 of 1 logistic problems \(N=90, C=10\)"):
        list(LogisticSolver(Coordinates.fit(NOISE).train).path(LABELS[:, None], np.array([10.0])))


def test_non_finite_samples_never_pass_as_converged() -> None:
    samples = Coordinates.fit(NOISE).train
    assert isinstance(samples, DenseDesign)
    samples.samples[0, 0] = np.nan
    with pytest.raises(ProbeNotConvergedError):
        list(LogisticSolver(samples).path(LABELS[:, None], np.array([1.0])))


def test_a_single_class_has_no_optimum() -> None:
    with pytest.raises(TooFewGroupsError, match="same label"):
        list(LogisticSolver(Coordinates.fit(NOISE).train).path(np.ones((90, 1), dtype=bool), STRENGTHS))
