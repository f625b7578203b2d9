"""One site's probe, its folds and its scores."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binomtest
from sklearn import metrics
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import balanced_accuracy_score, r2_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from probe_kit.errors import NonFiniteActivationError, TooFewGroupsError
from probe_kit.runs.arrays import TokenBlock
from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS, Fold, assign_folds
from probe_kit.statistics.intervals import Share
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval import logistic_folds as small_probe
from probe_kit.train.crossval.logistic_folds import cross_validate
from probe_kit.train.crossval.nested_folds import STRENGTHS, FittedFold, NestedFold, nested_folds
from probe_kit.train.crossval.site_probe import PENALTIES, probe_site
from probe_kit.train.crossval.task_scores import chance_level, explained_scores, fold_auc, log_loss
from probe_kit.train.samples import Samples

ITEMS = np.repeat(np.arange(30), 2)
LABELS = np.tile([True, False], 30)
NONE = np.empty((60, 0), dtype=bool)
FEATURES = np.random.default_rng(0).standard_normal((60, 90)) + 0.25 * np.where(LABELS, 1, -1)[:, None]


def scikit_learn_probe(strength: float, train: np.ndarray) -> LogisticRegression:
    probe = make_pipeline(
        StandardScaler(), LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
    )
    return probe.fit(FEATURES[train], LABELS[train])


def scikit_learn_nested(folds: list[NestedFold]) -> tuple[np.ndarray, list[float]]:
    decisions, chosen_strengths = np.empty(60), []
    for fold in folds:
        loss = np.zeros(STRENGTHS.size)
        for step, strength in enumerate(STRENGTHS):
            for inner in fold.inner:
                held_out = scikit_learn_probe(strength, inner.train).predict_log_proba(FEATURES[inner.test])
                loss[step] -= np.where(LABELS[inner.test], held_out[:, 1], held_out[:, 0]).sum()
        chosen_strengths.append(float(STRENGTHS[loss.argmin()]))
        decisions[fold.outer.test] = scikit_learn_probe(chosen_strengths[-1], fold.outer.train).decision_function(
            FEATURES[fold.outer.test]
        )
    return decisions, chosen_strengths


def test_nested_cross_validation_equals_the_same_loops_over_scikit_learn() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    expected, chosen_strengths = scikit_learn_nested(folds)
    probe = probe_site(Samples.pooled(FEATURES), LABELS, NONE, folds)
    np.testing.assert_allclose(probe.decisions, expected, atol=1e-6 * np.abs(expected).max())
    assert probe.strengths.tolist() == chosen_strengths


def test_inner_log_likelihoods_are_those_of_scikit_learn_at_the_chosen_strength() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    probe = probe_site(Samples.pooled(FEATURES), LABELS, NONE, folds)
    for fold, strength, inner in zip(folds, probe.strengths, probe.inner, strict=True):
        expected = np.zeros(60)
        for inner_fold in fold.inner:
            log_p = scikit_learn_probe(strength, inner_fold.train).predict_log_proba(FEATURES[inner_fold.test])
            expected[inner_fold.test] = np.where(LABELS[inner_fold.test], log_p[:, 1], log_p[:, 0])
        np.testing.assert_allclose(inner, expected, atol=1e-5)
        assert not inner[fold.outer.test].any(), "a fold has no part in the choice of its site"


def test_permuted_columns_are_probed_like_real_labels() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    permuted = flip_items(LABELS, ITEMS, 3, seed=0)
    samples = Samples.pooled(FEATURES)
    null = probe_site(samples, LABELS, permuted, folds).null
    for draw in range(3):
        alone = probe_site(samples, permuted[:, draw], NONE, folds).decisions
        assert null[draw] == ((alone > 0) == permuted[:, draw]).mean()


def test_inner_folds_stay_inside_the_outer_training_side_and_keep_groups_whole() -> None:
    for fold in nested_folds(LABELS, ITEMS, seed=0):
        for inner in fold.inner:
            assert set(inner.train) | set(inner.test) == set(fold.outer.train)
            assert not set(ITEMS[inner.train]) & set(ITEMS[inner.test])


def test_leaking_groups_on_purpose_inflates_accuracy() -> None:
    """Pairs that agree in features and label: split across folds, memory passes for knowledge."""
    generator = np.random.default_rng(1)
    pair = np.repeat(np.arange(40), 2)
    labels = (generator.random(40) < 0.5)[pair]
    features = generator.standard_normal((40, 400))[pair] + 0.1 * generator.standard_normal((80, 400))

    def accuracy(groups: np.ndarray) -> float:
        none = np.empty((80, 0), dtype=bool)
        probe = probe_site(Samples.pooled(features), labels, none, nested_folds(labels, groups, seed=0))
        return float(((probe.decisions > 0) == labels).mean())

    assert accuracy(pair) < 0.6
    assert accuracy(np.arange(80)) > 0.75


def test_too_few_groups_for_the_inner_folds_say_so() -> None:
    with pytest.raises(TooFewGroupsError, match="4 independent groups"):
        nested_folds(LABELS[:8], ITEMS[:8], seed=0)


def test_ties_go_to_the_smaller_strength() -> None:
    """Without any varying feature every C gives the same probe."""
    folds = nested_folds(LABELS, ITEMS, seed=0)
    probe = probe_site(Samples.pooled(np.ones((60, 5))), LABELS, NONE, folds)
    assert (probe.strengths == STRENGTHS[0]).all()


# -- tokens ----------------------------------------------------------------------------------------------------

MASK = np.random.default_rng(2).random((60, 4)) < 0.7
MASK[:, 0] = True
VALUES = np.random.default_rng(3).standard_normal((60, 4, 6)) + 0.4 * np.where(LABELS, 1, -1)[:, None, None]
TOKENS = Samples.tokens(blocks=[TokenBlock(0, VALUES, MASK)], mask=MASK)


def scikit_learn_token_logits(strength: float, fold: Fold) -> np.ndarray:
    """Mean token logit of every test episode, each token of the training episodes being a sample."""
    probe = make_pipeline(
        StandardScaler(), LogisticRegression(C=strength, tol=1e-10, solver="newton-cholesky", max_iter=1000)
    )
    labels = np.repeat(LABELS[fold.train], MASK[fold.train].sum(axis=1))
    probe.fit(VALUES[fold.train][MASK[fold.train]], labels)
    return np.array([probe.decision_function(VALUES[test][MASK[test]]).mean() for test in fold.test])


def test_token_probes_equal_scikit_learn_on_every_token_with_logits_averaged_per_episode() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    probe = probe_site(TOKENS, LABELS, NONE, folds)
    expected = np.empty(60)
    for number, fold in enumerate(folds):
        loss = np.zeros(STRENGTHS.size)
        for step, strength in enumerate(STRENGTHS):
            for inner in fold.inner:
                signed = np.where(LABELS[inner.test], 1, -1) * scikit_learn_token_logits(strength, inner)
                loss[step] += np.logaddexp(0, -signed).sum()
        assert probe.strengths[number] == STRENGTHS[loss.argmin()]
        expected[fold.outer.test] = scikit_learn_token_logits(probe.strengths[number], fold.outer)
    np.testing.assert_allclose(probe.decisions, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("offset", "variation", "dtype"), [(1e7, 5, np.float32), (-1e7, 2, np.float32), (1000, 3, np.float16)]
)
def test_a_side_told_apart_by_a_small_variation_around_a_large_offset_is_read_perfectly(
    offset: float, variation: float, dtype: type
) -> None:
    features = np.random.default_rng(1).standard_normal((60, 4))
    features[:, 2] = offset + np.where(LABELS, variation, -variation)
    probe = probe_site(Samples.pooled(features.astype(dtype)), LABELS, NONE, nested_folds(LABELS, ITEMS, seed=0))
    np.testing.assert_array_equal(probe.decisions > 0, LABELS)


# -- weights ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "samples",
    [Samples.pooled(FEATURES), TOKENS],
    ids=["mean", "tokens"],
)
def test_kept_weights_give_the_held_out_decisions_from_raw_features(samples: Samples) -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    probe = probe_site(samples, LABELS, NONE, folds)
    for number, fold in enumerate(folds):
        held_out = samples.means[fold.outer.test] @ probe.weights[number] + probe.intercepts[number]
        np.testing.assert_allclose(held_out, probe.decisions[fold.outer.test], atol=1e-5)
        along = np.asarray(samples.of(fold.outer.train).features) @ probe.weights[number]
        assert probe.spreads[number] == pytest.approx(
            along.std() / np.linalg.norm(probe.weights[number]), rel=1e-5
        )


# -- torch -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "samples",
    [Samples.pooled(FEATURES), TOKENS],
    ids=["mean", "tokens"],
)
def test_torch_gives_the_numbers_of_numpy(samples: Samples) -> None:
    pytest.importorskip("torch").set_num_threads(1)
    folds = nested_folds(LABELS, ITEMS, seed=0)
    permuted = flip_items(LABELS, ITEMS, 5, seed=0)
    numpy_probe = probe_site(samples, LABELS, permuted, folds)
    torch_probe = probe_site(samples.to("cpu"), LABELS, permuted, folds)
    scale = np.abs(numpy_probe.decisions).max()
    np.testing.assert_allclose(torch_probe.decisions, numpy_probe.decisions, rtol=0, atol=1e-9 * scale)
    np.testing.assert_array_equal(torch_probe.strengths, numpy_probe.strengths)
    np.testing.assert_array_equal(torch_probe.null, numpy_probe.null)


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_features_that_are_not_finite_are_refused_by_number(broken: float) -> None:
    """A NaN makes every decision of its fold "right side" and scores like chance, silently."""
    features = FEATURES.copy()
    features[7, 3] = broken
    folds = nested_folds(LABELS, ITEMS, seed=0)
    with pytest.raises(NonFiniteActivationError, match="1 of 60 episodes hold NaN or infinity, first number 7"):
        probe_site(Samples.pooled(features), LABELS, NONE, folds)


GENERATOR = np.random.default_rng(0)
SIDES = GENERATOR.random(80) < 0.3
DECISIONS = np.round(GENERATOR.standard_normal(80) + SIDES, 1)  # rounded, so that there are ties
EVERYTHING = [Fold(np.arange(0), np.arange(80))]


def test_scores_equal_scikit_learn() -> None:
    probability = 1 / (1 + np.exp(-DECISIONS))
    assert log_loss(DECISIONS, SIDES) == pytest.approx(metrics.log_loss(SIDES, probability))
    assert fold_auc(DECISIONS, SIDES, EVERYTHING) == pytest.approx(metrics.roc_auc_score(SIDES, DECISIONS))


def test_auc_does_not_compare_decisions_across_folds() -> None:
    halves = [Fold(np.arange(40, 80), np.arange(40)), Fold(np.arange(40), np.arange(40, 80))]
    shifted = DECISIONS + np.where(np.arange(80) < 40, 0, 100)
    assert fold_auc(shifted, SIDES, halves) == pytest.approx(fold_auc(DECISIONS, SIDES, halves))


def test_chance_is_the_larger_class() -> None:
    assert chance_level(np.array([True, False])) == 0.5
    assert chance_level(np.array([True, False, False, False])) == 0.75


def limits(right: NDArray[np.bool_], groups: NDArray[np.int64]) -> tuple[float, float]:
    interval = Share.of(right, groups).interval()
    return interval.low, interval.high


def test_interval_widens_when_episodes_of_a_group_agree() -> None:
    right = np.repeat(GENERATOR.random(50) < 0.6, 4)
    grouped, apart = (np.diff(limits(right, groups))[0] for groups in (np.arange(200) // 4, np.arange(200)))
    assert grouped == pytest.approx(2 * apart, rel=0.15)


def test_an_interval_where_all_agree_is_that_of_clopper_and_pearson_over_groups() -> None:
    groups = np.arange(40) // 4
    exact = binomtest(10, 10).proportion_ci()
    assert limits(np.ones(40, bool), groups) == pytest.approx((exact.low, 1.0))
    assert limits(np.zeros(40, bool), groups) == pytest.approx((0.0, 1 - exact.low))
    low, high = limits(np.arange(40) < 20, groups)
    assert 0.0 < low < 0.5 < high < 1.0


@pytest.mark.parametrize("alike", [False, True], ids=["episodes apart", "groups of four alike"])
def test_interval_covers_the_truth_nineteen_times_in_twenty(alike: bool) -> None:
    covered = []
    for draw in range(400):
        generator = np.random.default_rng(draw)
        right = np.repeat(generator.random(50) < 0.7, 4) if alike else generator.random(200) < 0.7
        low, high = limits(right, np.arange(200) // 4)
        covered.append(low <= 0.7 <= high)
    assert 0.92 <= np.mean(covered) <= 0.99


KEEPING_THE_PATCH = [HealthCheck.function_scoped_fixture]


def study(groups: int, width: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray, list[NestedFold]]:
    """Features of any scale, label columns, and folds of groups that are not equally large."""
    draw = np.random.default_rng(seed)
    items = np.repeat(np.arange(groups), 2 * draw.integers(1, 4, groups))
    labels = np.arange(items.size) % 2 == 0
    features = draw.normal(size=(items.size, width)) * 10 ** draw.uniform(-2, 2, width)
    features[:, 0] += 3 * np.where(labels, 1, -1) * np.abs(features[:, 0]).mean()
    features[:, -1] = 2.5 if width > 2 else features[:, -1]
    permuted = labels[:, None] ^ (draw.random((groups, columns - 1)) < 0.5)[items]
    return features, np.column_stack([labels, permuted]), nested_folds(labels, items, seed=seed)


def one_after_another(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> list[FittedFold]:
    with monkeypatch.context() as patch:
        patch.setattr(small_probe, "STACKED_COLUMNS", 0)
        return cross_validate(*arguments)  # type: ignore[arg-type]


@pytest.mark.slow
@given(groups=st.integers(6, 14), width=st.integers(1, 50), columns=st.integers(1, 4), seed=st.integers(0, 2**31))
@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=KEEPING_THE_PATCH)
def test_decisions_strengths_and_weights_are_those_of_single_folds(
    monkeypatch: pytest.MonkeyPatch, groups: int, width: int, columns: int, seed: int
) -> None:
    features, labels, folds = study(groups, width, columns, seed)
    shares = np.array([labels[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    assume(((shares > 0) & (shares < 1)).all())
    samples = Samples.pooled(features)
    expected = one_after_another(monkeypatch, samples, labels, folds)
    for at_once in (1, 128):
        monkeypatch.setattr(small_probe, "COLUMNS_AT_ONCE", at_once)
        for fitted, single in zip(cross_validate(samples, labels, folds), expected, strict=True):
            np.testing.assert_array_equal(fitted.strengths, single.strengths)
            for ours, theirs in ((fitted.decisions, single.decisions), (fitted.weights, single.weights)):
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6 * np.abs(theirs).max())
            assert fitted.spread == pytest.approx(single.spread, rel=1e-6)
            np.testing.assert_allclose(fitted.inner.total, single.inner.total, rtol=0, atol=1e-5)
            np.testing.assert_allclose(fitted.inner.first, single.inner.first, rtol=0, atol=1e-5)


def test_torch_gives_the_decisions_of_numpy() -> None:
    features, labels, folds = study(8, 30, 3, seed=1)
    ours = cross_validate(Samples.pooled(features), labels, folds)
    theirs = cross_validate(Samples.pooled(features).to("cpu"), labels, folds)
    assert isinstance(Samples.pooled(features).to("cpu").features, torch.Tensor)
    for our_fold, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(
            other.decisions, our_fold.decisions, rtol=0, atol=1e-6 * np.abs(our_fold.decisions).max()
        )


def test_a_training_set_of_a_single_class_is_an_error() -> None:
    features, labels, folds = study(8, 30, 2, seed=1)
    labels[folds[2].outer.train, 1] = True
    with pytest.raises(TooFewGroupsError, match="same label"):
        cross_validate(Samples.pooled(features), labels, folds)


def test_large_studies_and_tokens_are_not_small() -> None:
    few = np.zeros((300, 1), bool)
    assert small_probe.is_small(Samples.pooled(np.zeros((60, 2048))), few[:60])
    assert not small_probe.is_small(Samples.pooled(np.zeros((300, 2048))), few)
    assert not small_probe.is_small(Samples.pooled(np.zeros((60, 2048))), np.zeros((60, 200), bool))
    tokens = Samples(np.zeros((60, 8)), np.full(20, 3), np.zeros((20, 8)))
    assert not small_probe.is_small(tokens, few[:20])


GROUPS = np.repeat([f"g{number}" for number in range(20)], 6)


def split(groups: NDArray[np.str_], count: int) -> list[Fold]:
    fold_of = assign_folds(np.zeros(groups.size), groups, count, 0)
    return [Fold(np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)) for fold in range(count)]


def nested(groups: NDArray[np.str_]) -> list[NestedFold]:
    return [
        NestedFold(
            outer,
            [Fold(outer.train[i.train], outer.train[i.test]) for i in split(groups[outer.train], INNER_FOLDS)],
        )
        for outer in split(groups, OUTER_FOLDS)
    ]


def problem(task: str, seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Features and (n, 3) labels: one that the features hold, and two permutations of it by groups."""
    draw = np.random.default_rng(seed)
    x = draw.normal(size=(GROUPS.size, 10))
    signal = x[:, 0] + x[:, 1] + 0.7 * draw.normal(size=GROUPS.size)
    y = {
        "binary": (signal > 0.8).astype(float),
        "classes": np.digitize(signal, [-0.5, 0.9]).astype(float),
        "continuous": signal,
    }[task]
    permuted = [y.reshape(20, 6)[draw.permutation(20)].ravel() for _ in range(2)]
    return x, np.column_stack([y, *permuted])


