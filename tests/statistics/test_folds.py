import numpy as np
import pytest

from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.folds import assign_folds, fold_numbers, grouped_folds, split_by_fold

GROUPS = np.repeat(np.arange(30), [2, 4, 6] * 10)
LABELS = np.tile([True, False], 60)


def test_no_group_is_in_two_folds() -> None:
    for fold in grouped_folds(LABELS, GROUPS, 5, seed=0):
        assert not set(GROUPS[fold.train]) & set(GROUPS[fold.test])


def test_every_episode_is_tested_exactly_once() -> None:
    tested = np.concatenate([fold.test for fold in grouped_folds(LABELS, GROUPS, 5, seed=0)])
    assert sorted(tested) == list(range(120))


def test_folds_have_nearly_equal_sizes_and_class_shares() -> None:
    for fold in grouped_folds(LABELS, GROUPS, 5, seed=0):
        assert 22 <= fold.test.size <= 26
        assert LABELS[fold.test].mean() == 0.5


def test_a_scarce_class_is_spread_over_the_folds() -> None:
    labels = np.arange(100) < 10
    fold_of = assign_folds(labels, np.arange(100), 5, seed=1)
    assert [int(labels[fold_of == fold].sum()) for fold in range(5)] == [2, 2, 2, 2, 2]


def test_numbers_of_folds_make_the_same_folds_again() -> None:
    folds = grouped_folds(LABELS, GROUPS, 5, seed=0)
    for fold, again in zip(folds, split_by_fold(fold_numbers(folds), range(5)), strict=True):
        np.testing.assert_array_equal(fold.train, again.train)
        np.testing.assert_array_equal(fold.test, again.test)


def test_the_same_seed_gives_the_same_folds_and_another_seed_others() -> None:
    first, again, other = (assign_folds(LABELS, GROUPS, 5, seed) for seed in (0, 0, 1))
    assert (first == again).all()
    assert (first != other).any()


def test_too_few_groups_say_so() -> None:
    with pytest.raises(TooFewGroupsError, match="3 independent groups"):
        grouped_folds([0, 1, 0, 1], ["a", "a", "b", "c"], 5, seed=0)


def test_a_class_that_lives_in_one_group_cannot_be_trained_on() -> None:
    labels = np.arange(40) < 4
    with pytest.raises(TooFewGroupsError, match="single class"):
        grouped_folds(labels, np.arange(40) // 4, 5, seed=0)
