"""Retention of one category: the ratio of two cross-fitted scores, checked against formulas by hand."""

from collections.abc import Callable
from dataclasses import replace
from math import isnan

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.retention import best_site, measure_retention
from probe_kit.retention.estimators import NO_SCORES, Retention, StreamScores, curve_scores
from probe_kit.train import ProbeCurve

CurveOf = Callable[..., ProbeCurve]
Outcomes = Callable[..., pd.DataFrame]
PLAIN = ([0.5, 0.9, 0.7], [[0.55, 0.6], [0.7, 0.6]])


@pytest.fixture
def episodes(outcome_table: Outcomes) -> pd.DataFrame:
    return outcome_table(100, 100, 0)


def measured(curve: ProbeCurve) -> tuple[Retention, StreamScores]:
    found = measure_retention(curve)
    assert found is not None
    assert found.streams is not None
    return found, found.streams


def some_episodes(curve: ProbeCurve, kept: np.ndarray) -> ProbeCurve:
    """The curve of a run from which the other episodes are missing."""
    own = {name: getattr(curve, name)[kept] for name in ("labels", "episodes", "items", "groups", "fold_of")}
    return replace(curve, decisions=curve.decisions[:, kept], **own)


def some_sites(curve: ProbeCurve, rows: np.ndarray) -> ProbeCurve:
    """The curve with its sites in another order."""
    own = {name: getattr(curve, name)[rows] for name in ("decisions", "strengths", "null", "inner")}
    sites, parts = (tuple(held[row] for row in rows) for held in (curve.sites, curve.parts))
    return replace(curve, sites=sites, parts=parts, **own)


def test_retention_is_the_ratio_of_two_scores_above_one_half(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    found, streams = measured(curve_of(episodes, *PLAIN))
    assert found.defined
    assert found.note == ""
    above = {name: streams.accuracy(name) - 0.5 for name in ("action", "backbone")}
    assert found.value == pytest.approx(above["action"] / above["backbone"])
    assert above["backbone"] == pytest.approx(0.4), "the best layer is the same in every fold"
    assert found.interval.low < found.value < found.interval.high


def test_the_published_ratio_is_of_the_best_accuracies(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    found, streams = measured(curve_of(episodes, *PLAIN))
    assert found.published == pytest.approx(0.2 / 0.4)
    assert (streams.peak("backbone"), streams.peak("action")) == pytest.approx((0.9, 0.7))
    assert found.backbone.site == Site("backbone", 1)
    assert found.action.site == Site("expert", 0, "residual", 1)


def test_its_limits_are_fiellers(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    """All ratios whose numerator minus ratio times denominator lies within 1.1 t standard errors of 0."""
    found, streams = measured(curve_of(episodes, *PLAIN))
    (top, bottom), V = streams.scores.above, streams.scores.covariance
    square = (1.1 * stats.t.ppf(0.975, 99)) ** 2
    limits = np.sort(
        np.roots([bottom**2 - square * V[1, 1], -2 * (top * bottom - square * V[0, 1]), top**2 - square * V[0, 0]])
    )
    assert (found.interval.low, found.interval.high) == pytest.approx(tuple(limits))


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
    found, _ = measured(replace(curve, decisions=curve.decisions[[0, 1, 0, 1]], inner=curve.inner[[0, 1, 0, 1]]))
    assert found.value == pytest.approx(1)
    assert found.published == pytest.approx(1)
    assert 0.85 < found.interval.low <= 1 <= found.interval.high < 1.15


def test_the_order_of_sites_changes_no_number(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.5, 0.8, 0.8, 0.79], [[0.6, 0.7, 0.7], [0.7, 0.65, 0.7]])
    found, streams = measured(curve)
    for seed in range(5):
        other, of_other = measured(some_sites(curve, np.random.default_rng(seed).permutation(len(curve.sites))))
        assert other.value == pytest.approx(found.value, rel=1e-12)
        assert (other.interval.low, other.interval.high) == pytest.approx(
            (found.interval.low, found.interval.high)
        )
        assert other.published == pytest.approx(found.published)
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
    whole, streams = measured(complete)
    draw = np.random.default_rng(0)
    values, scores, naive = [], [], []
    for _ in range(25):
        kept = ~complete.labels | (draw.random(complete.labels.size) >= missing)
        fewer = some_episodes(complete, kept)
        certainty = draw.exponential(0.6, fewer.decisions.shape)
        left = np.array([np.mean(fewer.labels[fewer.fold_of != fold]) for fold in fewer.fold_of])
        learned = fewer.decisions * certainty + np.log(left / (1 - left))
        found, of_found = measured(replace(fewer, decisions=learned))
        values.append(found.value)
        scores.append([of_found.accuracy("action"), of_found.accuracy("backbone")])
        best = replace(fewer, decisions=learned).correct.mean(axis=1)
        larger = max(fewer.labels.mean(), 1 - fewer.labels.mean())
        naive.append((best[2:].max() - larger) / (best[:2].max() - larger))
    assert np.mean(values) == pytest.approx(whole.value, abs=0.04)
    wanted = [streams.accuracy("action"), streams.accuracy("backbone")]
    np.testing.assert_allclose(np.mean(scores, axis=0), wanted, atol=0.015)
    assert np.mean(naive) < whole.value - 0.05, "the share of the larger class in place of chance misleads"


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
    found, streams = measured(curve)
    assert not found.defined
    assert found.published == pytest.approx(0.08 / 0.06)
    assert found.note == f"n/a (backbone absent, at most {100 * streams.at_most['backbone']:.0f} %)"


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
        found = measure_retention(curve, exceeds=exceeds)
        assert found is not None
        assert (found.defined, found.note) == (False, f"n/a (backbone not shown to beat {words})")


def test_without_permuted_labels_retention_is_not_defined(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [[0.8]])
    found = measure_retention(replace(curve, null=np.empty((2, 0))))
    assert found is not None
    assert (found.defined, found.note) == (False, "n/a (no permutations)")


def test_a_backbone_exactly_at_chance_has_no_ratio(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    found = measure_retention(curve_of(episodes, [0.5], [[0.6]]))
    assert found is not None
    assert isnan(found.published)
    assert not found.interval.bounded
    assert str(found.interval) == "[no limits]"


def test_four_groups_have_a_published_ratio_and_no_score(curve_of: CurveOf, outcome_table: Outcomes) -> None:
    found = measure_retention(curve_of(outcome_table(8, 0, 0), [1.0], [[1.0]]))
    assert found is not None
    assert (found.streams, found.defined, found.note) == (None, False, NO_SCORES)
    assert isnan(found.value)
    assert not found.interval.bounded
    assert found.published == 1


def test_a_curve_without_expert_has_no_retention(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [])
    assert measure_retention(curve) is None
    streams = curve_scores(curve)
    assert streams is not None
    assert streams.names == ("backbone",)


def test_action_tokens_take_the_place_of_an_expert_that_is_not_there(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    found = measure_retention(curve_of(episodes, *PLAIN, action_stream="action"))
    same = measure_retention(curve_of(episodes, *PLAIN))
    assert found is not None
    assert same is not None
    assert found.action.site == Site("action", 0, "residual", 1)
    assert (found.published, found.value, found.interval) == (same.published, same.value, same.interval)
    with pytest.raises(UsageError, match="stream action has iterations 0 to 1"):
        measure_retention(curve_of(episodes, *PLAIN, action_stream="action"), 2)
