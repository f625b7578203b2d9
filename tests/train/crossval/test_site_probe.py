import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from probe_kit.errors import NonFiniteActivationError, TooFewGroupsError
from probe_kit.runs.rows import TokenBlock
from probe_kit.statistics.folds import Fold
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval.nested_folds import STRENGTHS, NestedFold, nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.data.samples import Samples

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
    probe = probe_site(Samples.pooled(FEATURES), LABELS, NONE, folds)
    np.testing.assert_allclose(probe.decisions, expected, atol=1e-6 * np.abs(expected).max())
    assert probe.strengths.tolist() == chosen


def test_inner_log_likelihoods_are_those_of_scikit_learn_at_the_chosen_strength() -> None:
    folds = nested_folds(LABELS, ITEMS, seed=0)
    probe = probe_site(Samples.pooled(FEATURES), LABELS, NONE, folds)
    for fold, strength, inner in zip(folds, probe.strengths, probe.inner, strict=True):
        expected = np.zeros(60)
        for one in fold.inner:
            log_p = scikit_learn_probe(strength, one.train).predict_log_proba(FEATURES[one.test])
            expected[one.test] = np.where(LABELS[one.test], log_p[:, 1], log_p[:, 0])
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
