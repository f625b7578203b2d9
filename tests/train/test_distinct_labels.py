"""Label columns that pose the same logistic problem in a training set are solved once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit.errors import TooFewGroupsError
from probe_kit.train.crossval import logistic_folds
from probe_kit.train.crossval.distinct_labels import DistinctProblems, distinct_columns
from probe_kit.train.crossval.logistic_folds import cross_validate
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.samples import Samples


def flips(groups: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Labels of pairs, and again with the pairs of some groups exchanged; the group of every sample."""
    draw = np.random.default_rng(seed)
    items = np.repeat(np.arange(groups), 2 * draw.integers(1, 3, groups))
    labels = np.arange(items.size) % 2 == 0
    return labels[:, None] ^ (draw.random((groups, columns)) < 0.5)[items], items


@given(groups=st.integers(2, 5), columns=st.integers(1, 40), seed=st.integers(0, 2**31))
@settings(max_examples=50, deadline=None)
def test_every_column_is_that_of_its_problem_or_its_opposite(groups: int, columns: int, seed: int) -> None:
    labels, _ = flips(groups, columns, seed)
    problems = DistinctProblems.of(labels)
    assert len(problems) <= 2 ** (groups - 1)
    assert len(np.unique(problems.signs, axis=1).T) == len(problems)
    np.testing.assert_array_equal(problems.by_column(problems.signs), np.where(labels, 1.0, -1.0))
    np.testing.assert_array_equal(problems.signs[:, 0], np.where(labels[:, 0], 1.0, -1.0))


def test_equal_labels_at_another_c_are_another_problem() -> None:
    labels = np.array([[True, False, True, True], [False, True, False, True], [True, False, True, False]])
    problems = DistinctProblems.of(labels, np.array([1.0, 1.0, 10.0, 1.0]))
    assert problems.problem_of.tolist() == [0, 0, 1, 2]
    assert problems.sign.tolist() == [1, -1, 1, 1]
    assert problems.strengths.tolist() == [1, 10, 1]


def test_a_column_of_a_single_class_has_no_problem() -> None:
    with pytest.raises(TooFewGroupsError, match="same label"):
        DistinctProblems.of(np.array([[True, True], [False, True]]))


def test_columns_of_codes_differ_in_any_row() -> None:
    first, places = distinct_columns(np.array([[0.0, 2.0, 0.0, 0.0], [1.0, 1.0, 1.0, 2.0]]))
    assert first.tolist() == [0, 1, 3]
    assert places.tolist() == [0, 1, 0, 2]


@pytest.mark.parametrize("all_qualities", [False, True])
@pytest.mark.parametrize(("groups", "width"), [(10, 30), (12, 8), (30, 60)])
def test_a_column_among_many_gets_the_probe_that_it_gets_by_itself(
    groups: int, width: int, all_qualities: bool
) -> None:
    labels, items = flips(groups, 40, seed=groups)
    features = np.random.default_rng(1).normal(size=(items.size, width))
    folds = nested_folds(labels[:, 0], items, seed=0)
    has_both = np.array([labels[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    labels = labels[:, ((has_both > 0) & (has_both < 1)).all(axis=0)]
    assert labels.shape[1] > logistic_folds.ROUGH_FROM
    samples = Samples.pooled(features)
    together = cross_validate(samples, labels, folds, all_qualities=all_qualities)
    for column in range(labels.shape[1]):
        alone = cross_validate(samples, labels[:, [column]], folds)
        for fitted, expected in zip(together, alone, strict=True):
            assert fitted.strengths[column] == expected.strengths[0]
            np.testing.assert_allclose(fitted.decisions[:, [column]], expected.decisions, rtol=1e-6, atol=1e-9)
