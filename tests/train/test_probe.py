import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from probe_kit.errors import TooFewGroupsError
from probe_kit.train.permutation import flip_items
from probe_kit.train.probe import STRENGTHS, NestedFold, cross_validate, nested_folds, probe_site

ITEMS = np.repeat(np.arange(30), 2)
LABELS = np.tile([True, False], 30)
FEATURES = np.random.default_rng(0).standard_normal((60, 90)) + 0.25 * np.where(LABELS, 1, -1)[:, None]


def scikit_learn_probe(strength: float, train: np.ndarray) -> LogisticRegression:
    probe = make_pipeline(
        StandardScaler(), LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
    )
    return probe.fit(FEATURES[train], LABELS[train])


def scikit_learn_nested(folds: list[NestedFold]) -> tuple[np.ndarray, list[float]]:
    decisions, chosen = np.empty(60), []
    for fold in folds:
        loss = np.zeros(STRENGTHS.size)
        for step, strength in enumerate(STRENGTHS):
            for inner in fold.inner:
                held_out = scikit_learn_probe(strength, inner.train).predict_log_proba(FEATURES[inner.test])
                loss[step] -= np.where(LABELS[inner.test], held_out[:, 1], held_out[:, 0]).sum()
        chosen.append(float(STRENGTHS[loss.argmin()]))
        decisions[fold.outer.test] = scikit_learn_probe(chosen[-1], fold.outer.train).decision_function(
            FEATURES[fold.outer.test]
        )
    return decisions, chosen


def test_nested_cross_validation_equals_the_same_loops_over_scikit_learn() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    expected, chosen = scikit_learn_nested(folds)
    decisions, strengths = cross_validate(FEATURES, LABELS[:, None], folds)
    np.testing.assert_allclose(decisions[:, 0], expected, atol=1e-6 * np.abs(expected).max())
    assert strengths[:, 0].tolist() == chosen


def test_relabelled_columns_are_probed_like_real_labels() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    relabelled = flip_items(LABELS, ITEMS, 3, seed=0)
    null = probe_site(FEATURES, LABELS, relabelled, folds).null
    for draw in range(3):
        alone, _ = cross_validate(FEATURES, relabelled[:, [draw]], folds)
        assert null[draw] == ((alone[:, 0] > 0) == relabelled[:, draw]).mean()


def test_inner_folds_stay_inside_the_outer_training_side_and_keep_groups_whole() -> None:
    for fold in nested_folds(LABELS, ITEMS, seed=0):
        for inner in fold.inner:
            assert set(inner.train) | set(inner.test) == set(fold.outer.train)
            assert not set(ITEMS[inner.train]) & set(ITEMS[inner.test])


def test_leaking_groups_on_purpose_inflates_accuracy() -> None:
    """Twins that agree in features and label: split across folds, memory passes for knowledge."""
    generator = np.random.default_rng(1)
    pair = np.repeat(np.arange(40), 2)
    labels = (generator.random(40) < 0.5)[pair]
    features = generator.standard_normal((40, 400))[pair] + 0.1 * generator.standard_normal((80, 400))

    def accuracy(groups: np.ndarray) -> float:
        decisions, _ = cross_validate(features, labels[:, None], nested_folds(labels, groups, seed=0))
        return float(((decisions[:, 0] > 0) == labels).mean())

    assert accuracy(pair) < 0.6
    assert accuracy(np.arange(80)) > 0.75


def test_too_few_groups_for_the_inner_folds_say_so() -> None:
    with pytest.raises(TooFewGroupsError, match="4 independent groups"):
        nested_folds(LABELS[:8], ITEMS[:8], seed=0)


def test_ties_go_to_the_smaller_strength() -> None:
    """Without any varying feature every C gives the same probe."""
    folds = nested_folds(LABELS, ITEMS, seed=0)
    _, strengths = cross_validate(np.ones((60, 5)), LABELS[:, None], folds)
    assert (strengths == STRENGTHS[0]).all()
