"""Balanced and cross-fitted scores, retention, and the verdict on a stream."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import beta, t

from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UsageError
from probe_kit.statistics.crossfit import (
    GroupSums,
    SiteScores,
    balanced_sums,
    crossfit,
    remove_fold_priors,
    smoothing,
)
from probe_kit.statistics.intervals import NO_LIMITS, difference_interval
from probe_kit.statistics.retention import (
    Ratio,
    Scores,
    accuracy_interval,
    retention,
    retention_difference,
    t_quantile,
)
from probe_kit.statistics.sufficiency import (
    ABSENT_BELOW,
    at_most,
    findable,
    is_absent,
    permuted_threshold,
    verdict,
)
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.samples import Samples
from tests.support.inner_qualities import fitted, stream_of

ITEMS = 20
LABELS = np.tile([True, False], ITEMS)
GROUPS = np.repeat([f"pair-{number:02d}" for number in range(ITEMS // 2)], 4)
FOLD_OF = np.repeat(np.arange(ITEMS // 2) % 5, 4)


def decisions_of(seed: int, sites: int = 6) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.standard_normal((sites, LABELS.size)) + np.where(LABELS, 0.5, -0.5)


def test_a_complete_run_counts_its_correct_episodes_unchanged() -> None:
    decisions = decisions_of(0)
    sums = balanced_sums(decisions, LABELS, FOLD_OF, GROUPS)
    right = (decisions > 0) == LABELS
    expected = [[row[group == GROUPS].sum() for group in np.unique(GROUPS)] for row in right]
    np.testing.assert_array_equal(sums.sums, expected)
    np.testing.assert_array_equal(sums.sizes, np.full(ITEMS // 2, 4))
    np.testing.assert_allclose(sums.accuracies, right.mean(axis=1), atol=1e-15)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 0.9))
def test_answers_without_knowledge_are_right_in_one_half_whatever_is_missing(seed: int, missing: float) -> None:
    """Constant logits, and the logit of each fold's own training share."""
    drawn = np.random.default_rng(seed)
    present = ~LABELS | (drawn.random(LABELS.size) > missing)
    present[:2], present[-2:] = True, True
    labels, folds, groups = LABELS[present], FOLD_OF[present], GROUPS[present]
    shares = np.array([labels[folds != fold].mean() for fold in folds])
    learned = np.log(shares / (1 - shares))
    constant = [np.full(labels.size, value) for value in (-2.0, 2.0)]
    sums = balanced_sums(np.array([learned - 1e-9, learned + 1e-9, *constant]), labels, folds, groups)
    np.testing.assert_allclose(sums.accuracies[:2], 0.5)
    assert sums.n_episodes == pytest.approx(labels.size)
    if np.abs(learned).max() < 2:
        np.testing.assert_allclose(sums.accuracies[2:], 0.5)


def test_the_balanced_accuracy_is_the_mean_of_the_sides_own_accuracies() -> None:
    present = np.flatnonzero(~LABELS | (np.arange(LABELS.size) % 8 < 4))
    decisions, labels, folds = decisions_of(1)[:, present], LABELS[present], FOLD_OF[present]
    accuracies = balanced_sums(decisions, labels, folds, GROUPS[present]).accuracies
    right = (remove_fold_priors(decisions, labels, folds) > 0) == labels
    np.testing.assert_allclose(accuracies, (right[:, labels].mean(axis=1) + right[:, ~labels].mean(axis=1)) / 2)


def test_a_fold_trained_on_twice_as_many_of_one_side_loses_the_logarithm_of_two() -> None:
    labels = np.array([True, True, False, False, True, False])
    folds = np.array([0, 0, 0, 1, 1, 1])
    shifted = remove_fold_priors(np.zeros((1, 6)), labels, folds)
    np.testing.assert_allclose(shifted[0], [np.log(2)] * 3 + [-np.log(2)] * 3)


def test_names_order_the_groups_and_the_order_of_episodes_does_not_matter() -> None:
    decisions, mixed = decisions_of(2), np.random.default_rng(0).permutation(LABELS.size)
    first = balanced_sums(decisions, LABELS, FOLD_OF, GROUPS)
    other = balanced_sums(decisions[:, mixed], LABELS[mixed], FOLD_OF[mixed], GROUPS[mixed])
    np.testing.assert_array_equal(first.sums, other.sums)


