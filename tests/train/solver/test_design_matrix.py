import tracemalloc

import numpy as np
import pytest

from probe_kit.train.solver import row_subset as rows
from probe_kit.train.solver.design_matrix import DenseDesign, StreamedDesign
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.solver.projection import Projection
from probe_kit.train.solver.row_subset import RowSubset

GENERATOR = np.random.default_rng(0)
FEATURES = (GENERATOR.standard_normal((300, 12)) @ GENERATOR.standard_normal((12, 12)) + 30).astype(np.float32)
FEATURES[:, 4] = 7.0  # constant, so dropped
LABELS = FEATURES[:, [0]] + 3 * GENERATOR.standard_normal((300, 5)) > 30


@pytest.fixture(autouse=True)
def nothing_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("probe_kit.train.solver.projection.IN_MEMORY", 0)


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
    weights, values = GENERATOR.standard_normal((12, 3)), GENERATOR.standard_normal((300, 3))
    np.testing.assert_allclose(ours @ weights, dense @ weights, atol=1e-11)
    np.testing.assert_allclose(ours @ weights[:, 0], dense @ weights[:, 0], atol=1e-11)
    np.testing.assert_allclose(ours.gather(values), dense.gather(values), atol=1e-10)
    np.testing.assert_allclose(ours.moments(values), dense.moments(values), atol=1e-9)
    np.testing.assert_allclose(ours.spectrum, dense.spectrum, rtol=1e-9)


@pytest.mark.usefixtures("small_blocks")
def test_streamed_probes_decide_as_probes_in_memory() -> None:
    strengths = np.array([1e-4, 1e-1, 10.0])
    at_once, by_blocks = Projection.fit(FEATURES), streamed()
    for one, other in zip(
        LogisticSolver(at_once.train).path(LABELS, strengths),
        LogisticSolver(by_blocks.train).path(LABELS, strengths),
        strict=True,
    ):
        expected = at_once.train @ one
        np.testing.assert_allclose(by_blocks.train @ other, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.usefixtures("small_blocks")
def test_exact_newton_steps_work_on_streamed_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    (expected,) = LogisticSolver(streamed().train).path(LABELS, np.array([10.0]))
    monkeypatch.setattr("probe_kit.train.solver.conjugate_gradient.MAX_CG_STEPS", 1)
    (found,) = LogisticSolver(streamed().train).path(LABELS, np.array([10.0]))
    np.testing.assert_allclose(found, expected, atol=1e-8)


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
    monkeypatch.setattr("probe_kit.train.solver.projection.IN_MEMORY", 8 * 300 * 12)
    assert isinstance(Projection.fit(RowSubset.all(FEATURES)).train, DenseDesign)


def test_few_rows_are_taken_into_memory_and_reduced() -> None:
    few = Projection.fit(RowSubset.all(FEATURES[:8]))
    assert isinstance(few.train, DenseDesign)
    assert few.train.shape == (8, 9)
