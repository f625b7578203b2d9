"""Folds solved together give the probes of folds solved one after another, whatever their sizes."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from probe_kit.errors import TooFewGroupsError
from probe_kit.train.crossval import batched_folds as small_probe
from probe_kit.train.crossval.logistic_folds import cross_validate
from probe_kit.train.crossval.nested_folds import FittedFold, NestedFold, nested_folds
from probe_kit.train.data.samples import Samples

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
        patch.setattr(small_probe, "FEW_COLUMNS", 0)
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
        for found, single in zip(cross_validate(samples, labels, folds), expected, strict=True):
            np.testing.assert_array_equal(found.strengths, single.strengths)
            for ours, theirs in ((found.decisions, single.decisions), (found.weights, single.weights)):
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6 * np.abs(theirs).max())
            assert found.spread == pytest.approx(single.spread, rel=1e-6)
            np.testing.assert_allclose(found.inner.total, single.inner.total, rtol=0, atol=1e-5)
            np.testing.assert_allclose(found.inner.first, single.inner.first, rtol=0, atol=1e-5)


def test_torch_gives_the_decisions_of_numpy() -> None:
    features, labels, folds = study(8, 30, 3, seed=1)
    ours = cross_validate(Samples.pooled(features), labels, folds)
    theirs = cross_validate(Samples.pooled(features).to("cpu"), labels, folds)
    assert isinstance(Samples.pooled(features).to("cpu").features, torch.Tensor)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(other.decisions, one.decisions, rtol=0, atol=1e-6 * np.abs(one.decisions).max())


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