def test_some_sites_keep_their_groups() -> None:
    sums = GroupSums(np.arange(6.0).reshape(3, 2), np.array([4.0, 6.0]))
    assert sums.only([2, 0]).sums.tolist() == [[4, 5], [0, 1]]
    assert (sums.n_groups, sums.n_episodes) == (2, 10)


def test_a_fold_that_was_trained_on_one_side_is_refused() -> None:
    labels = np.array([True, True, False, False])
    with pytest.raises(UnbalancedEpisodesError, match="outer fold 0 was trained on 0 episodes of one side and 2"):
        balanced_sums(np.zeros((1, 4)), labels, [0, 0, 1, 1], list("abcd"))


def test_a_side_that_is_missing_entirely_is_refused() -> None:
    with pytest.raises(UnbalancedEpisodesError, match="2 episodes of one side and 0 of the other"):
        balanced_sums(np.zeros((1, 4)), np.ones(4, bool), [0, 0, 1, 1], list("abcd"))


def test_nan_a_single_fold_and_shapes_that_do_not_fit_are_refused() -> None:
    broken = np.zeros((2, 4))
    broken[1, 2] = np.nan
    labels = np.array([True, False, True, False])
    with pytest.raises(UsageError, match="1 of 4 episodes are NaN or infinite, first number 2"):
        balanced_sums(broken, labels, [0, 0, 1, 1], list("abcd"))
    with pytest.raises(UsageError, match="1 outer folds; expected two"):
        balanced_sums(np.zeros((1, 4)), labels, [0, 0, 0, 0], list("abcd"))
    with pytest.raises(UsageError, match="a label and a fold for each episode"):
        balanced_sums(np.zeros((1, 5)), labels, [0, 0, 1, 1], list("abcd"))


def test_a_real_probe_trained_with_most_of_one_side_missing_leans_to_neither_side() -> None:
    generator = np.random.default_rng(4)
    labels, groups = np.tile([True, False], 300), np.repeat(np.arange(150), 4)
    present = ~labels | (generator.random(labels.size) >= 0.6)
    features = generator.standard_normal((labels.size, 8)) + 0.15 * np.where(labels, 1, -1)[:, None]
    labels, groups, features = labels[present], groups[present], features[present]
    folds = nested_folds(labels, groups, seed=0)
    fold_of = np.zeros(labels.size, int)
    for number, fold in enumerate(folds):
        fold_of[fold.outer.test] = number
    probe = probe_site(Samples.pooled(features), labels, np.empty((labels.size, 0), bool), folds)

    def lean(decisions: np.ndarray) -> float:
        right = (decisions > 0) == labels
        return float(right[~labels].mean() - right[labels].mean())

    assert lean(probe.decisions) > 0.4, "what is missing is learned"
    assert abs(lean(remove_fold_priors(probe.decisions[None], labels, fold_of)[0])) < 0.15


LAYERS, ITERATIONS = np.tile(np.arange(4), 3), np.repeat(np.arange(3), 4)
FOLDS = 5


def drawn(seed: int, shares: np.ndarray, groups: int, size: int = 4) -> GroupSums:
    """Independent correctness of sites that are right in (S,) shares."""
    generator = np.random.default_rng(seed)
    sums = generator.binomial(size, shares[:, None], (shares.size, groups)).astype(float)
    return GroupSums(sums, np.full(groups, float(size)))


def backbone(seed: int, top: float = 0.2, groups: int = 30) -> SiteScores:
    return stream_of(drawn(seed, 0.5 + top * np.array([0.2, 0.6, 1.0, 0.5]), groups), np.arange(4))


def expert(seed: int, top: float = 0.1, groups: int = 30) -> SiteScores:
    return stream_of(drawn(seed, np.full(12, 0.5 + top), groups), LAYERS, ITERATIONS)


def test_a_site_that_stands_out_is_always_chosen_and_scored_by_the_outer_folds() -> None:
    sums = GroupSums(np.array([[2.0] * 10, [3.0] * 10, [1.0] * 10]), np.full(10, 4.0))
    fit = fitted(stream_of(sums, [0, 1, 2]))
    assert fit.above[0] == pytest.approx(0.25)
    assert fit.peaks[0] == 0.75


