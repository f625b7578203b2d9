"""Training sets solved together give what each gives on its own, and what scikit-learn gives."""

import tracemalloc
from collections import Counter
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler

from probe_kit.errors import ProbeNotConvergedError
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval import joint_objective as joint_site
from probe_kit.train.crossval import joint_objective as mixed
from probe_kit.train.crossval import logistic_folds as probe
from probe_kit.train.crossval.joint_objective import JointProblems, JointSite, NewtonState, training_sets
from probe_kit.train.crossval.logistic_folds import (
    can_be_joint,
    cross_validate,
    cross_validate_jointly,
    labels_at_once,
)
from probe_kit.train.crossval.nested_folds import STRENGTHS, FittedFold, nested_folds
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Array, RowSubset
from tests.support.slow_cases import slow_but

GENERATOR = np.random.default_rng(0)
ITEMS = np.repeat(np.arange(30), 2)
LABELS = np.tile([True, False], 30)
FOLDS = nested_folds(LABELS, ITEMS, seed=0)
COLUMNS = np.column_stack([LABELS, flip_items(LABELS, ITEMS, 2, seed=0)])
COUNTS = GENERATOR.integers(3, 9, 60)
SIGNS = np.repeat(np.where(LABELS, 1.0, -1.0), COUNTS)[:, None]
OF_EPISODE = np.repeat(GENERATOR.standard_normal((60, 12)), COUNTS, axis=0)
NOISE = GENERATOR.standard_normal((COUNTS.sum(), 12)) + OF_EPISODE


