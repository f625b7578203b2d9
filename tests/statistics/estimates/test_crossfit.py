from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit.errors import TooFewGroupsError, UsageError
from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.crossfit import (
    HALVINGS,
    CrossFit,
    Stream,
    crossfit,
    held_out_scores,
    smoothing,
)

LAYERS, ITERATIONS = np.tile(np.arange(4), 3), np.repeat(np.arange(3), 4)


def drawn(seed: int, shares: np.ndarray, groups: int, size: int = 4) -> GroupSums:
    """Independent correctness of sites that are right in (S,) shares. Splits need seeds of their own."""
    generator = np.random.default_rng(seed)
    sums = generator.binomial(size, shares[:, None], (shares.size, groups)).astype(float)
    return GroupSums(sums, np.full(groups, float(size)))


def backbone(seed: int, top: float = 0.2, groups: int = 30) -> Stream:
    return Stream.of(drawn(seed, 0.5 + top * np.array([0.2, 0.6, 1.0, 0.5]), groups), np.arange(4))


def expert(seed: int, top: float = 0.1, groups: int = 30) -> Stream:
    return Stream.of(drawn(seed, np.full(12, 0.5 + top), groups), LAYERS, ITERATIONS)


def scored_by_hand(stream: Stream, split: np.ndarray) -> float:
    """Mean accuracy of each half's best sites on the other half, every episode counted once."""
    right = 0.0
    for half in (1, -1):
        guide = np.array([site[split == half].sum() for site in stream.guide])
        best = [row for row, value in enumerate(guide) if np.isclose(value, guide.max())]
        right += np.mean([stream.scores.sums[row][split == -half].sum() for row in best])
    return right / stream.scores.sizes[split != 0].sum()


def test_scores_of_splits_are_those_of_two_loops() -> None:
    generator = np.random.default_rng(0)
    splits = generator.integers(-1, 2, (300, 30)).astype(np.int8)
    splits[:, :2] = 1, -1
    for stream in (backbone(1), expert(2)):
        expected = [scored_by_hand(stream, split) for split in splits]
        np.testing.assert_allclose(held_out_scores(stream, splits), expected, atol=1e-12)


def test_a_hundred_halvings_come_near_to_all_of_them() -> None:
    stream = backbone(3, groups=10)
    ways = [np.isin(np.arange(10), half) * 2 - 1 for half in combinations(range(10), 5)]
    everything = np.mean([scored_by_hand(stream, way) for way in ways]) - 0.5
    spread = np.std([scored_by_hand(stream, way) for way in ways]) / 10
    found = [crossfit([stream], seed).above[0] for seed in range(20)]
    assert np.mean(found) == pytest.approx(everything, abs=4 * spread / np.sqrt(20))


def test_a_site_that_stands_out_is_always_chosen() -> None:
    sums = GroupSums(np.array([[2.0] * 8, [3.0] * 8, [1.0] * 8]), np.full(8, 4.0))
    fit = crossfit([Stream.of(sums, [0, 1, 2])], 0)
    assert fit.above[0] == pytest.approx(0.25)
    assert fit.peaks[0] == 0.75


def test_without_signal_the_score_is_zero_on_average_however_high_the_peak() -> None:
    streams = [Stream.of(drawn(seed, np.full(40, 0.5), 12), np.arange(40)) for seed in range(250)]
    fits = [crossfit([stream], 1_000_000 + seed) for seed, stream in enumerate(streams)]
    above = np.array([fit.above[0] for fit in fits])
    assert abs(above.mean()) < 0.01
    assert np.mean([fit.peaks[0] for fit in fits]) > 0.6


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.randoms(use_true_random=False))
def test_the_order_of_sites_does_not_matter_even_where_they_tie(seed: int, random: object) -> None:
    scores = drawn(seed, np.full(12, 0.6), 6, size=2)
    order = np.array(random.sample(range(12), 12))  # type: ignore[attr-defined]
    one = crossfit([Stream.of(scores, LAYERS, ITERATIONS)], 5)
    other = crossfit([Stream.of(scores.only(order), LAYERS[order], ITERATIONS[order])], 5)
    np.testing.assert_allclose(one.above, other.above, atol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)


def test_other_categories_and_the_order_of_work_do_not_matter() -> None:
    alone = crossfit([expert(1), backbone(1)], 11)
    for seed in range(6):
        crossfit([backbone(seed)], seed)
    again = crossfit([expert(1), backbone(1)], 11)
    np.testing.assert_array_equal(alone.above, again.above)
    np.testing.assert_array_equal(alone.covariance, again.covariance)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(4, 40), st.floats(0, 0.5))
def test_a_joint_covariance_is_positive_semidefinite(seed: int, groups: int, top: float) -> None:
    streams = [expert(seed, top, groups), backbone(seed, top, groups), expert(seed, 0.0, groups)]
    values = np.linalg.eigvalsh(crossfit(streams, seed).covariance)
    assert values.min() > -1e-12