def scaled(x: NDArray[np.float64], fold: Fold) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    scaler = StandardScaler().fit(x[fold.train])
    return scaler.transform(x[fold.train]), scaler.transform(x[fold.test])


def by_scikit_learn(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    predict: Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float], NDArray[np.float64]],
    grid: list[float],
    loss: Callable[[NDArray[np.float64], NDArray[np.float64]], float],
) -> NDArray[np.float64]:
    """Held-out predictions with the strongest of the penalties whose inner loss is lowest."""
    predictions = np.empty_like(y)
    for fold in nested(GROUPS):
        losses = []
        for strength in grid:
            inner_losses = [loss(y[i.test], predict(*scaled(x, i), y[i.train], strength)) for i in fold.inner]
            losses.append(round(sum(inner_losses), 9))
        best = grid[int(np.argmin(losses))]
        predictions[fold.outer.test] = predict(*scaled(x, fold.outer), y[fold.outer.train], best)
    return predictions


def ridge(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], penalty: float
) -> NDArray[np.float64]:
    if np.isinf(penalty):
        return np.repeat(np.atleast_1d(y.mean(axis=0))[None, :], len(test), axis=0).squeeze()
    return np.asarray(Ridge(alpha=penalty).fit(train, y).predict(test))


def clipped_ridge(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], penalty: float
) -> NDArray[np.float64]:
    return ridge(train, test, y, penalty).clip(y.min(), y.max())


