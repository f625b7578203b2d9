"""Intervals of R² over groups."""

from math import inf

import numpy as np
import pytest
from scipy import stats

from probe_kit.statistics.folds import OUTER_FOLDS, SHARED_TRAINING
from probe_kit.statistics.student import explained_interval

GROUPS = np.repeat(np.arange(12), 5)


def drawn(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Target, predictions and scores of 12 groups of five."""
    generator = np.random.default_rng(seed)
    labels = generator.standard_normal(60) + generator.standard_normal(12)[GROUPS]
    predicted = 0.7 * labels + 0.5 * generator.standard_normal(60)
    return labels, predicted, 1 - (labels - predicted) ** 2 / labels.var()


def test_the_interval_of_r2_is_that_of_a_ratio_of_sums_over_groups() -> None:
    labels, predicted, scores = drawn()
    errors, deviations = (labels - predicted) ** 2, (labels - labels.mean()) ** 2
    of_group = np.array([[errors[g == GROUPS].sum(), deviations[g == GROUPS].sum()] for g in range(12)])
    ratio = of_group[:, 0].sum() / of_group[:, 1].sum()
    # Cochran, Sampling Techniques, 6.13: the variance of a ratio estimator.
    rest = of_group[:, 0] - ratio * of_group[:, 1]
    error = np.sqrt(rest.var(ddof=1) / 12) / of_group[:, 1].mean()
    above, below = np.exp(stats.t(11, np.log(ratio), error / ratio).interval(0.95))
    assert explained_interval(scores, deviations, GROUPS) == pytest.approx((1 - below, 1 - above))


def test_it_is_nearly_the_jackknife_over_groups() -> None:
    labels, predicted, scores = drawn(1)
    errors, deviations = (labels - predicted) ** 2, (labels - labels.mean()) ** 2
    without = np.array([1 - errors[g != GROUPS].sum() / deviations[g != GROUPS].sum() for g in range(12)])
    error = np.sqrt(11 / 12 * ((without - without.mean()) ** 2).sum())
    low, high = explained_interval(scores, deviations, GROUPS)
    assert (high - low) / 2 == pytest.approx(stats.t.ppf(0.975, 11) * error, rel=0.15)


def test_folds_that_share_training_groups_widen_the_interval_by_one_half() -> None:
    labels, _, scores = drawn()
    deviations = (labels - labels.mean()) ** 2
    shared, alone = (explained_interval(scores, deviations, GROUPS, by)[0] for by in (SHARED_TRAINING, 1.0))
    assert pytest.approx(1.5) == SHARED_TRAINING
    assert OUTER_FOLDS == 5
    lengths = [np.log((1 - low) / (1 - scores.mean())) for low in (shared, alone)]
    assert lengths[0] == pytest.approx(1.5 * lengths[1])


def test_r2_does_not_depend_on_the_unit_of_the_label_and_ends_at_one() -> None:
    labels, _, scores = drawn()
    deviations = (labels - labels.mean()) ** 2
    assert explained_interval(scores, 9 * deviations, GROUPS) == pytest.approx(
        explained_interval(scores, deviations, GROUPS)
    )
    assert explained_interval(0.3 * scores + 0.7, deviations, GROUPS, 5.0)[1] < 1.0
    assert explained_interval(np.ones(60), deviations, GROUPS) == (1.0, 1.0)


def test_a_single_group_and_a_constant_label_are_no_error() -> None:
    _, _, scores = drawn()
    assert explained_interval(scores, np.ones(60), np.zeros(60)) == (-inf, 1.0)
    low, high = explained_interval(np.zeros(60), np.zeros(60), GROUPS)
    assert (low, high) == (0.0, 0.0)


def test_a_score_lies_within_its_interval_although_subtractions_round() -> None:
    scores = np.full(len(GROUPS), -5e-17)
    low, high = explained_interval(scores, np.ones(len(GROUPS)), GROUPS)
    assert low <= scores.mean() <= high
