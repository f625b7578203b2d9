"""Exact tests against enumeration and textbook numbers."""

from itertools import product

import numpy as np
import pytest

from probe_kit.statistics.paired_tests import clopper_pearson, fisher_p, flip_p, holm, mcnemar_p, overlap_p


def bools(text: str) -> np.ndarray:
    return np.array([mark == "1" for mark in text])


def test_mcnemar_counts_only_items_on_which_the_two_differ() -> None:
    assert mcnemar_p(bools("1111100000"), bools("1111100000")) == 1
    assert mcnemar_p(bools("111111"), bools("000000")) == pytest.approx(2 / 2**6)
    assert mcnemar_p(bools("1111110"), bools("0000001")) == pytest.approx(2 * (1 + 7) / 2**7)


@pytest.mark.parametrize("seed", range(4))
def test_flips_of_whole_groups_are_those_of_an_enumeration(seed: int) -> None:
    draw = np.random.default_rng(seed)
    first, second = draw.random(21) < 0.7, draw.random(21) < 0.4
    groups = draw.integers(0, 8, 21)
    gains = np.array([(first[groups == g].astype(int) - second[groups == g]).sum() for g in range(8)])
    totals = [abs(np.dot(signs, gains)) for signs in product((1, -1), repeat=8)]
    expected = np.mean([total >= abs(gains.sum()) for total in totals])
    assert flip_p(first, second, groups) == pytest.approx(expected)


def test_groups_that_answer_alike_are_one_toss() -> None:
    first, second, groups = np.ones(20, bool), np.zeros(20, bool), np.repeat([0, 1], 10)
    assert flip_p(first, second, groups) == 0.5
    assert flip_p(first, second, np.arange(20)) == pytest.approx(mcnemar_p(first, second))
    assert flip_p(first, first, groups) == 1


def test_shares_have_exact_intervals() -> None:
    assert clopper_pearson(0, 10) == (0, pytest.approx(1 - 0.025 ** (1 / 10)))
    assert clopper_pearson(10, 10) == (pytest.approx(0.025 ** (1 / 10)), 1)
    assert clopper_pearson(0, 0) == (0, 1)
    low, high = clopper_pearson(4, 20)
    assert (low, high) == (pytest.approx(0.0573, abs=1e-4), pytest.approx(0.4366, abs=1e-4))


def test_links_of_two_properties_are_found_and_none_is_not() -> None:
    tea = bools("11110000"), bools("11101000")  # Fisher's lady
    assert fisher_p(*tea) == pytest.approx(34 / 70)
    same = bools("1010101010" * 4)
    strata = np.repeat([0, 1], 20)
    assert overlap_p(same, same, strata, 0) < 0.001
    assert overlap_p(same, bools("1100110011" * 4), strata, 0) > 0.2


def test_two_strata_that_only_differ_in_level_show_no_link() -> None:
    """Both are right in one category and wrong in the other: within each nothing goes together."""
    both, strata = np.repeat([True, False], 20), np.repeat([0, 1], 20)
    assert overlap_p(both, both, strata, 0) == 1
    assert fisher_p(both, both) < 0.001


def test_holm_is_holms() -> None:
    assert holm([0.01, None, 0.04, 0.03]) == [pytest.approx(0.03), None, pytest.approx(0.06), pytest.approx(0.06)]
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.9, 0.8]) == [1, 1]
    assert holm([]) == []