def indicators(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], penalty: float
) -> NDArray[np.float64]:
    targets = np.eye(3)[y.astype(int)]
    return ridge(train, test, targets / np.sqrt(targets.sum(axis=0)), penalty).argmax(axis=1).astype(float)


def logistic(
    train: NDArray[np.float64], test: NDArray[np.float64], y: NDArray[np.float64], strength: float
) -> NDArray[np.float64]:
    model = LogisticRegression(C=strength, tol=1e-12, max_iter=10_000).fit(train, y)
    return np.asarray(model.decision_function(test))


def squares(truth: NDArray[np.float64], predicted: NDArray[np.float64]) -> float:
    return float(((truth - predicted) ** 2).sum())


def mean_log_loss(truth: NDArray[np.float64], decisions: NDArray[np.float64]) -> float:
    return float(np.logaddexp(0, np.where(truth == 1, -decisions, decisions)).sum())


def test_a_continuous_label_is_predicted_as_by_scikit_learn() -> None:
    x, columns = problem("continuous")
    columns = columns[:, :2]
    probe = probe_site(Samples.pooled(x), columns[:, 0], columns[:, 1:], nested(GROUPS), "continuous")
    grid = sorted(PENALTIES.tolist(), reverse=True)
    references = [by_scikit_learn(x, column, clipped_ridge, grid, squares) for column in columns.T]
    np.testing.assert_allclose(probe.decisions, references[0], atol=1e-10)
    outer = [fold.outer for fold in nested(GROUPS)]
    null = [
        explained_scores(p[:, None], y[:, None], outer).mean() for p, y in zip(references, columns.T, strict=True)
    ]
    np.testing.assert_allclose(probe.null, null[1:], atol=1e-10)
    assert probe.scores.mean() > 0.5 > max(probe.null)


