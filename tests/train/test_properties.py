"""What holds of the solver whatever the samples: together equals alone, and torch equals numpy."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit.train.crossval.nested_folds import STRENGTHS
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.solver.projection import Projection

SHAPES = {"count": st.integers(8, 40), "width": st.integers(1, 60), "seed": st.integers(0, 2**31)}


def problem(count: int, width: int, seed: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples of any scale, and label columns that hold both classes."""
    draw = np.random.default_rng(seed)
    samples = draw.normal(size=(count, width)) * 10 ** draw.uniform(-2, 3, width) + draw.normal(size=width)
    labels = draw.random((count, columns)) < 0.5
    labels[0], labels[1] = True, False
    return samples, labels


def decisions(samples: np.ndarray | torch.Tensor, labels: np.ndarray) -> np.ndarray:
    """(C, N, K) of the training samples."""
    coordinates = Projection.fit(samples)
    inside = coordinates(samples)
    path = LogisticSolver(coordinates.train).path(labels, STRENGTHS)
    return np.stack([np.asarray(inside @ weights) for weights in path])


@given(**SHAPES)
@settings(max_examples=15, deadline=None)
def test_labels_solved_together_equal_labels_solved_alone(count: int, width: int, seed: int) -> None:
    samples, labels = problem(count, width, seed, 4)
    together = decisions(samples, labels)
    for column in range(4):
        alone = decisions(samples, labels[:, [column]])[..., 0]
        np.testing.assert_allclose(together[..., column], alone, rtol=0, atol=1e-6 * np.abs(alone).max())


@given(**SHAPES)
@settings(max_examples=15, deadline=None)
def test_torch_gives_the_decisions_of_numpy(count: int, width: int, seed: int) -> None:
    samples, labels = problem(count, width, seed, 3)
    ours, theirs = decisions(samples, labels), decisions(torch.from_numpy(samples), labels)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-6 * np.abs(ours).max())
