import numpy as np
import pytest
from scipy.stats import t

from probe_kit.errors import UsageError
from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.crossfit import Stream
from probe_kit.statistics.estimates.scores import Scores, accuracy_interval, t_quantile
from tests.support.inner_qualities import fitted, stream_of


def stream(share: float, groups: int, seed: int = 0) -> Stream:
    sums = np.random.default_rng(seed).binomial(4, share, (6, groups)).astype(float)
    return stream_of(GroupSums(sums, np.full(groups, 4.0)), np.arange(6))


def test_a_mean_over_categories_adds_variances_and_has_satterthwaites_degrees_of_freedom() -> None:
    parts = [
        Scores(np.array([0.1, 0.2]), np.array([[0.01, 0.002], [0.002, 0.03]]), 11),
        Scores(np.array([0.3, 0.4]), np.array([[0.03, 0.006], [0.006, 0.05]]), 23),
    ]
    mean = Scores.mean(parts)
    np.testing.assert_allclose(mean.above, [0.2, 0.3])
    np.testing.assert_allclose(mean.covariance, [[0.01, 0.002], [0.002, 0.02]])
    assert mean.df == pytest.approx(0.12**2 / (0.04**2 / 11 + 0.08**2 / 23))


def test_the_mean_of_one_category_is_that_category() -> None:
    one = Scores.of(fitted(stream(0.6, 20), stream(0.7, 20)))
    mean = Scores.mean([one])
    np.testing.assert_array_equal(mean.above, one.above)
    np.testing.assert_array_equal(mean.covariance, one.covariance)
    assert mean.df == one.df == 19


def test_a_category_that_varies_most_is_known_no_better_for_the_others() -> None:
    loose, tight = (Scores(np.zeros(2), np.eye(2) * variance, 5) for variance in (0.01, 1e-6))
    assert Scores.mean([loose, tight, tight]).df == pytest.approx(5, rel=1e-3)
    assert Scores.mean([loose, loose, loose]).df == pytest.approx(15)
    assert Scores.mean([Scores(np.zeros(2), np.zeros((2, 2)), 5)] * 2).df == 10


def test_a_perfect_site_is_known_as_well_as_its_groups_allow() -> None:
    perfect = stream_of(GroupSums(np.full((2, 12), 4.0), np.full(12, 4.0)), np.arange(2))
    interval = accuracy_interval(fitted(perfect), 0)
    assert (interval.low, interval.high) == pytest.approx((0.7575, 1.0), abs=5e-4)


def test_the_interval_of_an_accuracy_holds_what_choosing_adds() -> None:
    fit = fitted(stream(0.7, 40))
    interval = accuracy_interval(fit, 0)
    assert interval.low < 0.5 + fit.above[0] < interval.high
    assert interval.high - interval.low > 3.9 * np.sqrt(0.7 * 0.3 / 160) * 0.8


def test_no_categories_have_no_mean() -> None:
    with pytest.raises(UsageError, match="no categories"):
        Scores.mean([])


@pytest.mark.parametrize("df", [1, 3, 50, 600])
def test_quantiles_are_students(df: int) -> None:
    assert t_quantile(df) == pytest.approx(t.ppf(0.975, df))
    assert t_quantile(df, 0.05) == pytest.approx(t.ppf(0.95, df))
