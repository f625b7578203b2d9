import numpy as np
import pytest
from scipy.stats import binomtest

from probe_kit.statistics.mcnemar import grouped_sign_p, sign_p


@pytest.mark.parametrize(("more", "less"), [(0, 0), (5, 5), (1, 0), (9, 1), (2, 11), (40, 20)])
def test_the_sign_test_is_the_exact_binomial_one(more, less):
    expected = binomtest(more, more + less).pvalue if more + less else 1.0
    assert sign_p(more, less) == pytest.approx(expected)
    assert sign_p(less, more) == sign_p(more, less)


def test_items_that_share_pictures_count_once():
    difference = np.array([1, 1, 1, 1, 1, 1])
    alone, together = np.array(list("abcdef")), np.array(list("aaabbb"))
    assert grouped_sign_p(difference, alone) == sign_p(6, 0) == 0.03125
    assert grouped_sign_p(difference, together) == sign_p(2, 0) == 0.5
    assert grouped_sign_p(np.array([1, -1, 0]), np.array(list("aab"))) == 1.0


def test_the_grouped_test_raises_no_false_alarm_where_groups_answer_alike():
    """Over episodes it does: four that answer alike are not four pieces of evidence."""
    rng = np.random.default_rng(0)
    groups = np.repeat([f"g{i}" for i in range(20)], 4)
    grouped, single = [], []
    for _ in range(300):
        difference = np.repeat(rng.choice([-1, 0, 1], 20), 4)
        grouped.append(grouped_sign_p(difference, groups) <= 0.05)
        single.append(sign_p(int((difference > 0).sum()), int((difference < 0).sum())) <= 0.05)
    assert np.mean(grouped) <= 0.06
    assert np.mean(single) > 0.15