def test_classes_are_predicted_as_by_scikit_learn() -> None:
    x, columns = problem("classes")
    columns = columns[:, :2]
    probe = probe_site(Samples.pooled(x), columns[:, 0], columns[:, 1:], nested(GROUPS), "classes")
    grid = sorted(PENALTIES.tolist(), reverse=True)

    def wrong(truth: NDArray[np.float64], predicted: NDArray[np.float64]) -> float:
        return -sum((predicted == c)[truth == c].mean() for c in np.unique(truth))

    references = [by_scikit_learn(x, column, indicators, grid, wrong) for column in columns.T]
    assert (probe.decisions == references[0]).all()
    null = [balanced_accuracy_score(y, p) for p, y in zip(references, columns.T, strict=True)]
    np.testing.assert_allclose([probe.scores.mean(), *probe.null], null, atol=1e-12)
    assert probe.scores.mean() > 0.6 > max(probe.null)


def test_a_binary_label_is_predicted_as_by_scikit_learn_without_the_prior_of_the_fold() -> None:
    x, columns = problem("binary")
    probe = probe_site(Samples.pooled(x), columns[:, 0], columns[:, 1:], nested(GROUPS), "binary")
    y = columns[:, 0]
    decisions = by_scikit_learn(x, y, logistic, STRENGTHS.tolist(), mean_log_loss)
    prior = np.empty_like(y)
    for fold in nested(GROUPS):
        share = y[fold.outer.train].mean()
        prior[fold.outer.test] = np.log(share / (1 - share))
    assert (probe.decisions == (decisions > prior)).all()
    assert 0.1 < y.mean() < 0.4, "classes are unequal, so that the prior matters"
    assert probe.scores.mean() == pytest.approx(balanced_accuracy_score(y, decisions > prior), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["binary", "classes", "continuous"])
