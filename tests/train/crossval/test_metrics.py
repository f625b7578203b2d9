import numpy as np
import pytest
from scipy.stats import binomtest
from sklearn import metrics

from probe_kit.statistics.bootstrap import group_bootstrap
from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.metrics import balanced_accuracy, chance_level, fold_auc, log_loss

GENERATOR = np.random.default_rng(0)
LABELS = GENERATOR.random(80) < 0.3
DECISIONS = np.round(GENERATOR.standard_normal(80) + LABELS, 1)  # rounded, so that there are ties
EVERYTHING = [Fold(np.arange(0), np.arange(80))]


def test_scores_equal_scikit_learn() -> None:
    probability = 1 / (1 + np.exp(-DECISIONS))
    assert log_loss(DECISIONS, LABELS) == pytest.approx(metrics.log_loss(LABELS, probability))
    assert balanced_accuracy(DECISIONS, LABELS) == pytest.approx(
        metrics.balanced_accuracy_score(LABELS, DECISIONS > 0)
    )
    assert fold_auc(DECISIONS, LABELS, EVERYTHING) == pytest.approx(metrics.roc_auc_score(LABELS, DECISIONS))


def test_auc_does_not_compare_decisions_across_folds() -> None:
    halves = [Fold(np.arange(40, 80), np.arange(40)), Fold(np.arange(40), np.arange(40, 80))]
    shifted = DECISIONS + np.where(np.arange(80) < 40, 0, 100)
    assert fold_auc(shifted, LABELS, halves) == pytest.approx(fold_auc(DECISIONS, LABELS, halves))


def test_chance_is_the_larger_class() -> None:
    assert chance_level(np.array([True, False])) == 0.5
    assert chance_level(np.array([True, False, False, False])) == 0.75


def test_interval_widens_when_episodes_of_a_group_agree() -> None:
    right = np.repeat(GENERATOR.random(50) < 0.6, 4)[:, None]
    low, high = group_bootstrap(right, np.arange(200) // 4, seed=0)
    low_ungrouped, high_ungrouped = group_bootstrap(right, np.arange(200), seed=0)
    assert high - low == pytest.approx(2 * (high_ungrouped - low_ungrouped), rel=0.15)


def test_an_interval_where_all_agree_is_that_of_clopper_and_pearson_over_groups() -> None:
    right = np.array([[True, False, True], [True, False, False]]).repeat(20, axis=0)
    low, high = group_bootstrap(right, np.arange(40) // 4, seed=0)
    exact = binomtest(10, 10).proportion_ci()
    assert (low[0], high[0]) == (pytest.approx(exact.low, abs=1e-4), 1.0)
    assert (low[1], high[1]) == (0.0, pytest.approx(1 - exact.low, abs=1e-4))
    assert 0.0 < low[2] < high[2] < 1.0


def test_interval_covers_the_truth_nineteen_times_in_twenty() -> None:
    covered = []
    for draw in range(300):
        right = np.random.default_rng(draw).random((200, 1)) < 0.7
        low, high = group_bootstrap(right, np.arange(200), seed=draw, draws=500)
        covered.append(low[0] <= 0.7 <= high[0])
    assert 0.92 <= np.mean(covered) <= 0.98
