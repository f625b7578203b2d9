"""Rough optima of many small logistic problems in float32, and how far their decisions can be from the exact ones.

The objective is that of `logistic`. A problem of some dozen samples costs numpy's calls, not arithmetic, so all
label columns of several folds share them, without the bookkeeping that an exact optimum needs. A rough optimum
promises nothing by itself: `decision_bounds` says in float64 what it is worth.

The bound rests on the self-concordance of the logistic loss (Bach, Electronic Journal of Statistics 4, 2010). Let
Δ be the way from a point to the optimum, g the gradient and H the Hessian at the point, and z̄ a sample with a one
for the intercept. Along the way the curvature falls by at most exp(−r), r = max |z̄·Δ| over the training samples,
so that ‖Δ‖ (1 − exp(−r)) / r ≤ ν, with ‖Δ‖ in the norm of H and ν that of g in the norm of H⁻¹. As r ≤ M ‖Δ‖ for
M = max ‖z̄‖ in the norm of H⁻¹,

    ‖Δ‖ ≤ −ln(1 − M ν) / M,    |z̄·Δ| ≤ ‖z̄‖ ‖Δ‖.

About the mean μ of the samples weighted by their curvatures s, H has one block for the weights, which is at least
the penalty's, 1, and one for the intercept, C Σ s. So ‖z̄‖² ≤ ‖z − μ‖² + 1 / (C Σ s) in the norm of H⁻¹.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix

Narrow = NDArray[np.floating[Any]]
"""An array of float32, which numpy's annotations lose in products."""

TOLERANCE = 1e-3
"""Norm of a gradient, in units of the weights, at which a rough optimum is accepted."""
FINEST, COARSEST = 1e-2, 0.3
"""Relative precision of a Newton step."""
MAX_NEWTON_STEPS, MAX_CG_STEPS = 12, 20
"""Bounds of loops. What does not settle within them is left as it is: its bound is then wide."""
LONG = 4.0
"""Change of a decision from which on a Newton step is shortened."""
FEW = 0.5
"""Share of the label columns up to which those that have not settled are solved by themselves."""
LARGEST = 80.0
"""Largest margin whose exponential float32 holds."""
TINY = float(np.finfo(np.float32).tiny)


@dataclass
class RoughOptima:
    """About the optimal weights of K label columns of F folds, for one C after another.

    Attributes:
        samples: (F, N, R) float32 samples of the folds in nearly orthogonal columns, the last one all ones for the
            intercept; rows of zeros fill up a fold of fewer samples.
        signs: (F, K, N) float32 labels −1 and +1; 0 where a fold has no sample.
        weights: (F, K, R) float32.
        decisions: (F, K, N) float32 decisions on the samples.
    """

    samples: Narrow
    signs: Narrow
    weights: Narrow
    decisions: Narrow

    @classmethod
    def start(cls, samples: Matrix, signs: Matrix) -> Self:
        """Return weights of zero for samples and labels as in the attributes, of any precision."""
        weights = np.zeros((*signs.shape[:2], samples.shape[2]), np.float32)
        narrow = signs.astype(np.float32)
        return cls(samples.astype(np.float32), narrow, weights, np.zeros_like(narrow))

    @cached_property
    def lengths(self) -> Narrow:
        """The squared length of every column of the samples, (F, 1, R)."""
        squares: Narrow = np.square(self.samples).sum(axis=1)
        return squares[:, None]

    def select(self, folds: NDArray[np.intp], columns: NDArray[np.intp]) -> Self:
        """Return the optima of `folds` (G,), of each its `columns` (G, L)."""
        of_fold = folds[:, None]
        parts = (part[of_fold, columns] for part in (self.signs, self.weights, self.decisions))
        return type(self)(self.samples[folds], *parts)

    def advance(self, strength: float) -> None:
        """Move from the optima of the C before, a smaller one, to those of `strength`."""
        self._advance(strength, MAX_NEWTON_STEPS)

    def _advance(self, strength: float, steps: int) -> None:
        for left in reversed(range(steps)):
            misfit = _misfit(self.signs * self.decisions)
            curvature = np.float32(strength) * misfit * (1 - misfit)
            gradient = (self.signs * misfit) @ self.samples
            gradient *= -np.float32(strength)
            gradient[..., :-1] += self.weights[..., :-1]
            size = np.vecdot(gradient, gradient)
            scale = np.maximum(np.vecdot(self.weights[..., :-1], self.weights[..., :-1]), size)
            relative = size / np.maximum(scale, TINY)
            far = relative > TOLERANCE**2
            most = far.sum(axis=1).max()
            if most == 0:
                return
            if most <= FEW * far.shape[1]:
                folds, columns = np.arange(len(far)), np.argsort(~far, axis=1, kind="stable")[:, :most]
                unsettled = self.select(folds, columns)
                unsettled._advance(strength, left + 1)
                self.weights[folds[:, None], columns] = unsettled.weights
                self.decisions[folds[:, None], columns] = unsettled.decisions
                return
            # Columns that have settled share the products, and need no further ones.
            goal = np.where(far, relative.clip(FINEST**2, COARSEST**2) * size, np.inf)
            step, change = _newton_steps(self.samples, self.lengths, gradient, curvature, goal)
            # Shortened so, a Newton step lowers a self-concordant objective. Short steps are taken whole: if one
            # leads astray, the bound shows it.
            longest = abs(change).max(axis=2)
            share = np.where(longest < LONG, 1, np.log1p(longest) / longest.clip(LONG))[..., None]
            self.weights = self.weights + share * step
            self.decisions = self.decisions + share * change


