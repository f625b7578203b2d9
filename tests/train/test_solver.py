"""The exact solvers, and the samples that they see."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import torch
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.preprocessing import StandardScaler

from probe_kit.errors import ProbeNotConvergedError, TooFewGroupsError, UsageError
from probe_kit.train.crossval.nested_folds import STRENGTHS
from probe_kit.train.crossval.site_probe import PENALTIES, RidgeFold
from probe_kit.train.solver import arrays as rows
from probe_kit.train.solver import design_matrix as axes
from probe_kit.train.solver import design_matrix as design
from probe_kit.train.solver import logistic as conjugate
from probe_kit.train.solver import logistic as solver
from probe_kit.train.solver.arrays import (
    RowSubset,
    Standardiser,
    array_namespace,
    blocks_of,
    check_device,
    to_device,
    to_device_of,
    to_numpy,
)
from probe_kit.train.solver.design_matrix import (
    DenseDesign,
    Projection,
    StackedDesign,
    StreamedDesign,
    principal_axes,
)
from probe_kit.train.solver.logistic import LogisticSolver

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
        monkeypatch.setattr(design, "WORTH_CONVERTING", 0)
        monkeypatch.setattr(axes, "WORTH_NARROWING", 16)
        monkeypatch.setattr(axes, "LEADING", 4)
    return beside_another_fold if request.param == "beside another fold" else alone


def alone(coordinates: Projection, labels: np.ndarray, strengths: np.ndarray) -> list[np.ndarray]:
    return list(LogisticSolver(coordinates.train).path(labels, strengths))


def beside_another_fold(coordinates: Projection, labels: np.ndarray, strengths: np.ndarray) -> list[np.ndarray]:
    """With samples filled up to the size of a larger fold."""
    larger = Projection.fit(np.random.default_rng(1).standard_normal((95, 120)))
    count, (samples, rank) = labels.shape[1], coordinates.train.shape
    design = StackedDesign.of_folds([coordinates.train, larger.train], [count, count])
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
    new_rows = features.mean(axis=0) + features.std(axis=0) * GENERATOR.standard_normal((25, features.shape[1]))
    samples = np.vstack([coordinates.standardise(features), coordinates.standardise(new_rows)])
    ours = np.vstack([coordinates(features), coordinates(new_rows)])

    both = np.column_stack([labels, ~labels])
    for strength, weights in zip(STRENGTHS, path(coordinates, both, STRENGTHS), strict=True):
        oracle = LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
        expected = oracle.fit(samples[:90], labels).decision_function(samples)
        decisions = ours @ weights
        np.testing.assert_allclose(decisions[:, 0], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(decisions[:, 1], -expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        assert ((decisions[:, 0] > 0) == (expected > 0)).all()


def test_columns_solved_together_equal_columns_solved_alone(path: Path) -> None:
    draw = np.random.default_rng(2)  # labels do not depend on the tests that ran before
    samples = Projection.fit(NOISE)
    labels = draw.random((90, 7)) < 0.5
    together = path(samples, labels, STRENGTHS)
    for column in range(7):
        single = alone(samples, labels[:, [column]], STRENGTHS)
        for many, single_column in zip(together, single, strict=True):
            assert np.linalg.norm(many[:, column] - single_column[:, 0]) < 1e-8 * np.linalg.norm(single_column)


def test_exact_newton_steps_take_over_where_conjugate_gradients_do_not_settle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = Projection.fit(NOISE).train
    (expected,) = LogisticSolver(samples).path(LABELS[:, None], np.array([10.0]))
    monkeypatch.setattr(conjugate, "MAX_CG_STEPS", 1)
    (solution,) = LogisticSolver(samples).path(LABELS[:, None], np.array([10.0]))
    np.testing.assert_allclose(solution, expected, atol=1e-8)


def test_steps_in_float32_lead_to_the_same_optimum_and_cost_no_more_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = Projection.fit(outliers_and_constants()).train
    labels = GENERATOR.random((90, 40)) < 0.5
    wide = list(LogisticSolver(samples).path(labels, STRENGTHS))
    monkeypatch.setattr(design, "WORTH_CONVERTING", 0)
    assert samples.narrow().spectrum.dtype == np.float32
    exact = []
    monkeypatch.setattr(
        LogisticSolver, "_exact_newton_steps", lambda _self, _samples, gradient, _curvature: exact.append(gradient)
    )
    for in_float64, other in zip(wide, LogisticSolver(samples).path(labels, STRENGTHS), strict=True):
        assert other.dtype == np.float64
        assert (np.linalg.norm(in_float64 - other, axis=0) < 1e-7 * np.linalg.norm(in_float64, axis=0)).all()
    assert not exact, "conjugate gradients settle in float32 as they do in float64"


@pytest.mark.slow
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


def test_rounding_in_float32_never_moves_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = np.random.default_rng(1)  # labels do not depend on the tests that ran before
    samples = Projection.fit(NOISE[:, :40]).train
    labels = draw.random((90, 5)) < 0.5
    expected = list(LogisticSolver(samples).path(labels, STRENGTHS))
    blurred = DenseDesign((samples.samples * (1 + 1e-3 * draw.random(samples.shape))).astype(np.float32))
    monkeypatch.setattr(DenseDesign, "narrow", lambda _self: blurred)
    for exact, other in zip(expected, LogisticSolver(samples).path(labels, STRENGTHS), strict=True):
        # Of balanced labels and a small C all weights are next to 0, where a share of them is no measure.
        size = np.maximum(np.linalg.norm(exact, axis=0), 0.01)
        assert (np.linalg.norm(exact - other, axis=0) < 1e-8 * size).all()


def test_every_weight_given_back_has_an_exact_gradient_that_is_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(design, "WORTH_CONVERTING", 0)
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
    (solution,) = of_columns
    for column, strength in enumerate((1.0, 0.01, 1.0)):
        (expected,) = alone(samples, LABELS[:, None], np.array([strength]))
        np.testing.assert_allclose(solution[:, [column]], expected, atol=1e-8)


DRAWS = np.random.default_rng(0)
FEATURES = (DRAWS.standard_normal((300, 12)) @ DRAWS.standard_normal((12, 12)) + 30).astype(np.float32)
FEATURES[:, 4] = 7.0  # constant, so dropped
SIDES = FEATURES[:, [0]] + 3 * DRAWS.standard_normal((300, 5)) > 30


@pytest.fixture(autouse=True)
def nothing_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("probe_kit.train.solver.design_matrix.IN_MEMORY", 0)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "ROWS_PER_BLOCK", 64)


def streamed(features: np.ndarray = FEATURES) -> Projection:
    coordinates = Projection.fit(RowSubset.all(features))
    assert isinstance(coordinates.train, StreamedDesign)
    return coordinates


@pytest.mark.usefixtures("small_blocks")
def test_streamed_products_are_those_of_the_samples_in_memory() -> None:
    coordinates = streamed()
    dense, ours = DenseDesign(coordinates(FEATURES)), coordinates.train
    assert ours.shape == dense.shape == (300, 12)
    weights, values = DRAWS.standard_normal((12, 3)), DRAWS.standard_normal((300, 3))
    np.testing.assert_allclose(ours @ weights, dense @ weights, atol=1e-11)
    np.testing.assert_allclose(ours @ weights[:, 0], dense @ weights[:, 0], atol=1e-11)
    np.testing.assert_allclose(ours.gather(values), dense.gather(values), atol=1e-10)
    np.testing.assert_allclose(ours.moments(values), dense.moments(values), atol=1e-9)
    np.testing.assert_allclose(ours.spectrum, dense.spectrum, rtol=1e-9)


@pytest.mark.usefixtures("small_blocks")
def test_streamed_probes_decide_as_probes_in_memory() -> None:
    strengths = np.array([1e-4, 1e-1, 10.0])
    at_once, by_blocks = Projection.fit(FEATURES), streamed()
    for in_memory, other in zip(
        LogisticSolver(at_once.train).path(SIDES, strengths),
        LogisticSolver(by_blocks.train).path(SIDES, strengths),
        strict=True,
    ):
        expected = at_once.train @ in_memory
        np.testing.assert_allclose(by_blocks.train @ other, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.usefixtures("small_blocks")
def test_exact_newton_steps_work_on_streamed_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    (expected,) = LogisticSolver(streamed().train).path(SIDES, np.array([10.0]))
    monkeypatch.setattr("probe_kit.train.solver.logistic.MAX_CG_STEPS", 1)
    (solution,) = LogisticSolver(streamed().train).path(SIDES, np.array([10.0]))
    np.testing.assert_allclose(solution, expected, atol=1e-8)


def test_a_probe_on_many_rows_needs_memory_for_a_block_not_for_a_copy() -> None:
    features = np.random.default_rng(0).standard_normal((60_000, 48), dtype=np.float32)
    labels = features[:, [0]] > 0.5
    tracemalloc.start()
    try:
        list(LogisticSolver(streamed(features).train).path(labels, np.array([1e-3])))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < features.nbytes  # a copy in float64 alone would be twice that


def test_rows_that_fit_into_memory_are_turned_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("probe_kit.train.solver.design_matrix.IN_MEMORY", 8 * 300 * 12)
    assert isinstance(Projection.fit(RowSubset.all(FEATURES)).train, DenseDesign)


def test_few_rows_are_taken_into_memory_and_reduced() -> None:
    few = Projection.fit(RowSubset.all(FEATURES[:8]))
    assert isinstance(few.train, DenseDesign)
    assert few.train.shape == (8, 9)


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(shape)


def test_training_features_get_mean_zero_and_deviation_one() -> None:
    features = 5 + 3 * noise(50, 4)
    scaled = Standardiser.fit(features)(features)
    np.testing.assert_allclose(scaled.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(scaled.std(axis=0), 1)


def test_features_constant_up_to_rounding_are_dropped() -> None:
    features = noise(50, 4).astype(np.float32)
    features[:, 1] = 7
    features[:, 2] = 1e4 + 1e-3 * features[:, 2]  # below the resolution of float32 at 1e4
    assert Standardiser.fit(features).varies.tolist() == [True, False, False, True]


@pytest.mark.parametrize("make", [np.asarray, torch.from_numpy])
@pytest.mark.parametrize(
    ("offset", "variation", "dtype"),
    [(1e7, 5, np.float32), (-3e6, 1, np.float32), (100, 0.5, np.float16), (1e15, 5, np.float64)],
)
def test_a_small_variation_around_a_large_offset_is_kept(
    offset: float, variation: float, dtype: type, make: Callable[[np.ndarray], np.ndarray | torch.Tensor]
) -> None:
    """All values are exact in their type, several units in the last place apart."""
    signs = np.where(np.arange(40) % 2, 1, -1)
    features = np.column_stack([offset + variation * signs, noise(40)]).astype(dtype)
    standardise = Standardiser.fit(make(features))
    assert standardise.varies.tolist() == [True, True]
    np.testing.assert_allclose(np.asarray(standardise(make(features)))[:, 0], signs, atol=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e7, -1 / 3, 3e15])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_a_feature_that_never_varies_is_dropped_however_many_samples_there_are(value: float, dtype: type) -> None:
    if value > float(np.finfo(dtype).max):
        pytest.skip("the type holds no such number")
    features = np.column_stack([np.full(10_007, value), noise(10_007)]).astype(dtype)
    assert Standardiser.fit(features).varies.tolist() == [False, True]


def test_a_jitter_of_one_unit_in_the_last_place_is_dropped() -> None:
    constant = np.full(50, 1.7, np.float32)
    constant[::3] = np.nextafter(constant[0], np.float32(2))
    constant[1::3] = np.nextafter(constant[0], np.float32(1))
    assert Standardiser.fit(np.column_stack([constant, noise(50)]).astype(np.float32)).varies.tolist() == [
        False,
        True,
    ]


def test_test_samples_are_scaled_with_training_statistics() -> None:
    scaled = Standardiser.fit(np.array([[0.0], [2.0]]))(np.array([[5.0]]))
    assert scaled.item() == 4.0


@pytest.mark.parametrize("shape", [(20, 50), (50, 20)])
def test_axes_are_orthonormal_and_lose_nothing_of_the_training_samples(shape: tuple[int, int]) -> None:
    samples = noise(*shape)
    computed_axes = principal_axes(samples)
    assert computed_axes.shape == (shape[1], 20)
    np.testing.assert_allclose(computed_axes.T @ computed_axes, np.eye(20), atol=1e-12)
    np.testing.assert_allclose(samples @ computed_axes @ computed_axes.T, samples, atol=1e-12)


@pytest.mark.parametrize("steepness", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("make", [np.asarray, torch.from_numpy])
def test_many_axes_are_found_in_float32_and_orthogonal_in_float64(
    steepness: float, make: Callable[[np.ndarray], np.ndarray | torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(axes, "WORTH_NARROWING", 100)
    monkeypatch.setattr(axes, "LEADING", 8)
    samples = noise(150, 100) * 100 * np.arange(1.0, 101) ** -steepness
    float32_axes = np.asarray(principal_axes(make(samples)))
    assert float32_axes.dtype == np.float64
    np.testing.assert_allclose(float32_axes.T @ float32_axes, np.eye(100), atol=1e-10)
    moments = (samples @ float32_axes).T @ (samples @ float32_axes)
    assert (np.diff(np.diag(moments)) > -1.0).all(), "ascending"
    curved = np.eye(100) + moments  # as of an objective with its penalty
    scale = np.sqrt(np.diag(curved))
    spread = np.linalg.eigvalsh(curved / np.outer(scale, scale))
    assert spread[0] > 0.9
    assert spread[-1] < 1.1


def test_coordinates_of_training_samples_are_uncorrelated() -> None:
    (moments,) = Projection.fit(noise(30, 80)).train.moments(np.ones((30, 1)))
    np.testing.assert_allclose(moments, np.diag(np.diag(moments)), atol=1e-10)


@pytest.mark.parametrize("shape", [(30, 80), (80, 30)])
def test_raw_weights_decide_like_the_weights_in_coordinates(shape: tuple[int, int]) -> None:
    features = 4 + 2 * noise(*shape)
    features[:, 5] = 3.0
    coordinates = Projection.fit(features)
    weights = np.random.default_rng(1).standard_normal(coordinates.train.shape[1])
    raw, intercept = coordinates.raw_weights(weights)
    np.testing.assert_allclose(features @ raw + intercept, coordinates.train @ weights, atol=1e-9)
    assert raw[5] == 0


def test_a_site_without_any_varying_feature_has_only_an_intercept() -> None:
    coordinates = Projection.fit(np.ones((10, 6)))
    assert (coordinates.train @ np.eye(1)).tolist() == [[1.0]] * 10


MATRIX = np.arange(20.0).reshape(10, 2)


def test_choosing_again_chooses_among_the_chosen_and_copies_nothing() -> None:
    some = RowSubset.all(MATRIX)[np.array([7, 3, 5])][np.array([2, 0])]
    assert some.matrix is MATRIX
    assert some.shape == (2, 2)
    assert some.read().tolist() == np.asarray(some).tolist() == [[10, 11], [14, 15]]


def test_blocks_are_all_rows_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "ROWS_PER_BLOCK", 4)
    subset = RowSubset.all(MATRIX)[np.array([9, 8, 7, 6, 5, 0])]
    blocks = list(blocks_of(subset))
    assert [len(block) for block in blocks] == [4, 2]
    assert np.concatenate(blocks).tolist() == subset.read().tolist()
    assert next(blocks_of(MATRIX)) is MATRIX


def test_rows_on_a_torch_device_are_the_same_rows() -> None:
    pytest.importorskip("torch")
    subset = RowSubset.all(MATRIX)[np.array([4, 1])]
    assert np.asarray(subset.to("cpu")).tolist() == np.asarray(subset).tolist()


def test_numpy_arrays_stay_where_they_are_without_a_device() -> None:
    array = np.ones(3)
    assert to_numpy(to_device(array, None)) is array
    assert array_namespace(array) is np


def test_tensors_come_back_as_the_same_numbers() -> None:
    torch = pytest.importorskip("torch")
    tensor = to_device(np.arange(3.0), "cpu")
    assert array_namespace(tensor) is torch
    assert tensor.dtype == torch.float64
    assert to_numpy(tensor).tolist() == [0, 1, 2]


def test_a_device_that_is_not_there_says_so() -> None:
    pytest.importorskip("torch")
    check_device(None)
    check_device("cpu")
    with pytest.raises(UsageError, match="device 'abacus' cannot be used"):
        check_device("abacus")


def test_an_array_that_may_not_be_written_to_becomes_a_tensor_without_a_warning() -> None:
    """Arrays out of Ray's memory are so; torch warns of a write that never comes, and warnings are errors here."""
    pytest.importorskip("torch")
    array = np.arange(3.0)
    array.setflags(write=False)
    assert to_device(array, "cpu").tolist() == [0, 1, 2]
    assert to_device_of(to_device(np.ones(1), "cpu"), array).tolist() == [0, 1, 2]


