from collections.abc import Callable

import numpy as np
import pytest

from probe_kit.hooks import Site
from probe_kit.train import ArrayRun, ProbeCurve, train_probes


@pytest.fixture
def curve(planted_run: Callable[..., ArrayRun]) -> ProbeCurve:
    return train_probes(planted_run({Site("backbone", 3): 2.0}), permutations=20).curves["color", "mean"]


def test_streams_are_families_of_their_own(curve: ProbeCurve) -> None:
    p, accuracy = curve.p_fwe(), curve.correct.mean(axis=1)
    for stream in ("backbone", "expert"):
        rows = curve.stream(stream)
        best = curve.null[rows].max(axis=0)
        expected = [(1 + (best >= accuracy[row]).sum()) / 21 for row in rows]
        np.testing.assert_allclose(p[rows], expected)


def test_folds_partition_the_episodes_and_keep_groups_whole(curve: ProbeCurve) -> None:
    tested = np.concatenate([fold.test for fold in curve.folds()])
    assert sorted(tested) == list(range(80))
    for fold in curve.folds():
        assert not set(curve.groups[fold.train]) & set(curve.groups[fold.test])


def test_correct_compares_the_sign_of_the_decision_with_the_label(curve: ProbeCurve) -> None:
    np.testing.assert_array_equal(curve.correct, (curve.decisions > 0) == curve.labels)
    assert curve.correct[3].mean() > 0.9


def test_depth_runs_from_the_first_to_the_last_layer(curve: ProbeCurve) -> None:
    assert [curve.depth(Site("backbone", layer)) for layer in (0, 2, 4)] == [0.0, 0.5, 1.0]
    assert curve.depth(Site("expert", 1, "residual", 0)) == 1.0
