"""Cross-fitted scores of streams, and retention, against formulas and simulations."""

from collections.abc import Callable
from dataclasses import replace
from math import isnan, sqrt

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.retention import best_site, measure_retention
from probe_kit.retention.behaviour import success_share
from probe_kit.retention.estimators import (
    NO_SCORES,
    PooledScores,
    Rate,
    Retention,
    StreamScores,
    curve_scores,
    limits,
    score_streams,
)
from probe_kit.statistics.intervals import Interval, Share
from probe_kit.statistics.retention import Scores, retention, retention_difference
from probe_kit.train import ProbeCurve
from tests.support.inner_qualities import inner_of

CurveOf = Callable[..., ProbeCurve]
Outcomes = Callable[..., pd.DataFrame]
PLAIN = ([0.5, 0.9, 0.7], [[0.55, 0.6], [0.7, 0.6]])


@pytest.fixture
def episodes(outcome_table: Outcomes) -> pd.DataFrame:
    return outcome_table(100, 100, 0)


def measured(curve: ProbeCurve) -> tuple[Retention, StreamScores]:
    measurement = measure_retention(curve)
    assert measurement is not None
    assert measurement.streams is not None
    return measurement, measurement.streams


def some_episodes(curve: ProbeCurve, selected: np.ndarray) -> ProbeCurve:
    """The curve of a run from which the other episodes are missing."""
    array_fields = {
        name: getattr(curve, name)[selected] for name in ("labels", "episodes", "items", "groups", "fold_of")
    }
    return replace(curve, decisions=curve.decisions[:, selected], **array_fields)


def some_sites(curve: ProbeCurve, rows: np.ndarray) -> ProbeCurve:
    """The curve with its sites in another order."""
    array_fields = {name: getattr(curve, name)[rows] for name in ("decisions", "strengths", "null", "inner")}
    sites, parts = (tuple(listed[row] for row in rows) for listed in (curve.sites, curve.parts))
    return replace(curve, sites=sites, parts=parts, **array_fields)


