"""Signed effects, tested exactly by item and by group."""

from math import comb

import numpy as np
import pytest

from probe_kit.statistics.paired_signs import greater_p, paired_greater_p, unit_means


def test_all_positive_is_as_likely_as_that_many_heads() -> None:
    assert greater_p(np.full(24, 0.1)) == 2.0**-24
    assert greater_p(np.full(24, -0.1)) == 1.0


def test_zeros_take_no_part() -> None:
    assert greater_p(np.array([0.1] * 5 + [0.0] * 100)) == 2.0**-5
    assert greater_p(np.array([0.1] * 5 + [1e-12, -1e-12])) == 2.0**-5
    assert greater_p(np.zeros(4)) == 1.0


def test_it_is_the_binomial_tail() -> None:
    effects = np.array([1.0] * 9 + [-1.0] * 4)
    assert greater_p(effects) == pytest.approx(sum(comb(13, k) for k in range(9, 14)) / 2**13)


def test_layouts_of_an_item_are_one_effect() -> None:
    """A habit of one side moves both layouts alike, against the correct side in one of them."""
    values = np.array([0.3, -0.1, 0.2, -0.4])
    np.testing.assert_allclose(unit_means(values, ["a", "a", "b", "b"]), [0.1, -0.1])


def test_items_that_share_pictures_count_once() -> None:
    values, items = np.full(12, 0.1), [f"item-{number}" for number in range(12)]
    groups = ["one"] * 10 + ["two", "three"]
    assert paired_greater_p(values, items, items) == 2.0**-12
    assert paired_greater_p(values, items, groups) == 2.0**-3


def test_under_the_null_small_p_values_are_as_rare_as_they_say() -> None:
    """One-sided binomial test at 5 % over 400 worlds in which nothing follows anything."""
    draw = np.random.default_rng(0)
    found = sum(greater_p(draw.normal(size=24)) < 0.05 for _ in range(400))
    assert found <= 27  # P(more | 400, 0.05) < 0.05