@pytest.mark.parametrize("shape", [(60, 12), (30, 80), (40, 40)], ids=str)
@pytest.mark.parametrize("kind", ["plain", "collinear", "constant feature", "offset"])
def test_predictions_at_every_penalty_are_those_of_scikit_learn(shape: tuple[int, int], kind: str) -> None:
    draw = np.random.default_rng(3)
    train, test = draw.normal(size=shape), draw.normal(size=(17, shape[1]))
    if kind == "collinear":
        train[:, 1], test[:, 1] = 2 * train[:, 0], 2 * test[:, 0]
    if kind == "constant feature":
        train[:, 2] = test[:, 2] = 4.0
    if kind == "offset":
        train, test = train + 1000, test + 1000
    targets = draw.normal(size=(shape[0], 3))
    predictions = list(RidgeFold.fit(train, test).predictions(targets))
    scaler = StandardScaler().fit(train)
    for penalty, predicted in zip(PENALTIES, predictions, strict=True):
        if np.isinf(penalty):
            expected = np.repeat(targets.mean(axis=0)[None, :], 17, axis=0)
        else:
            ridge = Ridge(alpha=penalty, solver="svd").fit(scaler.transform(train), targets)
            expected = ridge.predict(scaler.transform(test))
        np.testing.assert_allclose(predicted, expected, atol=1e-10, rtol=1e-10)


def test_features_that_never_vary_predict_the_mean() -> None:
    predictions = list(RidgeFold.fit(np.ones((6, 2)), np.ones((2, 2))).predictions(np.arange(6.0)[:, None]))
    assert all((predicted == 2.5).all() for predicted in predictions)
