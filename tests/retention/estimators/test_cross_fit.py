import numpy as np
import pytest

from probe_kit.retention.estimators.cross_fit import GroupScores, crossfit, held_out_scores, random_halves

GROUPS = np.repeat(np.arange(100), 2)


def test_scores_are_summed_per_group() -> None:
    scores = GroupScores.of(np.array([[True, True, False], [False, True, True]]), ["a", "a", "b"])
    assert scores.sums.tolist() == [[2, 0], [1, 1]]
    assert scores.sizes.tolist() == [2, 1]


def test_a_single_site_needs_no_choosing_and_keeps_its_accuracy_and_variance() -> None:
    right = np.random.default_rng(0).random((1, 200)) < 0.7
    scores = GroupScores.of(right, np.arange(200))
    fits = [crossfit(scores, scores, 0.5, seed) for seed in range(10)]
    assert fits[0].backbone == fits[0].expert == pytest.approx(right.mean() - 0.5)
    exact = np.full((2, 2), right.var(ddof=1) / 200)
    np.testing.assert_allclose(fits[0].scoring, exact)
    np.testing.assert_allclose(np.mean([fit.covariance for fit in fits], axis=0), exact, rtol=0.1)


def test_episodes_of_a_group_that_agree_count_once() -> None:
    right = np.repeat(np.random.default_rng(0).random((1, 100)) < 0.7, 2, axis=1)
    grouped, alone = (
        np.mean([crossfit(scores, scores, 0.5, seed).covariance[0, 0] for seed in range(10)])
        for scores in (GroupScores.of(right, GROUPS), GroupScores.of(right, np.arange(200)))
    )
    assert grouped == pytest.approx(2 * alone, rel=0.2)


def test_splits_halve_what_they_are_given_and_leave_the_rest_out() -> None:
    sides = random_halves(np.random.default_rng(0), np.array([1, 3, 4, 6, 7]), 8, 20)
    assert (sides[:, [0, 2, 5]] == 0).all()
    assert ((sides == 1).sum(axis=1) == 2).all()
    assert ((sides == -1).sum(axis=1) == 3).all()
    assert np.unique(sides, axis=0).shape[0] > 5


def test_a_group_is_scored_by_the_site_that_is_best_where_it_is_not() -> None:
    """The first site is right in the first half only, the second site everywhere else."""
    scores = GroupScores(np.array([[2.0, 2, 0, 0, 0], [0, 0, 2, 1, 2]]), np.full(5, 2.0))
    sides = np.array([[1, 1, -1, -1, 0]], np.int8)
    assert held_out_scores(scores, sides).tolist() == [[0, 0, 0, 0, 0]]
    assert held_out_scores(scores, np.array([[1, -1, 1, -1, 0]], np.int8)).tolist() == [[2, 2, 0, 0, 0]]


def test_the_variance_is_that_of_the_estimate_over_many_data_sets_with_choosing_in_it() -> None:
    generator = np.random.default_rng(0)
    fits = []
    for draw in range(150):
        scores = GroupScores.of(generator.random((30, 120)) < 0.5, np.arange(120))
        fits.append(crossfit(scores, scores, 0.5, seed=draw))
    spread = np.var([fit.backbone for fit in fits])
    assert np.mean([fit.covariance[1, 1] for fit in fits]) == pytest.approx(spread, rel=0.35)
    assert np.mean([fit.scoring[1, 1] for fit in fits]) < 0.8 * spread


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
