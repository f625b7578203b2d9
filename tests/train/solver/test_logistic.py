"""scikit-learn's logistic regression is the oracle."""

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression

from probe_kit.errors import ProbeNotConvergedError, TooFewGroupsError
from probe_kit.train.crossval.nested_folds import STRENGTHS
from probe_kit.train.solver import conjugate_gradient as conjugate
from probe_kit.train.solver import design_matrix as design
from probe_kit.train.solver import logistic as solver
from probe_kit.train.solver import principal_axes as axes
from probe_kit.train.solver.design_matrix import DenseDesign, StackedDesign
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.solver.projection import Projection

GENERATOR = np.random.default_rng(0)
NOISE = GENERATOR.standard_normal((90, 200))
LABELS = GENERATOR.random(90) < 0.5
SIGNS = np.where(LABELS, 1.0, -1.0)[:, None]


Path = Callable[[Projection, np.ndarray, np.ndarray], list[np.ndarray]]


@pytest.fixture(params=["alone", "by steps in float32", "beside another fold"])
def path(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Large problems are solved alone, by steps in float32, small ones together with other folds'.

    Every test holds for all.
    """
    if request.param == "by steps in float32":
        monkeypatch.setattr(design, "WORTH_NARROWING", 0)
        monkeypatch.setattr(axes, "WORTH_NARROWING", 16)
        monkeypatch.setattr(axes, "LEADING", 4)
    return beside_another_fold if request.param == "beside another fold" else alone


def alone(coordinates: Projection, labels: np.ndarray, strengths: np.ndarray) -> list[np.ndarray]:
    return list(LogisticSolver(coordinates.train).path(labels, strengths))


def beside_another_fold(coordinates: Projection, labels: np.ndarray, strengths: np.ndarray) -> list[np.ndarray]:
    """With samples filled up to the size of a larger fold."""
    larger = Projection.fit(np.random.default_rng(1).standard_normal((95, 120)))
    count, (samples, rank) = labels.shape[1], coordinates.train.shape
    design = StackedDesign.of_folds([coordinates.train, larger.train], count)
    signs = np.zeros((95, 2 * count))
    signs[:samples, :count] = 2.0 * labels - 1.0
    signs[:, count:] = np.where(np.arange(95) % 2, 1.0, -1.0)[:, None]
    together = LogisticSolver(design).path_of_signs(signs, strengths)
    return [np.vstack([weights[: rank - 1, :count], weights[-1:, :count]]) for weights in together]


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
    case: Callable[[], tuple[np.ndarray, np.ndarray]], path: Path
) -> None:
    features, labels = case()
    coordinates = Projection.fit(features)
    others = features.mean(axis=0) + features.std(axis=0) * GENERATOR.standard_normal((25, features.shape[1]))
    samples = np.vstack([coordinates.standardise(features), coordinates.standardise(others)])
    ours = np.vstack([coordinates(features), coordinates(others)])

    both = np.column_stack([labels, ~labels])
    for strength, weights in zip(STRENGTHS, path(coordinates, both, STRENGTHS), strict=True):
        oracle = LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
        expected = oracle.fit(samples[:90], labels).decision_function(samples)
        found = ours @ weights
        np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(found[:, 1], -expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        assert ((found[:, 0] > 0) == (expected > 0)).all()


def test_columns_solved_together_equal_columns_solved_alone(path: Path) -> None:
    samples = Projection.fit(NOISE)
    labels = GENERATOR.random((90, 7)) < 0.5
    together = path(samples, labels, STRENGTHS)
    for column in range(7):
        single = alone(samples, labels[:, [column]], STRENGTHS)
        for many, one in zip(together, single, strict=True):
            assert np.linalg.norm(many[:, column] - one[:, 0]) < 1e-8 * np.linalg.norm(one)


def test_exact_newton_steps_take_over_where_conjugate_gradients_do_not_settle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = Projection.fit(NOISE).train
    (expected,) = LogisticSolver(samples).path(LABELS[:, None], np.array([10.0]))
    monkeypatch.setattr(conjugate, "MAX_CG_STEPS", 1)
    (found,) = LogisticSolver(samples).path(LABELS[:, None], np.array([10.0]))
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_steps_in_float32_lead_to_the_same_optimum_and_cost_no_more_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = Projection.fit(outliers_and_constants()).train
    labels = GENERATOR.random((90, 40)) < 0.5
    wide = list(LogisticSolver(samples).path(labels, STRENGTHS))
    monkeypatch.setattr(design, "WORTH_NARROWING", 0)
    assert samples.narrow().spectrum.dtype == np.float32
    exact = []
    monkeypatch.setattr(
        LogisticSolver, "_exact_newton_steps", lambda _self, _samples, gradient, _curvature: exact.append(gradient)
    )
    for one, other in zip(wide, LogisticSolver(samples).path(labels, STRENGTHS), strict=True):
        assert other.dtype == np.float64
        assert (np.linalg.norm(one - other, axis=0) < 1e-7 * np.linalg.norm(one, axis=0)).all()
    assert not exact, "conjugate gradients settle in float32 as they do in float64"


@pytest.mark.parametrize("seed", [0, 11, 39])
def test_steps_that_are_not_looked_back_at_never_go_in_circles(seed: int) -> None:
    """One enormous sample: guessed wrong it has no curvature, and a whole step is far too long."""
    features = np.random.default_rng(0).standard_normal((1200, 400))
    features[0] *= 1e4
    samples = Projection.fit(features.astype(np.float32)).train
    assert samples.narrow() is not samples
    labels = np.random.default_rng(seed).random((1200, 12)) < 0.5
    for strength, weights in zip(STRENGTHS, LogisticSolver(samples).path(labels, STRENGTHS), strict=True):
        signs = 2.0 * labels - 1.0
        misfit = 1 / (1 + np.exp(np.clip(signs * (samples @ weights), -700, 700)))
        gradient = np.vstack([weights[:-1], 0 * weights[-1:]]) - strength * samples.gather(signs * misfit)
        assert (np.linalg.norm(gradient, axis=0) < 1e-6 * np.linalg.norm(weights, axis=0)).all()


def test_what_float32_gets_wrong_never_moves_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = Projection.fit(NOISE[:, :40]).train
    labels = GENERATOR.random((90, 5)) < 0.5
    expected = list(LogisticSolver(samples).path(labels, STRENGTHS))
    blurred = DenseDesign((samples.samples * (1 + 1e-3 * GENERATOR.random(samples.shape))).astype(np.float32))
    monkeypatch.setattr(DenseDesign, "narrow", lambda _self: blurred)
    for one, other in zip(expected, LogisticSolver(samples).path(labels, STRENGTHS), strict=True):
        assert (np.linalg.norm(one - other, axis=0) < 1e-8 * np.linalg.norm(one, axis=0)).all()


def test_every_weight_given_back_has_an_exact_gradient_that_is_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(design, "WORTH_NARROWING", 0)
    samples = Projection.fit(outliers_and_constants()).train.samples
    labels = GENERATOR.random((90, 20)) < 0.5
    signs = 2.0 * labels - 1
    for strength, weights in zip(
        STRENGTHS, LogisticSolver(DenseDesign(samples)).path(labels, STRENGTHS), strict=True
    ):
        misfit = 1 / (1 + np.exp(signs * (samples @ weights)))
        gradient = np.vstack([weights[:-1], 0 * weights[-1:]]) - strength * samples.T @ (signs * misfit)
        assert (np.linalg.norm(gradient, axis=0) < 1.1e-9 * np.linalg.norm(weights[:-1], axis=0)).all()


def test_an_unfinished_probe_is_an_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "MAX_NEWTON_STEPS", 2)
    with pytest.raises(ProbeNotConvergedError, match=r"of [12] logistic problems \(N=9[05], C=10\)"):
        path(Projection.fit(NOISE), LABELS[:, None], np.array([10.0]))


def test_non_finite_samples_never_pass_as_converged(path: Path) -> None:
    coordinates = Projection.fit(NOISE)
    assert isinstance(coordinates.train, DenseDesign)
    coordinates.train.samples[0, 0] = np.nan
    with pytest.raises(ProbeNotConvergedError):
        path(coordinates, LABELS[:, None], np.array([1.0]))


def test_a_single_class_has_no_optimum() -> None:
    with pytest.raises(TooFewGroupsError, match="same label"):
        list(LogisticSolver(Projection.fit(NOISE).train).path(np.ones((90, 1), dtype=bool), STRENGTHS))


def test_every_column_can_have_a_strength_of_its_own() -> None:
    samples = Projection.fit(NOISE)
    of_columns = LogisticSolver(samples.train).path_of_signs(
        np.repeat(SIGNS, 3, axis=1), [np.array([1.0, 0.01, 1.0])]
    )
    (found,) = of_columns
    for column, strength in enumerate((1.0, 0.01, 1.0)):
        (expected,) = alone(samples, LABELS[:, None], np.array([strength]))
        np.testing.assert_allclose(found[:, [column]], expected, atol=1e-8)
