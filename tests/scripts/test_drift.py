"""Likeness of features, before and after a training."""

import numpy as np
import pytest
from drift_embedded import _accuracy, linear_cka

from probe_kit.statistics.folds import grouped_folds


def test_likeness_ignores_turning_scaling_and_shifting_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(200, 6))
    turned, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    assert linear_cka(features, 3 * features @ turned + 5) == pytest.approx(1)
    assert linear_cka(features, rng.normal(size=(200, 6))) < 0.2
    half = np.concatenate([features[:, :3], rng.normal(size=(200, 3))], axis=1)
    assert 0.3 < linear_cka(features, half) < 0.8


def test_a_probe_does_not_carry_over_to_features_that_turned() -> None:
    rng = np.random.default_rng(0)
    right = np.arange(80) % 2
    before = rng.normal(size=(80, 4))
    before[:, 0] += 4 * right
    after = np.roll(before, 1, axis=1)
    folds = grouped_folds(right, [f"g{k // 4}" for k in range(80)], 5, seed=0)
    assert _accuracy(folds, right, before, before) > 0.9
    assert _accuracy(folds, right, after, after) > 0.9
    assert _accuracy(folds, right, before, after) < 0.7
