"""No interval gets narrower because one group was seen that is unlike the others; and each covers the truth."""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.statistics.bootstrap import (
    GAINS,
    SHARES,
    Bounds,
    bootstrap_means,
    draw_groups,
    group_bootstrap,
    reach,
    unlike,
    unseen,
    widened,
)
from probe_kit.statistics.paired_tests import clopper_pearson
from probe_kit.statistics.student import student_interval

Values = NDArray[np.float64]
COUNTS = (2, 5, 16)
QUARTERS = np.linspace(0, 1, 5)


def limits(each: Values, bounds: Bounds = SHARES) -> tuple[float, float]:
    """Of (G,) means of groups of one episode each."""
    low, high = group_bootstrap(each[:, None], np.arange(each.size), 0, bounds=bounds)
    return float(low[0]), float(high[0])


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("bounds", [SHARES, GAINS])
def test_one_group_unlike_the_others_draws_no_limit_in_on_its_side(count: int, bounds: Bounds) -> None:
    grid = bounds[0] + (bounds[1] - bounds[0]) * QUARTERS
    for like, other in product(grid, grid):
        alike = np.full(count, like)
        one = alike.copy()
        one[0] = other
        before, after = limits(alike, bounds), limits(one, bounds)
        if other < like:
            assert after[0] <= before[0] + 1e-9, (like, other)
        else:
            assert after[1] >= before[1] - 1e-9, (like, other)


@pytest.mark.parametrize("count", COUNTS)
def test_every_further_miss_lowers_both_limits(count: int) -> None:
    found = np.array([limits((np.arange(count) >= misses).astype(float)) for misses in range(count + 1)])
    assert (np.diff(found, axis=0) <= 1e-9).all()
    exact = np.array([clopper_pearson(count - misses, count) for misses in range(count + 1)])
    np.testing.assert_allclose(found[[0, -1]], exact[[0, -1]], atol=1e-3)


def test_sixteen_of_sixteen_is_better_known_than_fifteen() -> None:
    all_right, one_wrong = limits(np.ones(16)), limits(np.arange(16) > 0)
    assert all_right[0] == pytest.approx(clopper_pearson(16, 16)[0], abs=1e-3)
    assert one_wrong[0] == pytest.approx(15 / 16 * all_right[0], abs=1e-3)
    net_all, net_one = limits(np.ones(16), GAINS), limits((np.arange(16) > 0).astype(float), GAINS)
    assert net_one[1] - net_one[0] > net_all[1] - net_all[0]


def test_groups_that_differ_anyway_are_drawn_as_they_are() -> None:
    each = np.random.default_rng(0).binomial(4, 0.6, 75)[:, None] / 4
    draws = bootstrap_means(each, np.arange(75), 0)
    assert (reach(each) == 0).all()
    wide = widened(draws, each.mean(axis=0), each, 0)
    np.testing.assert_array_equal(*(np.percentile(one, [1, 2.5, 50, 97.5, 99]) for one in (wide, draws)))


def test_draws_keep_their_order_and_equal_ones_have_one_order_for_all() -> None:
    each = (np.arange(12) > 0).astype(float)[:, None]
    draws = bootstrap_means(each, np.arange(12), 0)
    wide = widened(draws, each.mean(axis=0), each, 0)
    order = np.argsort(wide[:, 0], kind="stable")
    assert (np.diff(draws[order, 0]) >= 0).all()
    again = widened(draws + 1e-15 * draw_groups(12, 3)[:, :1], each.mean(axis=0), each, 0)
    np.testing.assert_allclose(again, wide, atol=1e-9)


def test_how_many_are_unlike_most() -> None:
    each = np.array([[1, 1, 0.1], [1, 0, 0.1 + 1e-16], [1, 0, 0.5], [1, 1, 0.7], [1, 0.5, 0.2]])
    assert unlike(each).tolist() == [0, 3, 3]


def test_what_was_not_seen_lies_within_the_bounds_and_about_the_value() -> None:
    for bounds, value in product((SHARES, GAINS), (0.0, 0.4, 1.0)):
        each = np.full((10, 1), value)
        found = unseen(np.array([value]), each, bounds=bounds)[:, 0]
        assert bounds[0] <= found[0] < found[-1] <= bounds[1]
        assert (np.diff(found) >= 0).all()
        assert found[found.size // 2 - 1] <= value <= found[found.size // 2]


WORLDS: dict[str, tuple[Bounds, dict[float, float]]] = {
    "right but for one in twenty": (SHARES, {1: 0.95, 0: 0.05}),
    "right but for one in seven": (SHARES, {1: 0.85, 0: 0.15}),
    "hardly ever half or wrong": (SHARES, {1: 0.9, 0.5: 0.05, 0: 0.05}),
    "often a little wrong, hardly ever all": (SHARES, {1: 0.85, 0.75: 0.1, 0: 0.05}),
    "no gain, or all": (GAINS, {0: 0.8, 1: 0.1, 0.25: 0.1}),
    "all gain, or the reverse": (GAINS, {1: 0.85, 0.5: 0.1, -1: 0.05}),
    "a little either way": (GAINS, {0: 0.8, 0.25: 0.1, -0.25: 0.1}),
}


@pytest.mark.parametrize("world", WORLDS)
def test_intervals_of_groups_that_are_mostly_alike_cover_the_truth(world: str) -> None:
    count = 12
    bounds, shares = WORLDS[world]
    values, chances = np.array(list(shares)), list(shares.values())
    generator = np.random.default_rng(0)
    each = generator.choice(values, (count, 500), p=chances)
    low, high = group_bootstrap(each, np.arange(count), 0, bounds=bounds)
    truth = float(values @ chances)
    covered = (low - 1e-9 <= truth) & (truth <= high + 1e-9)
    assert covered.mean() >= 0.94, "as many as drawn, less what 500 worlds are off by"


@pytest.mark.parametrize(("count", "draw"), [(3, "standard_normal"), (6, "random"), (12, "standard_normal")])
def test_a_measured_quantity_is_covered_with_few_groups(count: int, draw: str) -> None:
    generator = np.random.default_rng(0)
    sample: Callable[[int], Values] = getattr(generator, draw)
    truth = 0.5 if draw == "random" else 0.0
    groups = np.arange(2 * count) // 2
    covered = []
    for _ in range(400):
        low, high = student_interval(sample(count).repeat(2) / 100, groups, 0)
        covered.append(low <= truth / 100 <= high)
    assert np.mean(covered) >= 0.92


def test_a_measured_quantity_has_limits_where_nothing_varies() -> None:
    assert student_interval(np.array([0.2, 0.4]), ["a", "a"], 0) == GAINS
    low, high = student_interval(np.full(10, 0.2), np.arange(10), 0)
    assert -1 < low < 0.2 < high < 1
    assert student_interval(np.array([-1.0, 1.0, 1.0]), np.arange(3), 0) == GAINS
