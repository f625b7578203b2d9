"""Likeness of features: known values, an independent estimator, and no bias by width."""

from itertools import permutations

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.statistics.cka import unbiased_cka


def u_statistic(first: np.ndarray, second: np.ndarray) -> float:
    """HSIC as the average over all ordered quadruples of different episodes, by its definition."""
    first_gram, second_gram = (features @ features.T for features in (first, second))
    products = [
        first_gram[i, j] * (second_gram[i, j] + second_gram[k, m] - 2 * second_gram[i, k])
        for i, j, k, m in permutations(range(len(first)), 4)
    ]
    return float(np.mean(products))


def test_it_is_the_average_over_all_quadruples_of_episodes() -> None:
    draw = np.random.default_rng(0)
    first = draw.normal(size=(7, 3)) + 2
    second = first[:, :2] + draw.normal(size=(7, 2))
    expected = u_statistic(first, second) / np.sqrt(u_statistic(first, first) * u_statistic(second, second))
    assert unbiased_cka(first, second) == pytest.approx(expected, abs=1e-9)


def test_likeness_ignores_turning_scaling_and_shifting_and_nothing_else() -> None:
    draw = np.random.default_rng(0)
    features = draw.normal(size=(200, 6))
    turned, _ = np.linalg.qr(draw.normal(size=(6, 6)))
    assert unbiased_cka(features, 3 * features @ turned + 5) == pytest.approx(1)
    half = np.concatenate([features[:, :3], draw.normal(size=(200, 3))], axis=1)
    assert 0.3 < unbiased_cka(features, half) < 0.8


def test_independent_features_are_not_alike_however_wide_they_are() -> None:
    """The plain estimator gives 0.9 here: with more features than episodes everything looks alike."""
    draw = np.random.default_rng(0)
    similarities = [unbiased_cka(*draw.normal(size=(2, 24, 300))) for _ in range(60)]
    assert abs(np.mean(similarities)) < 3 * np.std(similarities) / np.sqrt(60) + 1e-3
    assert np.std(similarities) < 0.1


def test_cka_of_constant_features_is_undefined_and_too_few_episodes_are_refused() -> None:
    features = np.random.default_rng(0).normal(size=(10, 3))
    assert np.isnan(unbiased_cka(features, np.ones((10, 3))))
    with pytest.raises(UsageError, match="expected those of the same 4 or more"):
        unbiased_cka(features, features[:9])