def test_every_fold_is_scored_at_the_site_that_its_own_inner_folds_choose() -> None:
    """The inner folds of fold 0 prefer site 1, those of the others site 0, whatever the outer folds say."""
    groups = 10
    fold_of = np.arange(groups) % FOLDS
    sums = GroupSums(np.array([[4.0] * groups, [2.0] * groups]), np.full(groups, 4.0))
    inner = np.where(fold_of == np.arange(FOLDS)[:, None], 0.0, 1.0) * np.ones((2, 1, 1))
    inner[0, 0] *= 0.5
    inner[1, 1:] *= 0.5
    stream = SiteScores.of(sums, inner, fold_of, [0, 1])
    assert stream.best.tolist() == [1, 0, 0, 0, 0]
    assert fitted(stream).above[0] == pytest.approx((2 * 0.5 + 8 * 1.0) / 10 - 0.5)


@pytest.mark.slow
def test_without_signal_the_score_is_zero_on_average_however_high_the_peak() -> None:
    fits = [fitted(stream_of(drawn(seed, np.full(40, 0.5), 12), np.arange(40))) for seed in range(250)]
    assert abs(np.mean([fit.above[0] for fit in fits])) < 0.01
    assert np.mean([fit.peaks[0] for fit in fits]) > 0.6


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.randoms(use_true_random=False))
def test_the_order_of_sites_does_not_matter_even_where_they_tie(seed: int, random: object) -> None:
    scores = drawn(seed, np.full(12, 0.6), 6, size=2)
    order = np.array(random.sample(range(12), 12))  # type: ignore[attr-defined]
    first = fitted(stream_of(scores, LAYERS, ITERATIONS))
    other = fitted(stream_of(scores.only(order), LAYERS[order], ITERATIONS[order]))
    np.testing.assert_allclose(first.above, other.above, atol=1e-12)
    np.testing.assert_allclose(first.covariance, other.covariance, atol=1e-12)


def test_the_same_streams_have_the_same_scores_whatever_was_fitted_before() -> None:
    alone = fitted(expert(1), backbone(1))
    for seed in range(6):
        fitted(backbone(seed, groups=20 + seed))
    again = fitted(expert(1), backbone(1))
    np.testing.assert_array_equal(alone.above, again.above)
    np.testing.assert_array_equal(alone.covariance, again.covariance)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(5, 40), st.floats(0, 0.5))
def test_a_joint_covariance_is_positive_semidefinite(seed: int, groups: int, top: float) -> None:
    fit = fitted(expert(seed, top, groups), backbone(seed, top, groups), expert(seed, 0.0, groups))
    assert np.linalg.eigvalsh(fit.covariance).min() > -1e-12


def test_two_runs_on_the_same_groups_have_the_covariance_of_one_joint_fit() -> None:
    streams = [expert(1), backbone(1), expert(2), backbone(2)]
    joint, first, second = fitted(*streams), fitted(*streams[:2]), fitted(*streams[2:])
    np.testing.assert_allclose(joint.covariance[:2, 2:], first.covariance_with(second), atol=1e-15)
    np.testing.assert_allclose(joint.covariance[:2, :2], first.covariance, atol=1e-15)
    elsewhere = fitted(*streams[2:], suite="other@1")
    assert not first.covariance_with(elsewhere).any(), "equal names of another suite are other groups"


def test_with_one_site_the_variance_is_that_of_a_mean_over_groups() -> None:
    sums = drawn(0, np.full(1, 0.7), 30)
    fit = fitted(stream_of(sums, [0]))
    assert fit.covariance[0, 0] == pytest.approx(np.var(sums.sums[0] / 4, ddof=1) / 30)


@pytest.mark.slow
def test_the_variance_is_that_of_the_score_over_data_sets() -> None:
    fits = [fitted(backbone(seed), expert(seed + 1000, 0.15)) for seed in range(200)]
    actual = np.var([fit.above for fit in fits], axis=0, ddof=1)
    claimed = np.mean([fit.covariance.diagonal() for fit in fits], axis=0)
    assert (claimed / actual > 0.8).all()
    assert (claimed / actual < 2.2).all(), "most where twelve sites are equally good and every choice is luck"


