from collections.abc import Callable

import numpy as np
import pytest
import torch

from probe_kit.train.solver import principal_axes as axes
from probe_kit.train.solver.principal_axes import principal_axes
from probe_kit.train.solver.projection import Projection
from probe_kit.train.solver.standardiser import Standardiser


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
    found = principal_axes(samples)
    assert found.shape == (shape[1], 20)
    np.testing.assert_allclose(found.T @ found, np.eye(20), atol=1e-12)
    np.testing.assert_allclose(samples @ found @ found.T, samples, atol=1e-12)


@pytest.mark.parametrize("steepness", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("make", [np.asarray, torch.from_numpy])
def test_many_axes_are_found_in_float32_and_orthogonal_in_float64(
    steepness: float, make: Callable[[np.ndarray], np.ndarray | torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(axes, "WORTH_NARROWING", 100)
    monkeypatch.setattr(axes, "LEADING", 8)
    samples = noise(150, 100) * 100 * np.arange(1.0, 101) ** -steepness
    found = np.asarray(principal_axes(make(samples)))
    assert found.dtype == np.float64
    np.testing.assert_allclose(found.T @ found, np.eye(100), atol=1e-10)
    moments = (samples @ found).T @ (samples @ found)
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