def test_retention_is_the_ratio_of_two_scores_above_one_half(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    measurement, streams = measured(curve_of(episodes, *PLAIN))
    assert measurement.defined
    assert measurement.note == ""
    above = {name: streams.accuracy(name) - 0.5 for name in ("action", "backbone")}
    assert measurement.value == pytest.approx(above["action"] / above["backbone"])
    assert above["backbone"] == pytest.approx(0.4), "the best layer is the same in every fold"
    assert measurement.interval.low < measurement.value < measurement.interval.high


def test_the_published_ratio_is_of_the_best_accuracies(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    measurement, streams = measured(curve_of(episodes, *PLAIN))
    assert measurement.published == pytest.approx(0.2 / 0.4)
    assert (streams.peak("backbone"), streams.peak("action")) == pytest.approx((0.9, 0.7))
    assert measurement.backbone.site == Site("backbone", 1)
    assert measurement.action.site == Site("expert", 0, "residual", 1)


def test_its_limits_are_fiellers(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    """All ratios whose numerator minus ratio times denominator lies within 1.1 t standard errors of 0."""
    measurement, streams = measured(curve_of(episodes, *PLAIN))
    (top, bottom), V = streams.scores.above, streams.scores.covariance
    square = (1.1 * stats.t.ppf(0.975, 99)) ** 2
    limits = np.sort(
        np.roots([bottom**2 - square * V[1, 1], -2 * (top * bottom - square * V[0, 1]), top**2 - square * V[0, 0]])
    )
    assert (measurement.interval.low, measurement.interval.high) == pytest.approx(tuple(limits))


def test_its_covariance_is_that_of_groups_and_leaves_room_for_unseen_ones(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    for accuracies in (PLAIN, ([0.5, 1.0], [[1.0, 0.9]])):
        _, streams = measured(curve_of(episodes, *accuracies))
        V, influence = streams.scores.covariance, streams.fit.influence
        of_groups = influence @ influence.T * 100 / 99
        unseen = 2 * streams.scores.above**2 / (101 * 102)
        np.testing.assert_allclose(V.diagonal(), np.maximum(of_groups.diagonal(), unseen))
        assert V[0, 1] == V[1, 0] == pytest.approx(of_groups[0, 1])
        assert np.linalg.eigvalsh(V).min() > 0


@pytest.mark.parametrize("accuracy", [0.7, 0.9, 1.0])
def test_identical_streams_retain_everything_with_narrow_limits(
    curve_of: CurveOf, episodes: pd.DataFrame, accuracy: float
) -> None:
    curve = curve_of(episodes, [0.5, accuracy], [[0.5, accuracy]])
    measurement, _ = measured(
        replace(curve, decisions=curve.decisions[[0, 1, 0, 1]], inner=curve.inner[[0, 1, 0, 1]])
    )
    assert measurement.value == pytest.approx(1)
    assert measurement.published == pytest.approx(1)
    assert 0.85 < measurement.interval.low <= 1 <= measurement.interval.high < 1.15


def test_the_order_of_sites_changes_no_number(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.5, 0.8, 0.8, 0.79], [[0.6, 0.7, 0.7], [0.7, 0.65, 0.7]])
    measurement, streams = measured(curve)
    for seed in range(5):
        other, of_other = measured(some_sites(curve, np.random.default_rng(seed).permutation(len(curve.sites))))
        assert other.value == pytest.approx(measurement.value, rel=1e-12)
        assert (other.interval.low, other.interval.high) == pytest.approx(
            (measurement.interval.low, measurement.interval.high)
        )
        assert other.published == pytest.approx(measurement.published)
        assert of_other.at_most == pytest.approx(streams.at_most)


def test_balancing_changes_nothing_in_a_complete_run(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, *PLAIN)
    np.testing.assert_array_equal(curve.sums.accuracies, curve.correct.mean(axis=1))
    assert (curve.sums.sizes == 2).all()


@pytest.mark.parametrize("missing", [0.25, 0.5])
def test_missing_episodes_of_one_side_change_neither_scores_nor_retention(
    curve_of: CurveOf, episodes: pd.DataFrame, missing: float
) -> None:
    """Probes learn how many of either side there are, which favours the larger one, and more so weak probes."""
    complete = curve_of(episodes, [0.5, 0.9], [[0.6, 0.7]])
    complete_retention, streams = measured(complete)
    draw = np.random.default_rng(0)
    values, scores, naive = [], [], []
    for _ in range(25):
        selected = ~complete.labels | (draw.random(complete.labels.size) >= missing)
        fewer = some_episodes(complete, selected)
        certainty = draw.exponential(0.6, fewer.decisions.shape)
        left_share = np.array([np.mean(fewer.labels[fewer.fold_of != fold]) for fold in fewer.fold_of])
        learned = fewer.decisions * certainty + np.log(left_share / (1 - left_share))
        measurement, of_found = measured(replace(fewer, decisions=learned))
        values.append(measurement.value)
        scores.append([of_found.accuracy("action"), of_found.accuracy("backbone")])
        best = replace(fewer, decisions=learned).correct.mean(axis=1)
        larger = max(fewer.labels.mean(), 1 - fewer.labels.mean())
        naive.append((best[2:].max() - larger) / (best[:2].max() - larger))
    assert np.mean(values) == pytest.approx(complete_retention.value, abs=0.04)
    expected = [streams.accuracy("action"), streams.accuracy("backbone")]
    np.testing.assert_allclose(np.mean(scores, axis=0), expected, atol=0.015)
    assert np.mean(naive) < complete_retention.value - 0.05, (
        "the share of the larger class in place of chance misleads"
    )


def test_the_last_or_one_iteration_can_be_asked_for(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [[0.8, 0.5], [0.6, 0.7]])
    for iterations, accuracy in (("all", 0.8), ("last", 0.7), (0, 0.8)):
        peak = best_site(curve, "expert", iterations)  # type: ignore[arg-type]
        assert peak is not None
        assert peak.score == accuracy
        streams = curve_scores(curve, iterations)  # type: ignore[arg-type]
        assert streams is not None
        assert streams.peak("action") == accuracy
    for measure in (lambda: best_site(curve, "expert", 2), lambda: measure_retention(curve, 2)):
        with pytest.raises(UsageError, match="iterations 0 to 1, not 2"):
            measure()


def test_without_backbone_signal_retention_is_not_defined_but_kept(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    curve = curve_of(episodes, [0.55, 0.56], [[0.58]], null_top=0.6)
    measurement, streams = measured(curve)
    assert not measurement.defined
    assert measurement.published == pytest.approx(0.08 / 0.06)
    assert measurement.note == f"n/a (backbone absent, at most {100 * streams.at_most['backbone']:.0f} %)"


def test_what_a_stream_could_be_at_most_is_the_largest_of_its_sites_own_limits(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    """Clopper and Pearson's one-sided limit at 5 %, with as many episodes as count (Korn and Graubard)."""
    curve = curve_of(episodes, [0.55, 0.56], [[0.58, 0.5]], null_top=0.6)
    _, streams = measured(curve)
    by_item = curve.correct.reshape(len(curve.sites), 100, 2).sum(axis=2)
    limits = []
    for right in by_item:
        share = right.sum() / 200
        variance = np.sum((right - 2 * share) ** 2) * 100 / 99 / 200**2
        count = min(share * (1 - share) / variance, 200)
        count *= (stats.t.ppf(0.95, 199) / stats.t.ppf(0.95, 99)) ** 2
        limits.append(stats.beta.ppf(0.95, share * count + 1, count - share * count))
    assert streams.at_most["backbone"] == pytest.approx(max(limits[:2]))
    assert streams.at_most["action"] == pytest.approx(max(limits[2:]))


def test_a_control_that_is_not_beaten_is_named(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, *PLAIN)
    for failed, words in (
        (("random-features",), "random-features"),
        (("random-features", "untrained"), "random-features and untrained"),
    ):
        exceeds = {"chance": True, "random-features": None, "untrained": None} | dict.fromkeys(failed, False)
        measurement = measure_retention(curve, exceeds=exceeds)
        assert measurement is not None
        assert (measurement.defined, measurement.note) == (False, f"n/a (backbone not shown to beat {words})")


def test_without_permuted_labels_retention_is_not_defined(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [[0.8]])
    measurement = measure_retention(replace(curve, null=np.empty((2, 0))))
    assert measurement is not None
    assert (measurement.defined, measurement.note) == (False, "n/a (no permutations)")


def test_a_backbone_exactly_at_chance_has_no_ratio(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    measurement = measure_retention(curve_of(episodes, [0.5], [[0.6]]))
    assert measurement is not None
    assert isnan(measurement.published)
    assert not measurement.interval.bounded
    assert str(measurement.interval) == "[no limits]"


def test_four_groups_have_a_published_ratio_and_no_score(curve_of: CurveOf, outcome_table: Outcomes) -> None:
    measurement = measure_retention(curve_of(outcome_table(8, 0, 0), [1.0], [[1.0]]))
    assert measurement is not None
    assert (measurement.streams, measurement.defined, measurement.note) == (None, False, NO_SCORES)
    assert isnan(measurement.value)
    assert not measurement.interval.bounded
    assert measurement.published == 1


def test_a_curve_without_expert_has_no_retention(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [])
    assert measure_retention(curve) is None
    streams = curve_scores(curve)
    assert streams is not None
    assert streams.names == ("backbone",)


def test_action_tokens_take_the_place_of_an_expert_that_is_not_there(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    measurement = measure_retention(curve_of(episodes, *PLAIN, action_stream="action"))
    same = measure_retention(curve_of(episodes, *PLAIN))
    assert measurement is not None
    assert same is not None
    assert measurement.action.site == Site("action", 0, "residual", 1)
    assert (measurement.published, measurement.value, measurement.interval) == (
        same.published,
        same.value,
        same.interval,
    )
    with pytest.raises(UsageError, match="stream action has iterations 0 to 1"):
        measure_retention(curve_of(episodes, *PLAIN, action_stream="action"), 2)


SUITE = "suite@1"


@pytest.fixture
def scored(curve_of: CurveOf, outcome_table: Outcomes) -> Callable[..., StreamScores]:
    """Scores of a run on 60 items. others: whether on items of other names. seed: of who is right where."""

    def make(
        backbone: list[float], expert: list[list[float]], seed: int = 0, other_category: bool = False
    ) -> StreamScores:
        curve = curve_of(outcome_table(120, 0, 0, "shape" if other_category else "color"), backbone, expert)
        mixed = np.random.default_rng(seed).permutation(60)
        pairs = curve.decisions.reshape(len(curve.sites), 60, 2) * np.where(curve.labels, 1, -1).reshape(60, 2)
        right = pairs[:, mixed].reshape(len(curve.sites), 120)
        scores = curve_scores(decided(curve, right * np.where(curve.labels, 1, -1)), seed_text=SUITE)
        assert scores is not None
        return scores

    return make


def decided(curve: ProbeCurve, decisions: np.ndarray) -> ProbeCurve:
    """The curve with these decisions, in its inner folds too."""
    right = (decisions > 0) == curve.labels
    return replace(curve, decisions=decisions, inner=inner_of(right, curve.fold_of, curve.groups))


def share(right: list[int], names: str = "g") -> Share:
    """Groups of two episodes, of which so many are right."""
    values = np.array([[hits > 0, hits > 1] for hits in right]).ravel()
    return Share.of(values, [f"{names}{group:03}" for group in range(len(right)) for _ in range(2)])


def as_pair(interval: Interval) -> tuple[float, float]:
    return interval.low, interval.high


# -- rates ---------------------------------------------------------------------------------------------------


def test_twelve_groups_that_are_all_right_have_clopper_and_pearsons_limits() -> None:
    rate = Rate.pooled([share([2] * 12)])
    assert rate.value == 1
    assert as_pair(rate.interval) == pytest.approx((0.735, 1), abs=5e-4)
    assert as_pair(rate.interval) == pytest.approx(as_pair(_exact(12, 12)))


def _exact(hits: int, trials: int) -> Interval:
    exact = stats.binomtest(hits, trials).proportion_ci(0.95, "exact")
    return Interval(exact.low, exact.high)


def test_runs_on_the_same_groups_are_pooled_group_by_group() -> None:
    """Two runs that are right in opposite groups are right in half of every one: the sum varies less than they."""
    first, other = share([2, 0] * 20), share([0, 2] * 20)
    both = Rate.pooled([first, other])
    assert (both.value, both.share is not None) == (0.5, True)
    assert both.share is not None
    assert both.share.variance == pytest.approx(0)
    assert first.variance > 0
    alike = Rate.pooled([first, first])
    assert as_pair(alike.interval) == pytest.approx(as_pair(Rate.pooled([first]).interval)), (
        "no news, no narrowing"
    )


def test_runs_on_other_groups_are_independent() -> None:
    first, other = share([2, 0, 1, 2] * 10), share([2, 0, 1, 2] * 10, "h")
    both = Rate.pooled([first, other])
    assert both.share is None
    width = np.diff(as_pair(first.interval()))[0]
    assert np.diff(as_pair(both.interval))[0] == pytest.approx(width / sqrt(2))


def test_the_mean_of_one_rate_is_that_rate() -> None:
    rate = Rate.pooled([share([2, 0, 1, 2] * 5)])
    mean = Rate.mean([rate])
    assert (mean.value, *as_pair(mean.interval)) == pytest.approx((rate.value, *as_pair(rate.interval)))


def test_a_run_minus_its_equal_is_nothing_and_leaves_room_for_groups_that_were_not_seen() -> None:
    """Of 40 groups that all agree, 8 % that do not would not have been missed, and no more is allowed for."""
    unseen = 1 - 0.025 ** (1 / 40)
    for right in ([2, 0, 1, 2], [2, 0, 2, 0], [2, 2, 2, 2]):
        rate = Rate.pooled([share(right * 10)])
        gap = rate.minus(rate)
        assert gap.value == 0
        assert gap.interval.low == pytest.approx(-gap.interval.high, abs=0.02)
        assert 0.6 * unseen < gap.interval.high < 1.2 * unseen


def test_one_run_minus_another_has_movers_limits() -> None:
    first, other = Rate.pooled([share([2, 0, 1, 2] * 10)]), Rate.pooled([share([2, 1, 1, 1] * 10)])
    assert first.paired_with(other)
    assert first.share is not None
    assert other.share is not None
    rests = [part.sums - 2 * part.value for part in (first.share, other.share)]
    rho = np.corrcoef(*rests)[0, 1]
    (low, high), (below, above) = as_pair(first.interval), as_pair(other.interval)
    a, b = first.value, other.value
    expected = (
        a - b - sqrt((a - low) ** 2 + (above - b) ** 2 - 2 * rho * (a - low) * (above - b)),
        a - b + sqrt((high - a) ** 2 + (b - below) ** 2 - 2 * rho * (high - a) * (b - below)),
    )
    assert as_pair(first.minus(other).interval) == pytest.approx(expected)


def test_rates_of_other_groups_are_not_paired_and_their_difference_is_wider() -> None:
    first, same = Rate.pooled([share([2, 0, 1, 2] * 10)]), Rate.pooled([share([2, 0, 2, 2] * 10)])
    other = Rate.pooled([share([2, 0, 2, 2] * 10, "h")])
    assert not first.paired_with(other)
    paired, apart = first.minus(same), first.minus(other)
    assert paired.value == apart.value
    assert np.diff(as_pair(paired.interval))[0] < 0.7 * np.diff(as_pair(apart.interval))[0]


def test_a_mean_is_known_no_better_than_one_of_its_parts_allows() -> None:
    """Two that are known exactly: the interval of the third is a third as wide in their mean."""
    certain, open_ = Rate(1.0, Interval(1.0, 1.0)), Rate(0.5, Interval(0.19, 0.81))
    assert as_pair(Rate.mean([certain, certain, open_]).interval) == pytest.approx(
        (2.5 / 3 - 0.31 / 3, 2.5 / 3 + 0.31 / 3)
    )


def test_groups_of_two_suites_are_not_the_same(outcome_table: Outcomes) -> None:
    table = outcome_table(20, 10, 10)
    first, other = (Rate.pooled([success_share(table, suite)]) for suite in ("a", "b"))
    assert not first.paired_with(other)
    assert first.paired_with(Rate.pooled([success_share(table, "a")]))


# -- scores of one run ---------------------------------------------------------------------------------------


def test_a_stream_whose_best_site_never_changes_is_scored_by_that_site(
    scored: Callable[..., StreamScores],
) -> None:
    scores = scored([0.5, 0.9], [[0.5, 0.75]])
    assert scores.names == ("action", "backbone")
    assert (scores.accuracy("backbone"), scores.peak("backbone")) == (pytest.approx(0.9), pytest.approx(0.9))
    low, high = limits(scores.interval("backbone"))
    assert low is not None
    assert high is not None
    V = scores.scores.covariance[1, 1]
    # Wilson's limits are the roots of (0.9 − x)² = t² · x (1 − x) / n.
    cut = stats.t.ppf(0.975, scores.fit.df) ** 2 / min(0.9 * 0.1 / V, 120)
    expected = sorted(np.roots([1 + cut, -(1.8 + cut), 0.81]).real)
    assert (low, high) == pytest.approx(tuple(expected))


@pytest.mark.slow
def test_the_best_of_sites_that_guess_scores_one_half_where_its_peak_does_not(
    curve_of: CurveOf, outcome_table: Outcomes
) -> None:
    above, peaks = [], []
    draw = np.random.default_rng(3)
    for _ in range(30):
        curve = curve_of(outcome_table(120, 0, 0), [0.5] * 20, [])
        scores = curve_scores(decided(curve, draw.normal(size=curve.decisions.shape)), seed_text=SUITE)
        assert scores is not None
        above.append(scores.accuracy("backbone") - 0.5)
        peaks.append(scores.peak("backbone"))
    assert abs(np.mean(above)) < 0.02
    assert np.mean(peaks) > 0.57


def test_no_streams_have_no_scores(curve_of: CurveOf, outcome_table: Outcomes) -> None:
    assert score_streams(curve_of(outcome_table(20, 0, 0), [0.9], []), {}, SUITE) is None


def test_an_interval_without_limits_is_a_pair_of_nothing() -> None:
    assert limits(Interval(float("-inf"), 3.0)) == (None, None)
    assert limits(Interval(0.25, 0.5)) == (0.25, 0.5)


# -- scores of several runs ----------------------------------------------------------------------------------


def pooled(*runs: StreamScores) -> PooledScores:
    pooled_scores = PooledScores.of(runs)
    assert pooled_scores is not None
    return pooled_scores


def test_one_run_pooled_is_that_run(scored: Callable[..., StreamScores]) -> None:
    run_scores = scored([0.5, 0.9], [[0.6, 0.75]])
    pooled_scores = pooled(run_scores)
    for name in run_scores.names:
        rate = pooled_scores.accuracy(name)
        assert (rate.value, *as_pair(rate.interval)) == (
            run_scores.accuracy(name),
            *as_pair(run_scores.interval(name)),
        )
    np.testing.assert_array_equal(pooled_scores.scores.covariance, run_scores.scores.covariance)
    assert retention(pooled_scores.scores) == retention(run_scores.scores)


def test_runs_on_the_same_groups_have_the_mean_score_and_share_their_groups(
    scored: Callable[..., StreamScores],
) -> None:
    first, other = scored([0.5, 0.9], [[0.6, 0.75]]), scored([0.5, 0.7], [[0.7, 0.65]], seed=1)
    pooled_scores, alike = pooled(first, other), pooled(first, first)
    assert pooled_scores.fit is not None
    for name in first.names:
        assert pooled_scores.accuracy(name).value == pytest.approx(
            (first.accuracy(name) + other.accuracy(name)) / 2
        )
    np.testing.assert_allclose(alike.scores.covariance, first.scores.covariance, err_msg="the same run is no news")
    shares = (first.fit.influence + other.fit.influence) / 2
    np.testing.assert_allclose(pooled_scores.scores.covariance[0, 1], (shares @ shares.T * 60 / 59)[0, 1])


def test_runs_on_other_groups_are_pooled_as_independent(scored: Callable[..., StreamScores]) -> None:
    first, other = scored([0.5, 0.9], [[0.6, 0.75]]), scored([0.5, 0.9], [[0.6, 0.75]], other_category=True)
    pooled_scores = pooled(first, other)
    assert pooled_scores.fit is None
    V = (first.scores.covariance + other.scores.covariance) / 4
    np.testing.assert_allclose(pooled_scores.scores.covariance, V)
    rate = pooled_scores.accuracy("backbone")
    arms = np.array([np.abs(np.subtract(as_pair(run.interval("backbone")), 0.9)) for run in (first, other)])
    below, above = np.sqrt((arms**2).sum(axis=0)) / 2
    assert as_pair(rate.interval) == pytest.approx((0.9 - below, 0.9 + above))
    assert (pooled_scores.covariance_with(pooled(first)) == 0).all()


def test_only_streams_that_all_runs_have_are_pooled(
    scored: Callable[..., StreamScores], curve_of: CurveOf, outcome_table: Outcomes
) -> None:
    both = scored([0.5, 0.9], [[0.6, 0.75]])
    bare = curve_scores(curve_of(outcome_table(120, 0, 0), [0.5, 0.7], []), seed_text=SUITE)
    assert bare is not None
    pooled_scores = pooled(both, bare)
    assert pooled_scores.names == ("backbone",)
    assert pooled_scores.accuracy("backbone").value == pytest.approx(0.8, abs=1e-3)
    assert PooledScores.of([]) is None


def test_a_run_minus_its_equal_is_nothing_in_every_number_and_narrow(scored: Callable[..., StreamScores]) -> None:
    """Of 60 groups that all agree, 6 % would not have been missed in which one run knows all and one nothing."""
    pooled_scores = pooled(scored([0.5, 0.85], [[0.6, 0.75]]))
    most = (1 - 0.025 ** (1 / 60)) / 2
    for name in pooled_scores.names:
        gap = pooled_scores.accuracy_difference(pooled_scores, name)
        assert gap.value == 0
        assert 0.7 * most < min(gap.interval.high, -gap.interval.low), name
        reference = pooled_scores.accuracy(name).interval
        assert gap.interval.high - gap.interval.low < 0.5 * (reference.high - reference.low), name
    ratio, reference = (
        retention_difference(
            pooled_scores.scores, pooled_scores.scores, pooled_scores.covariance_with(pooled_scores)
        ),
        retention(pooled_scores.scores),
    )
    assert ratio.value == 0
    assert 0.01 < ratio.interval.high < 0.35 * (reference.interval.high - reference.interval.low)
    assert 0.01 < -ratio.interval.low < 0.35 * (reference.interval.high - reference.interval.low)


def test_runs_on_the_same_groups_are_paired_and_others_are_not(scored: Callable[..., StreamScores]) -> None:
    """Two runs that are right about the same items: their difference is known better than that of strangers."""
    strong = pooled(scored([0.5, 0.85], [[0.6, 0.75]]))
    same, other = (
        pooled(scored([0.5, 0.8], [[0.6, 0.7]])),
        pooled(scored([0.5, 0.8], [[0.6, 0.7]], other_category=True)),
    )
    for name in strong.names:
        paired, apart = strong.accuracy_difference(same, name), strong.accuracy_difference(other, name)
        assert strong.covariance_with(other)[0, 0] == 0
        assert apart.interval.low < paired.value < apart.interval.high
        a, b = strong.accuracy(name), other.accuracy(name)
        low = a.value - b.value - sqrt((a.value - a.interval.low) ** 2 + (b.interval.high - b.value) ** 2)
        assert apart.interval.low == pytest.approx(low), "MOVER without correlation"
    V, joint = strong.covariance_with(same), strong.fit.influence @ same.fit.influence.T * 60 / 59  # type: ignore[union-attr]
    assert (V[0, 1], V[1, 0]) == pytest.approx((joint[0, 1], joint[1, 0]))
    assert (V.diagonal() <= joint.diagonal() + 1e-12).all()
    assert (V.diagonal() > 0).all()


def test_the_mean_of_one_category_is_the_category_and_of_two_alike_is_known_better(
    scored: Callable[..., StreamScores],
) -> None:
    category_scores = scored([0.5, 0.85], [[0.6, 0.75]]).scores
    alone, two = Scores.mean([category_scores]), Scores.mean([category_scores, category_scores])
    assert retention(alone) == retention(category_scores)
    assert retention(two).value == pytest.approx(retention(category_scores).value)
    widths = [np.diff(as_pair(retention(averaged).interval))[0] for averaged in (two, category_scores)]
    assert widths[0] == pytest.approx(widths[1] / sqrt(2), rel=0.1)