def _newton_steps(
    samples: Narrow, lengths: Narrow, gradient: Narrow, curvature: Narrow, goal: Narrow
) -> tuple[Narrow, Narrow]:
    """Return steps (F, K, R) by conjugate gradients, and the change (F, K, N) of the decisions.

    Args:
        samples: (F, N, R) samples.
        lengths: (F, 1, R) squared length of every column of the samples.
        gradient: (F, K, R) gradient.
        curvature: (F, K, N) curvature of every sample's loss.
        goal: (F, K) squared norm of the residual up to which a step is improved.
    """
    across = samples.swapaxes(1, 2)
    diagonal = lengths * curvature.mean(axis=2)[..., None]
    diagonal[..., :-1] += 1
    residual = -gradient
    direction = residual / diagonal
    slope = np.vecdot(residual, direction)
    step, change = np.zeros_like(residual), np.zeros_like(curvature)
    # Results are written where memory is in the cache already.
    along, bent = np.empty_like(curvature), np.empty_like(curvature)
    product, scaled = np.empty_like(residual), np.empty_like(residual)
    for _ in range(MAX_CG_STEPS):
        np.matmul(direction, across, out=along)
        np.matmul(np.multiply(curvature, along, out=bent), samples, out=product)
        product[..., :-1] += direction[..., :-1]
        length = (slope / np.maximum(np.vecdot(direction, product), TINY))[..., None]
        step += np.multiply(length, direction, out=scaled)
        along *= length
        change += along
        product *= length
        residual -= product
        if not (np.vecdot(residual, residual) > goal).any():
            break
        np.divide(residual, diagonal, out=scaled)
        before, slope = slope, np.vecdot(residual, scaled)
        direction *= (slope / np.maximum(before, TINY))[..., None]
        direction += scaled
    return step, change


def decision_bounds(
    samples: Matrix, signs: Matrix, weights: Narrow, strength: float, held_out: Matrix
) -> NDArray[np.float64]:
    """Return by how much decisions (F, K, T) on held-out samples can differ from those of the exact optimum.

    Infinite where the point is too far from the optimum to tell. See the module for the bound.

    Args:
        samples: (F, N, R) training samples as of `RoughOptima`, in float64.
        signs: (F, K, N) labels as of `RoughOptima`, in float64.
        weights: (F, K, R) weights of any precision.
        strength: Their C.
        held_out: (F, T, R) held-out samples.
    """
    inner, across = samples[..., :-1], samples.swapaxes(1, 2)
    misfit = _misfit(signs * (weights @ across))
    curvature = strength * misfit * (1 - misfit) * abs(signs)
    gradient = -strength * ((signs * misfit) @ samples)
    gradient[..., :-1] += weights[..., :-1]
    total = curvature.sum(axis=2).clip(np.finfo(float).tiny)
    mean = (curvature @ inner) / total[..., None]
    of_intercept = gradient[..., -1]
    by_weight = gradient[..., :-1] - mean * of_intercept[..., None]
    size = np.sqrt(np.vecdot(by_weight, by_weight) + of_intercept**2 / total)
    size += 1e-15 * strength * np.sqrt(np.square(samples).sum(axis=(1, 2)) * samples.shape[1])[:, None]

    def norms(episodes: Matrix) -> Matrix:
        """Return the norms (F, K, M) of episodes (F, M, R) with the intercept's one."""
        plain = episodes[..., :-1]
        squares = np.vecdot(plain, plain)[:, None] - 2 * (mean @ plain.swapaxes(1, 2))
        squares += (np.vecdot(mean, mean) + 1 / total)[..., None]
        root: Matrix = np.sqrt(squares)
        return root

    largest = np.where(signs == 0, 0, norms(samples)).max(axis=2)
    near = largest * size < 0.5
    distance = np.where(near, -np.log1p(-np.minimum(largest * size, 0.5)) / largest, np.inf)
    return distance[..., None] * norms(held_out)


def _misfit(margins: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return 1 − P(label) of margins, in place of them."""
    np.minimum(margins, LARGEST, out=margins)
    np.exp(margins, out=margins)
    margins += 1
    np.reciprocal(margins, out=margins)
    return margins
