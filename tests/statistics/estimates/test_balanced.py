import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit.errors import UnbalancedEpisodesError, UsageError
from probe_kit.statistics.estimates.balanced import GroupSums, balanced_sums, remove_fold_priors
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.data.samples import Samples

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
    kept = ~LABELS | (drawn.random(LABELS.size) > missing)
    kept[:2], kept[-2:] = True, True
    labels, folds, groups = LABELS[kept], FOLD_OF[kept], GROUPS[kept]
    shares = np.array([labels[folds != fold].mean() for fold in folds])
    learned = np.log(shares / (1 - shares))
    constant = [np.full(labels.size, value) for value in (-2.0, 2.0)]
    sums = balanced_sums(np.array([learned - 1e-9, learned + 1e-9, *constant]), labels, folds, groups)
    np.testing.assert_allclose(sums.accuracies[:2], 0.5)
    assert sums.n_episodes == pytest.approx(labels.size)
    if np.abs(learned).max() < 2:
        np.testing.assert_allclose(sums.accuracies[2:], 0.5)


def test_the_balanced_accuracy_is_the_mean_of_the_sides_own_accuracies() -> None:
    kept = np.flatnonzero(~LABELS | (np.arange(LABELS.size) % 8 < 4))
    decisions, labels, folds = decisions_of(1)[:, kept], LABELS[kept], FOLD_OF[kept]
    found = balanced_sums(decisions, labels, folds, GROUPS[kept]).accuracies
    right = (remove_fold_priors(decisions, labels, folds) > 0) == labels
    np.testing.assert_allclose(found, (right[:, labels].mean(axis=1) + right[:, ~labels].mean(axis=1)) / 2)


def test_a_fold_trained_on_twice_as_many_of_one_side_loses_the_logarithm_of_two() -> None:
    labels = np.array([True, True, False, False, True, False])
    folds = np.array([0, 0, 0, 1, 1, 1])
    shifted = remove_fold_priors(np.zeros((1, 6)), labels, folds)
    np.testing.assert_allclose(shifted[0], [np.log(2)] * 3 + [-np.log(2)] * 3)


def test_names_order_the_groups_and_the_order_of_episodes_does_not_matter() -> None:
    decisions, mixed = decisions_of(2), np.random.default_rng(0).permutation(LABELS.size)
    one = balanced_sums(decisions, LABELS, FOLD_OF, GROUPS)
    other = balanced_sums(decisions[:, mixed], LABELS[mixed], FOLD_OF[mixed], GROUPS[mixed])
    np.testing.assert_array_equal(one.sums, other.sums)


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
    kept = ~labels | (generator.random(labels.size) >= 0.6)
    features = generator.standard_normal((labels.size, 8)) + 0.15 * np.where(labels, 1, -1)[:, None]
    labels, groups, features = labels[kept], groups[kept], features[kept]
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