def test_two_runs_on_the_same_groups_have_the_covariance_of_one_joint_fit() -> None:
    streams = [expert(1), backbone(1), expert(2), backbone(2)]
    joint = crossfit(streams, 9)
    first, second = crossfit(streams[:2], 9), crossfit(streams[2:], 9)
    np.testing.assert_allclose(joint.covariance[:2, 2:], first.covariance_with(second), atol=1e-15)
    np.testing.assert_allclose(joint.covariance[:2, :2], first.covariance, atol=1e-15)
    assert not first.covariance_with(crossfit(streams[2:], 10)).any(), "other seeds stand for other groups"


def test_the_variance_is_that_of_the_score_over_data_sets() -> None:
    fits = [crossfit([backbone(seed), expert(seed + 1000, 0.15)], seed + 2000) for seed in range(100)]
    actual = np.var([fit.above for fit in fits], axis=0, ddof=1)
    claimed = np.mean([fit.covariance.diagonal() for fit in fits], axis=0)
    assert (claimed / actual > 0.8).all()
    assert (claimed / actual < 1.7).all()


def test_where_all_groups_agree_a_group_at_chance_may_be_unseen() -> None:
    perfect = Stream.of(GroupSums(np.full((3, 12), 4.0), np.full(12, 4.0)), np.arange(3))
    fit = crossfit([perfect, perfect], 0)
    np.testing.assert_allclose(fit.above, 0.5)
    assert not fit.differences.any()
    np.testing.assert_allclose(fit.covariance, np.eye(2) * 2 / (13 * 14) / 4)


def test_degrees_of_freedom_are_a_group_less_and_at_most_fifty() -> None:
    found = [crossfit([backbone(0, groups=groups)], 0).df for groups in (4, 51, 52, 150)]
    assert found == [3, 50, 50, 50]


def test_the_guide_of_a_stream_that_runs_once_is_its_own_sums() -> None:
    scores = drawn(0, np.full(4, 0.6), 8)
    assert Stream.of(scores, np.arange(4)).guide is scores.sums
    assert Stream.of(scores, np.arange(4), np.full(4, 7)).guide is scores.sums


def test_the_guide_of_several_iterations_is_half_the_site_and_half_its_surroundings() -> None:
    scores = drawn(0, np.full(12, 0.6), 8)
    along_layers = np.array([[3, 1, 0, 0], [1, 2, 1, 0], [0, 1, 2, 1], [0, 0, 1, 3]]) / 4
    along_iterations = np.array([[3, 1, 0], [1, 2, 1], [0, 1, 3]]) / 4
    around = np.kron(along_iterations, along_layers)
    np.testing.assert_allclose(smoothing(LAYERS, ITERATIONS), around)
    guide = Stream.of(scores, LAYERS, ITERATIONS).guide
    np.testing.assert_allclose(guide, (scores.sums + around @ scores.sums) / 2)


def test_layers_that_were_not_captured_leave_the_others_as_neighbours() -> None:
    np.testing.assert_allclose(smoothing([0, 8, 16], [0, 0, 0]), smoothing([0, 1, 2], [0, 0, 0]))
    weights = smoothing([0, 1, 0], [0, 0, 1])  # layer 1 lacks at iteration 1
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert weights[2, 1] == pytest.approx(0.25 * 0.25)


def test_groups_of_unequal_weight_count_by_their_episodes() -> None:
    sizes = np.array([1.0, 2, 3, 10, 2, 4, 1, 5])
    sums = GroupSums(np.array([0.8 * sizes, 0.5 * sizes]), sizes)
    fit = crossfit([Stream.of(sums, [0, 1])], 0)
    assert fit.above[0] == pytest.approx(0.3)
    assert fit.n_episodes == sizes.sum()


def test_fewer_than_four_groups_are_refused() -> None:
    assert isinstance(crossfit([backbone(0, groups=4)], 0), CrossFit)
    with pytest.raises(TooFewGroupsError, match="3 independent groups of items; expected at least 4"):
        crossfit([backbone(0, groups=3)], 0)


def test_streams_on_other_groups_nan_and_places_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError, match=r"streams on \[20, 30\] groups"):
        crossfit([backbone(0), backbone(0, groups=20)], 0)
    broken = drawn(0, np.full(4, 0.6), 8)
    broken.sums[0, 0] = np.nan
    with pytest.raises(UsageError, match="sums hold NaN"):
        crossfit([Stream.of(broken, np.arange(4))], 0)
    with pytest.raises(UsageError, match="3 layers and 3 iterations for 4 sites"):
        Stream.of(drawn(0, np.full(4, 0.6), 8), np.arange(3))
    with pytest.raises(UsageError, match="at least one site"):
        Stream.of(drawn(0, np.zeros(0), 8), [])


def test_differences_have_a_column_for_every_halving() -> None:
    assert crossfit([expert(0), backbone(0)], 0).differences.shape == (2, HALVINGS)
