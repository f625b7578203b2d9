"""Scores whose sites are chosen by inner folds: no bias without signal, spread as claimed, exact by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit.errors import TooFewGroupsError, UsageError
from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.crossfit import Stream, crossfit, smoothing
from tests.support.inner_qualities import fitted, stream_of

LAYERS, ITERATIONS = np.tile(np.arange(4), 3), np.repeat(np.arange(3), 4)
FOLDS = 5


def drawn(seed: int, shares: np.ndarray, groups: int, size: int = 4) -> GroupSums:
    """Independent correctness of sites that are right in (S,) shares."""
    generator = np.random.default_rng(seed)
    sums = generator.binomial(size, shares[:, None], (shares.size, groups)).astype(float)
    return GroupSums(sums, np.full(groups, float(size)))


def backbone(seed: int, top: float = 0.2, groups: int = 30) -> Stream:
    return stream_of(drawn(seed, 0.5 + top * np.array([0.2, 0.6, 1.0, 0.5]), groups), np.arange(4))


def expert(seed: int, top: float = 0.1, groups: int = 30) -> Stream:
    return stream_of(drawn(seed, np.full(12, 0.5 + top), groups), LAYERS, ITERATIONS)


def test_a_site_that_stands_out_is_always_chosen_and_scored_by_the_outer_folds() -> None:
    sums = GroupSums(np.array([[2.0] * 10, [3.0] * 10, [1.0] * 10]), np.full(10, 4.0))
    fit = fitted(stream_of(sums, [0, 1, 2]))
    assert fit.above[0] == pytest.approx(0.25)
    assert fit.peaks[0] == 0.75


def test_every_fold_is_scored_at_the_site_that_its_own_inner_folds_choose() -> None:
    """The inner folds of fold 0 prefer site 1, those of the others site 0, whatever the outer folds say."""
    groups = 10
    fold_of = np.arange(groups) % FOLDS
    sums = GroupSums(np.array([[4.0] * groups, [2.0] * groups]), np.full(groups, 4.0))
    inner = np.where(fold_of == np.arange(FOLDS)[:, None], 0.0, 1.0) * np.ones((2, 1, 1))
    inner[0, 0] *= 0.5
    inner[1, 1:] *= 0.5
    stream = Stream.of(sums, inner, fold_of, [0, 1])
    assert stream.best.tolist() == [1, 0, 0, 0, 0]
    assert fitted(stream).above[0] == pytest.approx((2 * 0.5 + 8 * 1.0) / 10 - 0.5)


def test_without_signal_the_score_is_zero_on_average_however_high_the_peak() -> None:
    fits = [fitted(stream_of(drawn(seed, np.full(40, 0.5), 12), np.arange(40))) for seed in range(250)]
    assert abs(np.mean([fit.above[0] for fit in fits])) < 0.01
    assert np.mean([fit.peaks[0] for fit in fits]) > 0.6


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.randoms(use_true_random=False))
def test_the_order_of_sites_does_not_matter_even_where_they_tie(seed: int, random: object) -> None:
    scores = drawn(seed, np.full(12, 0.6), 6, size=2)
    order = np.array(random.sample(range(12), 12))  # type: ignore[attr-defined]
    one = fitted(stream_of(scores, LAYERS, ITERATIONS))
    other = fitted(stream_of(scores.only(order), LAYERS[order], ITERATIONS[order]))
    np.testing.assert_allclose(one.above, other.above, atol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)


def test_the_same_streams_have_the_same_scores_whatever_was_fitted_before() -> None:
    alone = fitted(expert(1), backbone(1))
    for seed in range(6):
        fitted(backbone(seed, groups=20 + seed))
    again = fitted(expert(1), backbone(1))
    np.testing.assert_array_equal(alone.above, again.above)
    np.testing.assert_array_equal(alone.covariance, again.covariance)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(5, 40), st.floats(0, 0.5))
def test_a_joint_covariance_is_positive_semidefinite(seed: int, groups: int, top: float) -> None:
    fit = fitted(expert(seed, top, groups), backbone(seed, top, groups), expert(seed, 0.0, groups))
    assert np.linalg.eigvalsh(fit.covariance).min() > -1e-12


def test_two_runs_on_the_same_groups_have_the_covariance_of_one_joint_fit() -> None:
    streams = [expert(1), backbone(1), expert(2), backbone(2)]
    joint, first, second = fitted(*streams), fitted(*streams[:2]), fitted(*streams[2:])
    np.testing.assert_allclose(joint.covariance[:2, 2:], first.covariance_with(second), atol=1e-15)
    np.testing.assert_allclose(joint.covariance[:2, :2], first.covariance, atol=1e-15)
    elsewhere = fitted(*streams[2:], suite="other@1")
    assert not first.covariance_with(elsewhere).any(), "equal names of another suite are other groups"


def test_with_one_site_the_variance_is_that_of_a_mean_over_groups() -> None:
    sums = drawn(0, np.full(1, 0.7), 30)
    fit = fitted(stream_of(sums, [0]))
    assert fit.covariance[0, 0] == pytest.approx(np.var(sums.sums[0] / 4, ddof=1) / 30)


def test_the_variance_is_that_of_the_score_over_data_sets() -> None:
    fits = [fitted(backbone(seed), expert(seed + 1000, 0.15)) for seed in range(200)]
    actual = np.var([fit.above for fit in fits], axis=0, ddof=1)
    claimed = np.mean([fit.covariance.diagonal() for fit in fits], axis=0)
    assert (claimed / actual > 0.8).all()
    assert (claimed / actual < 2.2).all(), "most where twelve sites are equally good and every choice is luck"


def test_where_all_groups_agree_a_group_at_chance_may_be_unseen() -> None:
    perfect = stream_of(GroupSums(np.full((3, 12), 4.0), np.full(12, 4.0)), np.arange(3))
    fit = fitted(perfect, perfect)
    np.testing.assert_allclose(fit.above, 0.5)
    np.testing.assert_allclose(fit.influence, 0, atol=1e-15)
    np.testing.assert_allclose(fit.covariance, np.eye(2) * 2 / (13 * 14) / 4, atol=1e-30)


def test_degrees_of_freedom_are_a_group_less() -> None:
    assert [fitted(backbone(0, groups=groups)).df for groups in (5, 51, 150)] == [4, 50, 149]


def test_the_guide_of_a_stream_that_runs_once_is_its_own_quality() -> None:
    scores = drawn(0, np.full(4, 0.6), 8)
    plain = stream_of(scores, np.arange(4)).guide
    np.testing.assert_array_equal(plain, stream_of(scores, np.arange(4), np.full(4, 7)).guide)
    np.testing.assert_array_equal(plain[:, 0, 1:5], scores.sums[:, 1:5])


def test_the_guide_of_several_iterations_is_half_the_site_and_half_its_surroundings() -> None:
    scores = drawn(0, np.full(12, 0.6), 8)
    along_layers = np.array([[3, 1, 0, 0], [1, 2, 1, 0], [0, 1, 2, 1], [0, 0, 1, 3]]) / 4
    along_iterations = np.array([[3, 1, 0], [1, 2, 1], [0, 1, 3]]) / 4
    around = np.kron(along_iterations, along_layers)
    np.testing.assert_allclose(smoothing(LAYERS, ITERATIONS), around)
    plain = stream_of(scores, np.zeros(12)).guide
    guide = stream_of(scores, LAYERS, ITERATIONS).guide
    np.testing.assert_allclose(guide, (plain + np.einsum("st,tfg->sfg", around, plain)) / 2)


def test_layers_that_were_not_captured_leave_the_others_as_neighbours() -> None:
    np.testing.assert_allclose(smoothing([0, 8, 16], [0, 0, 0]), smoothing([0, 1, 2], [0, 0, 0]))
    weights = smoothing([0, 1, 0], [0, 0, 1])  # layer 1 lacks at iteration 1
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert weights[2, 1] == pytest.approx(0.25 * 0.25)


def test_groups_of_unequal_weight_count_by_their_episodes() -> None:
    sizes = np.array([1.0, 2, 3, 10, 2, 4, 1, 5])
    sums = GroupSums(np.array([0.8 * sizes, 0.5 * sizes]), sizes)
    fit = fitted(stream_of(sums, [0, 1]))
    assert fit.above[0] == pytest.approx(0.3)
    assert fit.n_episodes == sizes.sum()


def test_fewer_groups_than_outer_folds_are_refused() -> None:
    one = Stream.of(GroupSums(np.ones((1, 4)), np.ones(4)), np.zeros((1, 4, 4)), np.arange(4), [0])
    with pytest.raises(TooFewGroupsError, match="4 independent groups of items; expected at least 5"):
        crossfit([one], list("abcd"))


def test_streams_on_other_groups_nan_and_places_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError, match=r"streams on \[20, 30\] groups, and 30 names"):
        fitted(backbone(0), backbone(0, groups=20))
    broken = drawn(0, np.full(4, 0.6), 8)
    stream = stream_of(broken, np.arange(4))
    broken.sums[0, 0] = np.nan
    with pytest.raises(UsageError, match="sums hold NaN"):
        fitted(stream)
    with pytest.raises(UsageError, match="3 layers and 3 iterations for 4 sites"):
        stream_of(drawn(0, np.full(4, 0.6), 8), np.arange(3))
    with pytest.raises(UsageError, match="at least one site"):
        stream_of(drawn(0, np.zeros(0), 8), [])


def test_inner_qualities_of_other_folds_or_of_tested_groups_are_refused() -> None:
    sums, folds = drawn(0, np.full(2, 0.6), 8), np.arange(8) % FOLDS
    with pytest.raises(UsageError, match=r"inner qualities \(2, 5, 7\) and folds \(8,\) for 2 sites and 8 groups"):
        Stream.of(sums, np.zeros((2, FOLDS, 7)), folds, [0, 1])
    with pytest.raises(UsageError, match="a group is tested by fold 4; expected folds 0 to 2"):
        Stream.of(sums, np.zeros((2, 3, 8)), folds, [0, 1])
    with pytest.raises(UsageError, match="groups in the fold that tests them; expected 0 there"):
        Stream.of(sums, np.ones((2, FOLDS, 8)), folds, [0, 1])