def test_inner_qualities_are_those_by_which_penalties_are_chosen_above_the_permutations(task: str) -> None:
    """Of every outer fold, by the same loops over scikit-learn, at the penalty that was chosen."""
    x, columns = problem(task)
    grid = 1 / STRENGTHS if task == "binary" else PENALTIES

    def qualities(fold: NestedFold, y: NDArray[np.float64], penalty: float) -> NDArray[np.float64]:
        fold_qualities = np.zeros(y.size)
        for i in fold.inner:
            train, test = scaled(x, i)
            truth = y[i.test]
            if task == "binary":
                decisions = logistic(train, test, y[i.train], 1 / penalty)
                fold_qualities[i.test] = -np.logaddexp(0, np.where(truth == 1, -decisions, decisions))
            elif task == "classes":
                right = indicators(train, test, y[i.train], penalty) == truth
                fold_qualities[i.test] = right / np.array([(truth == label).sum() for label in truth])
            else:
                fold_qualities[i.test] = -((truth - clipped_ridge(train, test, y[i.train], penalty)) ** 2)
        return fold_qualities

    folds = nested(GROUPS)
    probe = probe_site(Samples.pooled(x), columns[:, 0], columns[:, 1:], folds, task)  # type: ignore[arg-type]
    penalties = 1 / probe.strengths if task == "binary" else probe.strengths
    for fold, penalty, inner in zip(folds, penalties, probe.inner, strict=True):
        best = [max(qualities(fold, y, strength).sum() for strength in grid) for y in columns.T[1:]]
        expected = qualities(fold, columns[:, 0], penalty)
        expected[fold.outer.train] -= np.mean(best) / fold.outer.train.size
        np.testing.assert_allclose(inner, expected, atol=1e-6)


