"""Rough optima of logistic probes: what their bounds promise, and that they choose the C of exact optima."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval import logistic_folds
from probe_kit.train.crossval.distinct_labels import DistinctProblems
from probe_kit.train.crossval.logistic_folds import can_be_rough, choose_roughly, choose_strengths, cross_validate
from probe_kit.train.crossval.nested_folds import STRENGTHS, NestedFold, can_be_least, nested_folds
from probe_kit.train.samples import Samples
from probe_kit.train.solver import rough_path as rough
from probe_kit.train.solver.arrays import RowSubset, Standardiser, threads_for
from probe_kit.train.solver.design_matrix import DenseDesign, Projection, fold_samples
from probe_kit.train.solver.logistic import LogisticSolver

GENERATOR = np.random.default_rng(5)
NOISE = GENERATOR.standard_normal((40, 60))
LABELS = np.arange(40) % 2 == 0
SIGNS = np.where(LABELS, 1.0, -1.0)[:, None]

CASES: dict[str, Callable[[], np.ndarray]] = {
    "no signal": lambda: NOISE,
    "separable": lambda: NOISE + 3 * SIGNS,
    "few features": lambda: NOISE[:, :3] + SIGNS,
    "nearly equal pairs": lambda: np.repeat(NOISE[:20], 2, axis=0) + 1e-7 * NOISE,
    "outliers": lambda: NOISE * np.where(np.arange(40) % 9, 1, 60)[:, None],
    "a constant feature": lambda: np.column_stack([NOISE, np.full(40, 2.5)]),
}


def study(groups: int, width: int, columns: int, seed: int) -> tuple[Samples, np.ndarray, list[NestedFold]]:
    """Features of any scale, label columns, and folds of groups that are not equally large."""
    draw = np.random.default_rng(seed)
    items = np.repeat(np.arange(groups), 2 * draw.integers(1, 4, groups))
    labels = np.arange(items.size) % 2 == 0
    features = draw.normal(size=(items.size, width)) * 10 ** draw.uniform(-2, 2, width)
    features[:, 0] += draw.uniform(0, 3) * np.where(labels, 1, -1) * np.abs(features[:, 0]).mean()
    permuted = labels[:, None] ^ (draw.random((groups, columns - 1)) < 0.5)[items]
    return Samples.pooled(features), np.column_stack([labels, permuted]), nested_folds(labels, items, seed=seed)


def has_both_classes(labels: np.ndarray, folds: list[NestedFold]) -> bool:
    shares = np.array([labels[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    return bool(((shares > 0) & (shares < 1)).all())


# -- bounds ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("tolerance", [1e-3, 1e-1, 1e3])
def test_no_decision_differs_from_the_exact_one_by_more_than_its_bound(
    case: Callable[[], np.ndarray], tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rough, "TOLERANCE", tolerance)
    features = case()
    design, held_out = fold_samples(features[:30], features[30:])
    assert isinstance(design, DenseDesign)
    columns = np.column_stack([LABELS[:30], GENERATOR.random((30, 20)) < 0.5])
    signs = (2.0 * columns - 1.0).T[None]
    exact = LogisticSolver(design).path(columns, STRENGTHS)
    optima = rough.RoughOptima.start(design.samples[None], signs)
    finite = 0
    for strength, optimum in zip(STRENGTHS, exact, strict=True):
        optima.advance(strength)
        weights = optima.weights
        (bounds,) = rough.decision_bounds(design.samples[None], signs, weights, strength, held_out[None])
        errors = abs(held_out @ weights[0].T - held_out @ optimum).T
        assert (errors <= bounds + 1e-8).all()  # the exact optimum is one to 1e-9 of its weights
        finite += int(np.isfinite(bounds).sum())
    assert finite > 0 or tolerance == 1e3


def test_a_finer_optimum_has_a_narrower_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    design, held_out = fold_samples(NOISE[:30], NOISE[30:])
    assert isinstance(design, DenseDesign)
    signs = np.where(LABELS[:30], 1.0, -1.0)[None, None]
    widest = []
    for tolerance in (1e-1, 1e-3):
        monkeypatch.setattr(rough, "TOLERANCE", tolerance)
        optima = rough.RoughOptima.start(design.samples[None], signs)
        bounds = []
        for strength in STRENGTHS:
            optima.advance(strength)
            parts = design.samples[None], signs, optima.weights, strength, held_out[None]
            bounds.append(rough.decision_bounds(*parts).max())
        widest.append(max(bounds))
    assert widest[1] < widest[0] / 10


# -- the choice of C -------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(
    groups=st.integers(6, 14),
    width=st.integers(1, 50),
    seed=st.integers(0, 2**31),
    tolerance=st.sampled_from([1e-3, 1e-1, 1e3]),
)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_rough_optima_choose_the_strengths_of_exact_ones(
    monkeypatch: pytest.MonkeyPatch, groups: int, width: int, seed: int, tolerance: float
) -> None:
    samples, labels, folds = study(groups, width, columns=12, seed=seed)
    assume(has_both_classes(labels, folds))
    monkeypatch.setattr(rough, "TOLERANCE", tolerance)
    for fold, (strengths, quality) in zip(folds, choose_roughly(samples, labels, folds), strict=True):
        exact, exact_quality = choose_strengths(samples, labels, fold.inner)
        np.testing.assert_array_equal(strengths, exact)
        np.testing.assert_allclose(quality.first, exact_quality.first, rtol=0, atol=1e-6)


def test_decisions_are_bit_equal_to_those_with_exact_choices() -> None:
    samples, labels, folds = study(12, 40, columns=50, seed=3)
    assert can_be_rough(samples, labels)
    exact = cross_validate(samples, labels, folds)
    for ours, theirs in zip(cross_validate(samples, labels, folds, all_qualities=False), exact, strict=True):
        np.testing.assert_array_equal(ours.decisions, theirs.decisions)
        np.testing.assert_array_equal(ours.weights, theirs.weights)


def test_columns_that_rough_optima_leave_open_are_solved_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    samples, labels, folds = study(12, 40, columns=50, seed=3)
    expected = [choose_strengths(samples, labels, fold.inner)[0] for fold in folds]
    solved: list[int] = []
    alone = logistic_folds._choose_alone
    monkeypatch.setattr(rough, "MAX_NEWTON_STEPS", 1)
    monkeypatch.setattr(
        logistic_folds,
        "_choose_alone",
        lambda samples, labels, *inner: solved.append(labels.shape[1]) or alone(samples, labels, *inner),
    )
    choices = choose_roughly(samples, labels, folds)
    assert max(solved) > 32  # more than are solved by whole Hessians
    for (strengths, _), exact in zip(choices, expected, strict=True):
        np.testing.assert_array_equal(strengths, exact)


def test_a_large_c_is_left_out_where_some_inner_folds_show_that_it_loses() -> None:
    samples, labels, folds = study(12, 40, columns=50, seed=3)
    inner = [[logistic_folds._Training.of(samples, part) for part in fold.inner] for fold in folds]
    problems = [[DistinctProblems.of(labels[part.train]) for part in fold.inner] for fold in folds]
    loss, bound = logistic_folds._rough_losses(labels, inner, problems)
    is_left_out = np.isinf(loss)
    assert is_left_out[-1].mean() > 0.5
    assert not is_left_out[: logistic_folds.CHEAP].any()
    assert (bound[is_left_out] == 0).all()


@pytest.mark.parametrize("is_small", [True, False])
def test_exact_optima_end_at_the_largest_c_that_can_be_best(
    monkeypatch: pytest.MonkeyPatch, is_small: bool
) -> None:
    samples, labels, folds = study(12, 40, columns=50, seed=3)
    grids: list[int] = []
    name = "_choose_stacked" if is_small else "_choose_alone"
    exact = getattr(logistic_folds, name)
    monkeypatch.setattr(logistic_folds, "is_small", lambda *_: is_small)
    monkeypatch.setattr(logistic_folds, name, lambda *parts: grids.append(len(parts[-1])) or exact(*parts))
    choices = choose_roughly(samples, labels, folds)
    first = max(np.flatnonzero(strengths[0] == STRENGTHS)[0] for strengths, _ in choices)
    assert first < grids[0] <= STRENGTHS.size


def test_a_choice_is_settled_if_no_other_loss_can_be_the_least() -> None:
    loss = np.array([[1.0, 1.0, 1.0, 1.0, 1.0], [1.3, 1.3, 1.0, np.nan, np.inf]])
    bound = np.array([[0.1, 0.2, 0.0, 0.1, 0.1], [0.1, 0.1, 0.0, np.inf, 0.0]])
    possible = can_be_least(loss - bound, loss + bound)
    np.testing.assert_array_equal(possible, [[True] * 5, [False, True, True, True, False]])


def test_few_columns_tokens_and_devices_are_not_solved_roughly() -> None:
    pooled = Samples.pooled(NOISE)
    assert can_be_rough(pooled, np.zeros((40, 200), bool))
    assert not can_be_rough(pooled, np.zeros((40, 1), bool))
    assert not can_be_rough(pooled.to("cpu"), np.zeros((40, 200), bool))
    tokens = Samples(NOISE, np.full(20, 2), NOISE[::2])
    assert not can_be_rough(tokens, np.zeros((20, 200), bool))
    assert not can_be_rough(Samples.pooled(np.empty((4000, 8192), np.float32)), np.zeros((4000, 200), bool))


# -- the samples of a fold -------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("in_rows", [False, True], ids=["in memory", "chosen rows"])
def test_samples_of_a_fold_have_the_products_of_standardised_ones(
    case: Callable[[], np.ndarray], in_rows: bool
) -> None:
    features = case()
    train = RowSubset(features, np.arange(30)) if in_rows else features[:30]
    design, held_out = fold_samples(train, features[30:])
    standardise = Standardiser.fit(features[:30])
    inner, outer = standardise(features[:30]), standardise(features[30:])
    assert isinstance(design, DenseDesign)
    scale = np.abs(inner @ inner.T).max() + np.abs(outer @ inner.T).max()
    np.testing.assert_allclose(design.samples @ design.samples.T, inner @ inner.T + 1, atol=1e-12 * scale)
    np.testing.assert_allclose(held_out @ design.samples.T, outer @ inner.T + 1, atol=1e-12 * scale)
    off_diagonal = design.samples[:, :-1].T @ design.samples[:, :-1]
    off_diagonal -= np.diag(np.diag(off_diagonal))
    np.testing.assert_allclose(off_diagonal, 0, atol=1e-10 * scale)


def test_samples_of_a_fold_decide_like_its_projection() -> None:
    features = NOISE + SIGNS
    fold = Fold(np.arange(30), np.arange(30, 40))
    design, held_out = fold_samples(features[fold.train], features[fold.test])
    projection = Projection.fit(features[fold.train])
    paths = (LogisticSolver(samples).path(LABELS[:30, None], STRENGTHS) for samples in (design, projection.train))
    for ours, theirs in zip(*paths, strict=True):
        np.testing.assert_allclose(held_out @ ours, projection(features[fold.test]) @ theirs, atol=1e-7)


@pytest.mark.parametrize(("shape", "threads"), [((48, 6144), 1), ((300, 2048), 1), ((3000, 2048), 2)])
def test_small_products_take_one_thread(shape: tuple[int, int], threads: int) -> None:
    from threadpoolctl import threadpool_info, threadpool_limits

    with threadpool_limits(2, user_api="blas"):
        pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
        if any(pool["num_threads"] < 2 for pool in pools):
            pytest.skip("BLAS has one thread here")
        with threads_for(np.empty(shape, np.float32)):
            pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
            assert {pool["num_threads"] for pool in pools} == {threads}