@pytest.fixture(autouse=True)
def narrow_sites_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The matrices here are tiny."""
    monkeypatch.setattr(probe, "LEAST_WIDTH", 1)


class Evaluated(JointProblems):
    """Counts how often every problem is evaluated."""

    evaluated: ClassVar = Counter[int]()

    def point(self, weights: Array, rows: np.ndarray, *, exact: bool) -> NewtonState:
        self.evaluated.update(rows.tolist())
        return super().point(weights, rows, exact=exact)


def tokens(features: np.ndarray) -> Samples:
    sums = np.add.reduceat(features, np.cumsum(COUNTS) - COUNTS, axis=0, dtype=np.float64)
    return Samples(RowSubset.all(features), COUNTS, sums / COUNTS[:, None])


def outliers() -> np.ndarray:
    features = NOISE + 0.3 * SIGNS
    features[:, 2] *= 1e4
    features[:, 5] = 3e3 + 1e-1 * features[:, 5]
    features[:, 7] = 2.0
    return features


WORLDS: dict[str, Callable[[], np.ndarray]] = {
    "weak signal": lambda: NOISE + 0.2 * SIGNS,
    "no signal": lambda: NOISE,
    "separable": lambda: NOISE + 8 * SIGNS,
    "outlying, shifted and constant features": outliers,
    "float32": lambda: (NOISE + 20 + 0.4 * SIGNS).astype(np.float32),
    "a dependent feature": lambda: np.column_stack([NOISE, NOISE[:, :3].sum(axis=1)]),
    "nothing varies": lambda: np.ones((COUNTS.sum(), 3)),
}
TYPICAL = ("weak signal", "separable", "outlying, shifted and constant features", "nothing varies")


def alone(samples: Samples, labels: np.ndarray) -> list[FittedFold]:
    """Every training set on axes of its own, all in float64."""
    return [
        probe._fit_fold(samples, labels, fold.outer, *probe.choose_strengths(samples, labels, fold.inner))
        for fold in FOLDS
    ]


def assert_same(fitted: list[FittedFold], expected: list[FittedFold]) -> None:
    for fold, other in zip(fitted, expected, strict=True):
        np.testing.assert_array_equal(fold.strengths, other.strengths)
        for part in ("decisions", "weights"):
            ours, theirs = getattr(fold, part), getattr(other, part)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-7 * np.abs(theirs).max())
        assert fold.intercept == pytest.approx(other.intercept, rel=1e-6, abs=1e-8)
        assert fold.spread == pytest.approx(other.spread, rel=1e-6)
        for part in ("total", "first"):
            np.testing.assert_allclose(getattr(fold.inner, part), getattr(other.inner, part), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", slow_but(TYPICAL, WORLDS))
def test_training_sets_together_decide_and_choose_as_each_on_its_own(name: str) -> None:
    samples = tokens(WORLDS[name]())
    site = JointSite.of(samples, FOLDS)
    assert can_be_joint(samples, 3)
    assert site.alike
    assert_same(cross_validate_jointly(site, samples, COLUMNS, FOLDS), alone(samples, COLUMNS))


def test_pooled_samples_can_be_solved_together_but_are_not() -> None:
    """Nothing was seen to be gained there."""
    samples = Samples.pooled(NOISE[:60, :6] + 0.3 * SIGNS[:60])
    assert not can_be_joint(samples, 3)
    site = JointSite.of(samples, FOLDS)
    assert_same(cross_validate_jointly(site, samples, COLUMNS, FOLDS), alone(samples, COLUMNS))


def test_many_columns_are_solved_on_axes_of_their_own_where_these_fit_into_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Together 60 columns take as long as alone at a width of 2,048, and longer at smaller ones."""
    samples = tokens(np.zeros((COUNTS.sum(), 100)))
    assert can_be_joint(samples, 12)
    assert not can_be_joint(samples, 13)
    monkeypatch.setattr(probe, "IN_MEMORY", 8 * 100 * (3 * int(COUNTS.sum()) // 5) - 1)
    assert can_be_joint(samples, 60)


@pytest.mark.parametrize("strength", [STRENGTHS[0], STRENGTHS[-1]])
@pytest.mark.parametrize("world", ["weak signal", "separable"])
def test_either_end_of_the_grid_is_scikit_learns_optimum(world: str, strength: float) -> None:
    features = WORLDS[world]()
    samples = tokens(features)
    site = JointSite.of(samples, FOLDS)
    sets = training_sets(FOLDS)
    signs = np.tile(np.where(LABELS, 1, -1).astype(np.int8), (len(sets), 1))
    problems = JointProblems(site, np.arange(len(sets)), signs, np.full(len(sets), strength))
    weights = mixed.solve(problems, np.zeros((len(sets), 13)))
    decisions = problems.decisions(weights, samples.means)
    for number, train in enumerate(sets):
        rows = np.isin(np.repeat(np.arange(60), COUNTS), train)
        scaler = StandardScaler().fit(features[rows])
        oracle = LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
        oracle.fit(scaler.transform(features[rows]), np.repeat(LABELS, COUNTS)[rows])
        expected = oracle.decision_function(scaler.transform(samples.means))
        np.testing.assert_allclose(decisions[number], expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_steps_that_go_too_far_are_halved_for_the_problems_that_make_them() -> None:
    """Half of the problems start where nearly every sample is saturated, and so a Newton step overshoots."""
    site = JointSite.of(tokens(NOISE + 0.2 * SIGNS), FOLDS)
    sets = np.arange(len(training_sets(FOLDS)))
    signs = np.tile(np.where(LABELS, 1, -1).astype(np.int8), (sets.size, 1))
    problems = Evaluated(site, sets, signs, np.full(sets.size, 1.0))
    start = np.zeros((sets.size, 13))
    expected = mixed.solve(problems, start)
    often = max(problems.evaluated.values())
    start[::2] = np.random.default_rng(0).standard_normal(13) * 20
    problems.evaluated.clear()
    solution = mixed.solve(problems, start)
    np.testing.assert_allclose(solution, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert max(problems.evaluated[number] for number in sets[1::2]) <= often
    assert min(problems.evaluated[number] for number in sets[::2]) > often


@pytest.mark.slow
def test_a_feature_that_one_training_set_never_sees_vary_is_left_to_axes_of_its_own() -> None:
    features = NOISE + 0.2 * SIGNS
    held_out = np.isin(np.repeat(np.arange(60), COUNTS), FOLDS[0].outer.test)
    features[:, 4] = np.where(held_out, features[:, 4], 1.5)
    samples = tokens(features)
    assert not JointSite.of(samples, FOLDS).alike
    assert_same(cross_validate(samples, COLUMNS, FOLDS), alone(samples, COLUMNS))


def test_a_feature_at_the_edge_of_rounding_is_left_to_axes_of_its_own() -> None:
    features = NOISE.astype(np.float32)
    features[:, 1] = 1e4 + 2e-3 * features[:, 1]
    assert not JointSite.of(tokens(features), FOLDS).alike


def test_a_small_variation_around_a_large_offset_is_found_by_all_training_sets_together() -> None:
    features = NOISE.astype(np.float32)
    features[:, 3] = 1e7 + 5 * SIGNS[:, 0]
    samples = tokens(features)
    assert JointSite.of(samples, FOLDS).alike
    fitted = cross_validate(samples, LABELS[:, None], FOLDS)
    for fold, fold_fit in zip(FOLDS, fitted, strict=True):
        np.testing.assert_array_equal(fold_fit.decisions[:, 0] > 0, LABELS[fold.outer.test])


@pytest.mark.slow
def test_fewer_samples_than_features_are_left_to_axes_of_their_own() -> None:
    wide = GENERATOR.standard_normal((COUNTS.sum(), COUNTS.sum() + 5)) + 0.1 * SIGNS
    samples = tokens(wide)
    assert not can_be_joint(samples, 3)
    assert_same(cross_validate(samples, LABELS[:, None], FOLDS), alone(samples, LABELS[:, None]))


def test_permuted_labels_are_solved_in_parts_that_fit_into_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = tokens(NOISE + 0.2 * SIGNS)
    site = JointSite.of(samples, FOLDS)
    many = np.column_stack([LABELS, flip_items(LABELS, ITEMS, 6, seed=1)])
    at_once = cross_validate_jointly(site, samples, many, FOLDS)
    monkeypatch.setattr(probe, "COLUMN_MEMORY", 20 * 7 * 3 * (12 * int(COUNTS.sum()) + 128 * 13))
    assert labels_at_once(site, FOLDS) == 3
    assert_same(cross_validate_jointly(site, samples, many, FOLDS), at_once)


def test_c_is_solved_in_parts_where_one_column_of_labels_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = tokens(NOISE + 0.2 * SIGNS)
    site = JointSite.of(samples, FOLDS)
    at_once = cross_validate_jointly(site, samples, COLUMNS, FOLDS)
    sizes = []

    def solve(problems: JointProblems, start: np.ndarray) -> np.ndarray:
        sizes.append(len(problems))
        return mixed.solve(problems, start)

    monkeypatch.setattr(probe, "solve", solve)
    monkeypatch.setattr(probe, "COLUMN_MEMORY", 20 * 3 * (12 * int(COUNTS.sum()) + 128 * 13))
    assert_same(cross_validate_jointly(site, samples, COLUMNS, FOLDS), at_once)
    assert sizes == [60, 60, 20, 5] * 3  # C by threes, then the outer folds, for every column of labels


@pytest.mark.slow
def test_59_permuted_labels_of_many_tokens_stay_within_the_stated_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Features, their turned copy, COLUMN_MEMORY and blocks; held at once they would be many times as much."""
    counts = np.full(60, 150)
    features = np.random.default_rng(1).standard_normal((9000, 8), dtype=np.float32)
    samples = Samples(RowSubset.all(features), counts, features.reshape(60, 150, 8).mean(axis=1, dtype=float))
    many = np.column_stack([LABELS, flip_items(LABELS, ITEMS, 59, seed=1)])
    monkeypatch.setattr(probe, "COLUMN_MEMORY", 2**23)
    monkeypatch.setattr(probe, "STRENGTHS", np.array([1e-3]))
    monkeypatch.setattr(joint_site, "ROWS_PER_BLOCK", 128)
    tracemalloc.start()
    try:
        cross_validate_jointly(JointSite.of(samples, FOLDS), samples, many, FOLDS)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    together = 60 * 20 * 12 * 9000
    assert peak < 2 * features.nbytes + 2**23 + 2**21 < together / 8


def test_factorised_steps_take_over_from_conjugate_gradients(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = tokens(NOISE + 0.2 * SIGNS)
    expected = cross_validate(samples, COLUMNS, FOLDS)
    monkeypatch.setattr(mixed, "MAX_CG_STEPS", 1)
    assert_same(cross_validate(samples, COLUMNS, FOLDS), expected)


def test_large_weights_that_nearly_cancel_are_found_as_far_as_sums_can_tell(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To 5e-12 here, in 8 steps. Turned at each, weights stay at 3e-11 for 14; at 2e-9 of 80,000 tokens."""
    monkeypatch.setattr(mixed, "TOLERANCE", 1e-13)
    generator, counts = np.random.default_rng(0), np.full(60, 15)
    shared = 30 * np.repeat(generator.standard_normal(60), 15)[:, None]
    signs = np.repeat(np.where(LABELS, 1.0, -1.0), 15)[:, None]
    features = shared + generator.standard_normal((900, 200)) + 0.2 * signs
    means = features.reshape(60, 15, 200).mean(axis=1)
    site = JointSite.of(Samples(RowSubset.all(features), counts, means), FOLDS)
    sets = np.arange(len(training_sets(FOLDS)))
    of_episodes = np.tile(np.where(LABELS, 1, -1).astype(np.int8), (sets.size, 1))
    problems = Evaluated(site, sets, of_episodes, np.full(sets.size, 10.0))
    problems.evaluated.clear()
    mixed.solve(problems, np.zeros((sets.size, 201)))
    assert max(problems.evaluated.values()) <= 10


def test_an_unfinished_probe_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mixed, "MAX_NEWTON_STEPS", 0)
    with pytest.raises(ProbeNotConvergedError, match=r"of 420 logistic problems \(C from 1e-05 to 10\) are not"):
        cross_validate(tokens(NOISE), COLUMNS, FOLDS)
