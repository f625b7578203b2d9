import numpy as np
import pytest

from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.shares import share_interval
from probe_kit.statistics.estimates.verdict import (
    ABSENT_BELOW,
    at_most,
    findable,
    is_absent,
    permuted_threshold,
    verdict,
)


def drawn(seed: int, shares: np.ndarray, groups: int, size: int = 4) -> GroupSums:
    """Sites whose groups differ from each other, right in (S,) shares."""
    generator = np.random.default_rng(seed)
    chance = generator.beta(3 * shares[:, None], 3 * (1 - shares[:, None]), (shares.size, groups))
    return GroupSums(generator.binomial(size, chance).astype(float), np.full(groups, float(size)))


def test_the_limit_is_the_highest_of_the_sites_own_limits() -> None:
    sites = drawn(0, np.array([0.5, 0.6, 0.55]), 20)
    each = [at_most(sites.only([row])) for row in range(3)]
    assert at_most(sites) == max(each)
    rest = sites.sums[0] - sites.accuracies[0] * 4
    variance = rest @ rest * 20 / 19 / 80**2
    assert each[0] == pytest.approx(float(share_interval(sites.accuracies[0], variance, 20, 80, 19, tail=0.05)[1]))


@pytest.mark.parametrize("sites", [1, 4, 60])
def test_a_best_site_at_the_bound_is_rarely_called_absent(sites: int) -> None:
    """One site has exactly the bound, the others nothing; and all of them have it."""
    for shares in (np.append(np.full(sites - 1, 0.5), ABSENT_BELOW), np.full(sites, ABSENT_BELOW)):
        wrong = np.mean([at_most(drawn(seed, shares, 60)) < ABSENT_BELOW for seed in range(200)])
        assert wrong < 0.05 + 2.5 * np.sqrt(0.05 * 0.95 / 200)


def test_nothing_is_called_absent_with_many_groups_and_not_shown_with_few() -> None:
    nothing = np.full(60, 0.5)
    assert verdict(False, at_most(drawn(0, nothing, 600)), 0.56) == "absent"
    assert verdict(False, at_most(drawn(0, nothing, 12)), 0.56) == "not shown"


def test_a_signal_is_shown_whatever_it_may_be_at_most() -> None:
    assert verdict(True, 0.55, 0.6) == "shown"
    assert verdict(True, 0.9, 0.99) == "shown"


def test_the_bound_can_be_set_and_is_not_reached_by_itself() -> None:
    assert verdict(False, 0.62, 0.6) == "absent"
    assert verdict(False, 0.62, 0.6, absent_below=0.6) == "not shown"
    assert verdict(False, ABSENT_BELOW, 0.6) == "not shown"


def test_what_the_experiment_could_not_have_found_is_not_absent() -> None:
    assert is_absent(0.62, ABSENT_BELOW)
    assert not is_absent(0.62, ABSENT_BELOW + 0.01)
    assert verdict(False, 0.62, np.inf) == "not shown"


@pytest.mark.parametrize("groups", [20, 60, 150])
def test_a_findable_accuracy_is_found_in_four_of_five_experiments(groups: int) -> None:
    """Sites of independent episodes, compared with a fixed threshold."""
    threshold = 0.5 + 1.645 * np.sqrt(0.25 / (4 * groups))
    sums = np.random.default_rng(0).binomial(4, 0.5, (5, groups)).astype(float)
    least = findable(GroupSums(sums, np.full(groups, 4.0)), threshold)
    drawn = np.random.default_rng(1).binomial(4 * groups, least, 4000) / (4 * groups)
    assert np.mean(drawn > threshold) == pytest.approx(0.8, abs=0.05)


def test_without_permutations_nothing_is_findable() -> None:
    assert permuted_threshold(np.full((3, 19), 0.5)) == np.inf
    assert permuted_threshold(np.tile(np.linspace(0, 1, 101), (2, 1))) == pytest.approx(0.95)
    assert findable(GroupSums(np.full((2, 9), 2.0), np.full(9, 4.0)), np.inf) == np.inf


def test_a_site_that_is_always_right_may_be_all() -> None:
    assert at_most(GroupSums(np.full((2, 9), 4.0), np.full(9, 4.0))) == 1.0


def test_one_group_sets_no_limit() -> None:
    with pytest.raises(TooFewGroupsError, match="1 independent group"):
        at_most(GroupSums(np.ones((2, 1)), np.ones(1)))


def test_two_groups_set_a_limit_and_it_is_a_wide_one() -> None:
    limit = at_most(GroupSums(np.array([[2.0, 3.0]]), np.array([4.0, 4.0])))
    assert ABSENT_BELOW < limit <= 1
    assert limit > at_most(GroupSums(np.array([[2.0, 3.0] * 10]), np.full(20, 4.0)))