def test_where_all_groups_agree_a_group_at_chance_may_be_unseen() -> None:
    perfect = stream_of(GroupSums(np.full((3, 12), 4.0), np.full(12, 4.0)), np.arange(3))
    fit = fitted(perfect, perfect)
    np.testing.assert_allclose(fit.above, 0.5)
    np.testing.assert_allclose(fit.influence, 0, atol=1e-15)
    np.testing.assert_allclose(fit.covariance, np.eye(2) * 2 / (13 * 14) / 4, atol=1e-30)


def test_degrees_of_freedom_are_a_group_less() -> None:
    assert [fitted(backbone(0, groups=groups)).df for groups in (5, 51, 150)] == [4, 50, 149]


def test_the_guide_of_a_stream_that_runs_once_is_its_own_quality() -> None:
    scores = drawn(0, np.full(4, 0.6), 8)
    plain = stream_of(scores, np.arange(4)).guide
    np.testing.assert_array_equal(plain, stream_of(scores, np.arange(4), np.full(4, 7)).guide)
    np.testing.assert_array_equal(plain[:, 0, 1:5], scores.sums[:, 1:5])


def test_the_guide_of_several_iterations_is_half_the_site_and_half_its_surroundings() -> None:
    scores = drawn(0, np.full(12, 0.6), 8)
    along_layers = np.array([[3, 1, 0, 0], [1, 2, 1, 0], [0, 1, 2, 1], [0, 0, 1, 3]]) / 4
    along_iterations = np.array([[3, 1, 0], [1, 2, 1], [0, 1, 3]]) / 4
    around = np.kron(along_iterations, along_layers)
    np.testing.assert_allclose(smoothing(LAYERS, ITERATIONS), around)
    plain = stream_of(scores, np.zeros(12)).guide
    guide = stream_of(scores, LAYERS, ITERATIONS).guide
    np.testing.assert_allclose(guide, (plain + np.einsum("st,tfg->sfg", around, plain)) / 2)


def test_layers_that_were_not_captured_leave_the_others_as_neighbours() -> None:
    np.testing.assert_allclose(smoothing([0, 8, 16], [0, 0, 0]), smoothing([0, 1, 2], [0, 0, 0]))
    weights = smoothing([0, 1, 0], [0, 0, 1])  # layer 1 lacks at iteration 1
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert weights[2, 1] == pytest.approx(0.25 * 0.25)


def test_groups_of_unequal_weight_count_by_their_episodes() -> None:
    sizes = np.array([1.0, 2, 3, 10, 2, 4, 1, 5])
    sums = GroupSums(np.array([0.8 * sizes, 0.5 * sizes]), sizes)
    fit = fitted(stream_of(sums, [0, 1]))
    assert fit.above[0] == pytest.approx(0.3)


def test_fewer_groups_than_outer_folds_are_refused() -> None:
    stream_scores = SiteScores.of(GroupSums(np.ones((1, 4)), np.ones(4)), np.zeros((1, 4, 4)), np.arange(4), [0])
    with pytest.raises(TooFewGroupsError, match="4 independent groups of items; expected at least 5"):
        crossfit([stream_scores], list("abcd"))


def test_streams_on_other_groups_nan_and_places_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError, match=r"streams on \[20, 30\] groups, and 30 names"):
        fitted(backbone(0), backbone(0, groups=20))
    broken = drawn(0, np.full(4, 0.6), 8)
    stream = stream_of(broken, np.arange(4))
    broken.sums[0, 0] = np.nan
    with pytest.raises(UsageError, match="sums hold NaN"):
        fitted(stream)
    with pytest.raises(UsageError, match="3 layers and 3 iterations for 4 sites"):
        stream_of(drawn(0, np.full(4, 0.6), 8), np.arange(3))
    with pytest.raises(UsageError, match="at least one site"):
        stream_of(drawn(0, np.zeros(0), 8), [])


def test_inner_qualities_of_other_folds_or_of_tested_groups_are_refused() -> None:
    sums, folds = drawn(0, np.full(2, 0.6), 8), np.arange(8) % FOLDS
    with pytest.raises(UsageError, match=r"inner qualities \(2, 5, 7\) and folds \(8,\) for 2 sites and 8 groups"):
        SiteScores.of(sums, np.zeros((2, FOLDS, 7)), folds, [0, 1])
    with pytest.raises(UsageError, match="a group is tested by fold 4; expected folds 0 to 2"):
        SiteScores.of(sums, np.zeros((2, 3, 8)), folds, [0, 1])
    with pytest.raises(UsageError, match="groups in the fold that tests them; expected 0 there"):
        SiteScores.of(sums, np.ones((2, FOLDS, 8)), folds, [0, 1])