def test_the_mean_of_the_scores_is_the_metric_of_scikit_learn() -> None:
    x, columns = problem("continuous")
    single_fold = [Fold(np.arange(40, 120), np.arange(40)), Fold(np.arange(40), np.arange(40, 120))]
    centred = columns[:, 0].copy()
    for fold in single_fold:
        centred[fold.train] -= centred[fold.train].mean()  # so that every training mean is the overall one
    predicted = x[:, 0]
    scores = explained_scores(predicted[:, None], centred[:, None], single_fold)
    assert scores.mean() == pytest.approx(r2_score(centred, predicted), abs=1e-12)


def test_one_sample_far_away_does_not_ruin_the_score() -> None:
    x, columns = problem("continuous")
    far = np.column_stack([x, 1e-5 * np.random.default_rng(1).normal(size=len(x))])
    undisturbed = probe_site(
        Samples.pooled(far), columns[:, 0], columns[:, 1:1], nested(GROUPS), "continuous"
    ).scores.mean()
    far[7, -1] = 1.0  # a hundred thousand deviations where it is not trained on
    outside = probe_site(Samples.pooled(far), columns[:, 0], columns[:, 1:1], nested(GROUPS), "continuous")
    train = np.setdiff1d(np.arange(len(x)), next(f.outer.test for f in nested(GROUPS) if 7 in f.outer.test))
    assert columns[train, 0].min() <= outside.decisions[7] <= columns[train, 0].max()
    assert outside.scores.mean() > undisturbed - 0.2


def test_equal_label_permutations_are_fitted_once_and_scored_alike() -> None:
    x, columns = problem("classes")
    repeated = columns[:, [0, 1, 0, 1, 2]]
    probe = probe_site(Samples.pooled(x), repeated[:, 0], repeated[:, 1:], nested(GROUPS), "classes")
    apart = probe_site(Samples.pooled(x), columns[:, 0], columns[:, 1:], nested(GROUPS), "classes")
    expected = [apart.null[0], apart.scores.mean(), apart.null[0], apart.null[1]]
    np.testing.assert_allclose(probe.null, expected, atol=1e-12)
