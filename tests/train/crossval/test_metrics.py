import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binomtest
from sklearn import metrics

from probe_kit.statistics.estimates.shares import Share
from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.task_scores import chance_level, fold_auc, log_loss

GENERATOR = np.random.default_rng(0)
LABELS = GENERATOR.random(80) < 0.3
DECISIONS = np.round(GENERATOR.standard_normal(80) + LABELS, 1)  # rounded, so that there are ties
EVERYTHING = [Fold(np.arange(0), np.arange(80))]


def test_scores_equal_scikit_learn() -> None:
    probability = 1 / (1 + np.exp(-DECISIONS))
    assert log_loss(DECISIONS, LABELS) == pytest.approx(metrics.log_loss(LABELS, probability))
    assert fold_auc(DECISIONS, LABELS, EVERYTHING) == pytest.approx(metrics.roc_auc_score(LABELS, DECISIONS))


def test_auc_does_not_compare_decisions_across_folds() -> None:
    halves = [Fold(np.arange(40, 80), np.arange(40)), Fold(np.arange(40), np.arange(40, 80))]
    shifted = DECISIONS + np.where(np.arange(80) < 40, 0, 100)
    assert fold_auc(shifted, LABELS, halves) == pytest.approx(fold_auc(DECISIONS, LABELS, halves))


def test_chance_is_the_larger_class() -> None:
    assert chance_level(np.array([True, False])) == 0.5
    assert chance_level(np.array([True, False, False, False])) == 0.75


def limits(right: NDArray[np.bool_], groups: NDArray[np.int64]) -> tuple[float, float]:
    found = Share.of(right, groups).interval()
    return found.low, found.high


def test_interval_widens_when_episodes_of_a_group_agree() -> None:
    right = np.repeat(GENERATOR.random(50) < 0.6, 4)
    grouped, apart = (np.diff(limits(right, groups))[0] for groups in (np.arange(200) // 4, np.arange(200)))
    assert grouped == pytest.approx(2 * apart, rel=0.15)


def test_an_interval_where_all_agree_is_that_of_clopper_and_pearson_over_groups() -> None:
    groups = np.arange(40) // 4
    exact = binomtest(10, 10).proportion_ci()
    assert limits(np.ones(40, bool), groups) == pytest.approx((exact.low, 1.0))
    assert limits(np.zeros(40, bool), groups) == pytest.approx((0.0, 1 - exact.low))
    low, high = limits(np.arange(40) < 20, groups)
    assert 0.0 < low < 0.5 < high < 1.0


@pytest.mark.parametrize("alike", [False, True], ids=["episodes apart", "groups of four alike"])
def test_interval_covers_the_truth_nineteen_times_in_twenty(alike: bool) -> None:
    covered = []
    for draw in range(400):
        generator = np.random.default_rng(draw)
        right = np.repeat(generator.random(50) < 0.7, 4) if alike else generator.random(200) < 0.7
        low, high = limits(right, np.arange(200) // 4)
        covered.append(low <= 0.7 <= high)
    assert 0.92 <= np.mean(covered) <= 0.99