def site_stream(share: float, groups: int, seed: int = 0) -> SiteScores:
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
    category_scores = Scores.of(fitted(site_stream(0.6, 20), site_stream(0.7, 20)))
    mean = Scores.mean([category_scores])
    np.testing.assert_array_equal(mean.above, category_scores.above)
    np.testing.assert_array_equal(mean.covariance, category_scores.covariance)
    assert mean.df == category_scores.df == 19


def test_a_category_that_varies_most_is_known_no_better_for_the_others() -> None:
    loose, tight = (Scores(np.zeros(2), np.eye(2) * variance, 5) for variance in (0.01, 1e-6))
    assert Scores.mean([loose, tight, tight]).df == pytest.approx(5, rel=1e-3)
    assert Scores.mean([loose, loose, loose]).df == pytest.approx(15)
    assert Scores.mean([Scores(np.zeros(2), np.zeros((2, 2)), 5)] * 2).df == 10


def test_a_perfect_site_is_known_as_well_as_its_groups_allow() -> None:
    perfect = stream_of(GroupSums(np.full((2, 12), 4.0), np.full(12, 4.0)), np.arange(2))
    interval = accuracy_interval(fitted(perfect), 0)
    assert (interval.low, interval.high) == pytest.approx((0.7575, 1.0), abs=5e-4)


@pytest.mark.parametrize("sites", [1, 3, 6, 7, 12, 13])
@pytest.mark.parametrize("seed", range(3))
def test_limits_of_a_stream_never_rise_with_an_added_error(sites: int, seed: int) -> None:
    """All sites have the same errors; means of tied sites differ by rounding."""
    generator, groups = np.random.default_rng(seed), 12
    right, limits = np.full(groups * 4, 1.0), []
    for at in [None, *generator.permutation(right.size)[:30]]:
        right[at if at is not None else []] = 0.0
        sums = np.repeat(right.reshape(groups, 4).sum(axis=1)[None], sites, axis=0)
        interval = accuracy_interval(fitted(stream_of(GroupSums(sums, np.full(groups, 4.0)), np.arange(sites))), 0)
        limits.append((interval.low, interval.high))
    assert limits[0] == pytest.approx((0.7575, 1.0), abs=5e-4)
    assert np.diff(limits, axis=0).max() <= 1e-9


def test_the_interval_of_an_accuracy_holds_what_choosing_adds() -> None:
    fit = fitted(site_stream(0.7, 40))
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


def stream(seed: int, share: float, groups: int = 40, sites: int = 8) -> SiteScores:
    sums = np.random.default_rng(seed).binomial(4, share, (sites, groups)).astype(float)
    return stream_of(GroupSums(sums, np.full(groups, 4.0)), np.arange(sites))


def scores(expert: float, backbone: float, error: float = 0.03, df: float = 30) -> Scores:
    return Scores(np.array([expert, backbone]), np.diag([error**2, error**2]), df)


def test_the_limits_solve_fiellers_equation_with_errors_a_tenth_larger() -> None:
    two_scores = Scores(np.array([0.12, 0.3]), np.array([[0.0010, 0.0003], [0.0003, 0.0012]]), 30)
    interval = retention(two_scores).interval
    for ratio in (interval.low, interval.high):
        by = np.array([1, -ratio])
        assert (by @ two_scores.above) ** 2 == pytest.approx(
            (1.1 * t.ppf(0.975, 30)) ** 2 * by @ two_scores.covariance @ by
        )
    assert interval.low < 0.4 < interval.high


def test_limits_of_a_ratio_grow_without_a_jump_until_there_are_none() -> None:
    """The lower end of the backbone's interval falls from nine tenths of its score to none of it."""
    intervals = [retention(scores(0.1, 0.2, error)).interval for error in np.linspace(0.01, 0.095, 400)]
    bounded = [interval.bounded for interval in intervals]
    assert bounded == sorted(bounded, reverse=True)
    widths = 1 / np.array([interval.high - interval.low for interval in intervals if interval.bounded])
    assert not all(bounded)
    assert (np.diff(widths) < 0).all()
    assert widths[-1] < 0.02
    assert np.abs(np.diff(widths)).max() < 0.12 * widths.max()


