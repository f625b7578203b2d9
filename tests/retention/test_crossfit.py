import numpy as np
import pytest

from probe_kit.retention.crossfit import GroupScores, crossfit

GROUPS = np.repeat(np.arange(100), 2)


def test_scores_are_summed_per_group() -> None:
    scores = GroupScores.of(np.array([[True, True, False], [False, True, True]]), ["a", "a", "b"])
    assert scores.sums.tolist() == [[2, 0], [1, 1]]
    assert scores.sizes.tolist() == [2, 1]


def test_a_single_site_needs_no_choosing_and_keeps_its_accuracy_and_variance() -> None:
    right = np.random.default_rng(0).random((1, 200)) < 0.7
    scores = GroupScores.of(right, np.arange(200))
    fit = crossfit(scores, scores, 0.5, seed=0)
    assert fit.backbone == fit.expert == pytest.approx(right.mean() - 0.5)
    np.testing.assert_allclose(fit.covariance, right.var(ddof=1) / 200)


def test_episodes_of_a_group_that_agree_count_once() -> None:
    right = np.repeat(np.random.default_rng(0).random((1, 100)) < 0.7, 2, axis=1)
    grouped, alone = (
        crossfit(scores, scores, 0.5, seed=0).covariance[0, 0]
        for scores in (GroupScores.of(right, GROUPS), GroupScores.of(right, np.arange(200)))
    )
    assert grouped == pytest.approx(2 * alone, rel=0.02)


def test_the_best_of_many_sites_without_signal_scores_chance() -> None:
    """The plain maximum of the same sites lies well above chance."""
    generator = np.random.default_rng(0)
    fits, maxima = [], []
    for draw in range(60):
        right = generator.random((50, 200)) < 0.5
        scores = GroupScores.of(right, GROUPS)
        fits.append(crossfit(scores, scores, 0.5, seed=draw).backbone)
        maxima.append(right.mean(axis=1).max() - 0.5)
    assert abs(np.mean(fits)) < 0.01
    assert np.mean(maxima) > 0.06
