from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import permutation_test, ttest_ind

from probe_kit.errors import UsageError
from probe_kit.statistics import model_groups
from probe_kit.statistics.intervals import NO_LIMITS, Interval
from probe_kit.statistics.model_groups import exchange_p, is_exchangeable, welch_interval
from probe_kit.statistics.paired_tests import flip_gains_p


def gap(first: np.ndarray, second: np.ndarray) -> float:
    return float(abs(np.mean(first) - np.mean(second)))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 5))
def test_p_is_the_exact_permutation_p(seed: int, first: int, second: int) -> None:
    values = np.random.default_rng(seed).random(first + second)
    result = exchange_p(values[:first], values[first:])
    assert result.exact
    assert result.smallest <= result.p <= 1
    if min(first, second) > 1:
        groups = (values[:first], values[first:])
        expected = permutation_test(groups, gap, n_resamples=np.inf, alternative="greater")
        assert result.p == pytest.approx(expected.pvalue)


@pytest.mark.parametrize(
    ("first", "second", "smallest"), [(3, 3, 0.1), (4, 4, 2 / 70), (2, 3, 0.1), (1, 4, 0.2), (6, 6, 2 / 924)]
)
def test_so_few_models_allow_no_smaller_p(first: int, second: int, smallest: float) -> None:
    apart = exchange_p(np.arange(first) / 100, 1 + np.arange(second) / 100)
    assert apart.p == pytest.approx(smallest)
    assert apart.smallest == pytest.approx(smallest)


def test_equal_models_give_a_p_of_one() -> None:
    assert exchange_p([0.4, 0.4, 0.4], [0.4, 0.4, 0.4]).p == 1


def test_p_is_below_five_percent_in_at_most_five_percent_of_equal_groups() -> None:
    generator = np.random.default_rng(0)
    p_values = [exchange_p(*generator.standard_normal((2, 4))).p for _ in range(1000)]
    assert np.mean(np.array(p_values) <= 0.05) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize(("models", "categories"), [(3, 1), (3, 12), (5, 1), (5, 12)])
def test_items_as_the_unit_take_differences_between_models_for_an_effect_of_their_group(
    models: int, categories: int
) -> None:
    """Two groups of models without any effect of the group, as different as the paper's six (8 points).

    Why comparisons of groups lead with p over models: the p over items is small in half of all categories, and in
    more of all means over categories.
    """
    generator = np.random.default_rng(0)
    over_items, over_models = [], []
    for draw in range(400):
        rates = generator.normal(0.6, 0.08, 2 * models).clip(0, 1)
        right = generator.binomial(2, rates[:, None], (2 * models, 150 * categories))  # of two layouts
        over_models.append(exchange_p(*right.mean(axis=1).reshape(2, models)).p)
        if draw < 60:
            gains = right[:models].sum(axis=0) - right[models:].sum(axis=0)
            over_items.append(flip_gains_p(gains, np.arange(gains.size)))
    assert np.mean(np.array(over_items) < 0.05) > (0.3 if categories == 1 else 0.6)
    assert np.mean(np.array(over_models) <= 0.05) <= (0.06 if models == 5 else 0), "3 + 3: p is at least 0.10"


def test_labels_of_very_many_models_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).random(10)
    exact = exchange_p(values[:5], values[5:])
    assert comb(10, 5) < model_groups.MOST_EXACT
    monkeypatch.setattr(model_groups, "MOST_EXACT", 100)
    drawn = exchange_p(values[:5], values[5:])
    assert not drawn.exact
    assert drawn.p == pytest.approx(exact.p, abs=0.015)
    assert drawn == exchange_p(values[:5], values[5:]), "the same draws"
    assert drawn.smallest == pytest.approx(1 / 20_001)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 6), st.integers(2, 6))
def test_the_interval_is_welchs(seed: int, first: int, second: int) -> None:
    generator = np.random.default_rng(seed)
    first_group, other = generator.random(first), 3 * generator.random(second)
    expected = ttest_ind(first_group, other, equal_var=False).confidence_interval(0.95)
    interval = welch_interval(first_group, other)
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))


def test_a_single_model_is_given_the_spread_of_the_other_group() -> None:
    interval = welch_interval([0.9], [0.4, 0.5, 0.6])
    spread = 4.302653 * 0.1 * np.sqrt(1 + 1 / 3)
    assert (interval.low, interval.high) == pytest.approx((0.4 - spread, 0.4 + spread))
    mirrored = welch_interval([0.4, 0.5, 0.6], [0.9])
    assert (mirrored.low, mirrored.high) == pytest.approx((-interval.high, -interval.low))


def test_models_without_any_spread_give_no_limits() -> None:
    assert welch_interval([0.5], [0.6]) == NO_LIMITS
    assert welch_interval([0.5, 0.5], [0.6, 0.6]) == NO_LIMITS


def test_limits_stay_within_what_is_possible() -> None:
    """Two models and one: by Welch's t, rates would differ by −706 to +577 points."""
    wide = welch_interval([0.0, 1.0], [0.4, 0.9])
    assert wide.low < -1 < 1 < wide.high
    assert welch_interval([0.0, 1.0], [0.4, 0.9], largest=1.0) == NO_LIMITS
    one_sided = welch_interval([0.9, 1.0], [0.4], largest=1.0)
    free = welch_interval([0.9, 1.0], [0.4])
    assert one_sided == Interval(free.low, 1.0)
    assert welch_interval([0.4], [0.9, 1.0], largest=1.0) == Interval(-1.0, -free.low)
    narrow = [0.9, 0.91, 0.92], [0.5, 0.51, 0.52]
    assert welch_interval(*narrow, largest=1.0) == welch_interval(*narrow)


def test_empty_groups_and_missing_values_are_refused() -> None:
    for compare in (exchange_p, welch_interval):
        with pytest.raises(UsageError, match="groups of 0 and 2 models"):
            compare([], [0.1, 0.2])
        with pytest.raises(UsageError, match="expected finite numbers"):
            compare([0.1, float("nan")], [0.2])


@pytest.mark.slow
@pytest.mark.parametrize(("few", "many"), [(2, 8), (3, 6), (4, 8), (3, 9), (5, 5), (6, 6)])
def test_p_that_is_shown_holds_its_level_whatever_the_spreads(few: int, many: int) -> None:
    generator = np.random.default_rng(0)
    for spread in (1, 3, 5):
        alarms = []
        for _ in range(400):
            pair = generator.normal(0, spread, few), generator.normal(0, 1, many)
            alarms.append(is_exchangeable(*pair) and exchange_p(*pair).p <= 0.05)
        assert np.mean(alarms) < 0.08


def test_groups_of_like_spread_or_of_one_model_are_exchangeable() -> None:
    assert is_exchangeable([0.1, 0.9], [0.5, 0.5])
    assert is_exchangeable([0.1], [0.5, 0.5, 0.6])
    assert not is_exchangeable([0.1, 0.9], [0.5, 0.5, 0.6])
    assert is_exchangeable([0.5, 0.5], [0.5, 0.1, 0.9])
    assert not is_exchangeable([0.3, 0.7], [0.5, 0.2, 0.8])
    assert is_exchangeable([0.1, 0.3, 0.5, 0.7], [0.4, 0.5, 0.6, 0.7])
    assert not is_exchangeable([0.1, 0.3, 0.5, 0.7], [0.49, 0.5, 0.51, 0.52])
    assert is_exchangeable([0.5] * 4, [0.6] * 4)