def test_identical_streams_retain_exactly_all() -> None:
    stream_scores = stream(0, 0.75)
    ratio = retention(Scores.of(fitted(stream_scores, stream_scores)))
    assert (ratio.value, ratio.interval.low, ratio.interval.high) == pytest.approx((1, 1, 1))


def test_twelve_perfect_groups_leave_as_much_open_as_unseen_groups_may_hold() -> None:
    perfect = stream_of(GroupSums(np.full((5, 12), 4.0), np.full(12, 4.0)), np.arange(5))
    ratio = retention(Scores.of(fitted(perfect, perfect)))
    assert ratio.value == 1
    assert 0.6 < ratio.interval.high - ratio.interval.low < 0.8


def test_a_backbone_that_is_hardly_known_gives_no_limits() -> None:
    quantile = t.ppf(0.975, 30)
    just = 0.03 * quantile / 0.75
    assert retention(scores(0.05, just * 1.01)).interval.bounded
    assert retention(scores(0.05, just * 0.99)).interval == NO_LIMITS
    assert retention(scores(0.05, -0.2)) == Ratio(-0.25, NO_LIMITS)
    assert np.isnan(retention(scores(0.05, 0.0)).value)


def test_a_mean_is_the_ratio_of_the_means() -> None:
    parts = [scores(0.30, 0.40), scores(0.00, 0.10), scores(0.02, 0.01)]
    ratio = retention(Scores.mean(parts))
    assert ratio.value == pytest.approx(0.32 / 0.51)
    assert ratio.interval.bounded, "though two of the categories have no limits of their own"


def test_a_dead_expert_keeps_its_zero() -> None:
    covered = []
    for seed in range(120):
        fit = fitted(stream(seed, 0.5, 24), stream(seed + 1000, 0.8, 24))
        ratio = retention(Scores.of(fit))
        covered.append(ratio.interval.low <= 0 <= ratio.interval.high)
    assert np.mean(covered) > 0.9


def test_a_run_differs_from_itself_by_nothing() -> None:
    fit = fitted(stream(0, 0.6), stream(1, 0.75))
    gap = retention_difference(Scores.of(fit), Scores.of(fit), fit.covariance_with(fit))
    assert gap.value == 0
    alone = retention(Scores.of(fit)).interval
    assert gap.interval.low <= 0 <= gap.interval.high
    assert gap.interval.high - gap.interval.low < 0.4 * (alone.high - alone.low), "what is left is their skew"


def test_runs_on_other_groups_have_no_correlation() -> None:
    first, other = scores(0.2, 0.3), scores(0.1, 0.35)
    a, b = retention(first), retention(other)
    gap = retention_difference(first, other)
    assert gap.interval == difference_interval(a.value, a.interval, b.value, b.interval)
    assert gap.value == a.value - b.value


def test_the_correlation_is_that_of_the_two_ratios() -> None:
    """Against ratios of many draws from the joint normal distribution."""
    joint = 1e-4 * np.array([[4, 1, 2, 0], [1, 5, 1, 2], [2, 1, 6, 1], [0, 2, 1, 4]])
    above = np.array([0.2, 0.4, 0.15, 0.35])
    drawn = np.random.default_rng(0).multivariate_normal(above, joint, 200_000)
    actual = np.corrcoef(drawn[:, 0] / drawn[:, 1], drawn[:, 2] / drawn[:, 3])[0, 1]
    first, other = Scores(above[:2], joint[:2, :2], 50), Scores(above[2:], joint[2:, 2:], 50)
    a, b = retention(first), retention(other)
    expected = difference_interval(a.value, a.interval, b.value, b.interval, actual)
    limits = retention_difference(first, other, joint[:2, 2:]).interval
    assert (limits.low, limits.high) == pytest.approx((expected.low, expected.high), abs=0.004)


def test_a_difference_with_an_unknown_backbone_has_no_limits() -> None:
    assert retention_difference(scores(0.2, 0.3), scores(0.2, 0.05)).interval == NO_LIMITS
    assert np.isnan(retention_difference(scores(0.2, 0.3), scores(0.2, 0.0), np.eye(2)).value)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.5, 0.9), st.floats(0.5, 0.9), st.integers(5, 40))
def test_limits_hold_the_value_or_there_are_none(seed: int, expert: float, backbone: float, groups: int) -> None:
    ratio = retention(Scores.of(fitted(stream(seed, expert, groups), stream(seed + 1, backbone, groups))))
    if ratio.interval.bounded:
        assert ratio.interval.low - 1e-9 <= ratio.value <= ratio.interval.high + 1e-9
    else:
        assert ratio.interval == NO_LIMITS


def drawn_sums(seed: int, shares: np.ndarray, groups: int, size: int = 4) -> GroupSums:
    """Sites whose groups differ from each other, right in (S,) shares."""
    generator = np.random.default_rng(seed)
    chance = generator.beta(3 * shares[:, None], 3 * (1 - shares[:, None]), (shares.size, groups))
    return GroupSums(generator.binomial(size, chance).astype(float), np.full(groups, float(size)))


def test_the_limit_is_the_highest_of_the_sites_own_limits() -> None:
    sites = drawn_sums(0, np.array([0.5, 0.6, 0.55]), 20)
    each = [at_most(sites.only([row])) for row in range(3)]
    assert at_most(sites) == max(each)
    residuals = sites.sums[0] - sites.accuracies[0] * 4
    right = sites.accuracies[0]
    count = right * (1 - right) * 80**2 / (residuals @ residuals * 20 / 19)
    count *= (t.ppf(0.95, 79) / t.ppf(0.95, 19)) ** 2
    assert each[0] == pytest.approx(beta.ppf(0.95, right * count + 1, (1 - right) * count))


@pytest.mark.parametrize("sites", [1, 4, pytest.param(60, marks=pytest.mark.slow)])
def test_a_best_site_at_the_bound_is_rarely_called_absent(sites: int) -> None:
    """One site has exactly the bound, the others nothing; and all of them have it."""
    for shares in (np.append(np.full(sites - 1, 0.5), ABSENT_BELOW), np.full(sites, ABSENT_BELOW)):
        wrong = np.mean([at_most(drawn_sums(seed, shares, 60)) < ABSENT_BELOW for seed in range(200)])
        assert wrong < 0.05 + 2.5 * np.sqrt(0.05 * 0.95 / 200)


def test_nothing_is_called_absent_with_many_groups_and_not_shown_with_few() -> None:
    nothing = np.full(60, 0.5)
    assert verdict(False, at_most(drawn_sums(0, nothing, 600)), 0.56) == "absent"
    assert verdict(False, at_most(drawn_sums(0, nothing, 12)), 0.56) == "not shown"


def test_a_signal_is_shown_whatever_it_may_be_at_most() -> None:
    assert verdict(True, 0.55, 0.6) == "shown"
    assert verdict(True, 0.9, 0.99) == "shown"


def test_the_bound_can_be_set_and_is_not_reached_by_itself() -> None:
    assert verdict(False, 0.62, 0.6) == "absent"
    assert verdict(False, 0.62, 0.6, absent_below=0.6) == "not shown"
    assert verdict(False, ABSENT_BELOW, 0.6) == "not shown"


def test_an_answer_that_too_few_items_could_not_show_is_not_absent() -> None:
    assert is_absent(0.62, ABSENT_BELOW)
    assert not is_absent(0.62, ABSENT_BELOW + 0.01)
    assert verdict(False, 0.62, np.inf) == "not shown"


@pytest.mark.parametrize("groups", [20, 60, 150])
def test_a_findable_accuracy_is_found_in_four_of_five_experiments(groups: int) -> None:
    """Sites of independent episodes, compared with a fixed threshold."""
    threshold = 0.5 + 1.645 * np.sqrt(0.25 / (4 * groups))
    sums = np.random.default_rng(0).binomial(4, 0.5, (5, groups)).astype(float)
    least = findable(GroupSums(sums, np.full(groups, 4.0)), threshold)
    drawn_sums = np.random.default_rng(1).binomial(4 * groups, least, 4000) / (4 * groups)
    assert np.mean(drawn_sums > threshold) == pytest.approx(0.8, abs=0.05)


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
