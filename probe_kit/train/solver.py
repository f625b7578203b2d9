"""Many L2-regularised logistic regressions on the same samples, solved exactly and at once.

The objective is scikit-learn's: C · Σ log(1 + exp(−y f)) + ½‖w‖², f = Zw, the intercept not penalised.
Samples come in principal coordinates (`features.Coordinates`), whose columns are orthogonal: there the
Hessian I + C·ZᵀSZ is nearly diagonal, so Newton steps by conjugate gradients with a diagonal preconditioner
need a few products each, and all label columns share them as matrix–matrix products.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeNotConvergedError, TooFewGroupsError

Matrix = NDArray[np.float64]

MAX_NEWTON_STEPS = 100
MAX_CG_STEPS = 100


@dataclass(frozen=True)
class _Problems:
    """Problems still to be solved, one column each: where they are, and the objective there."""

    columns: NDArray[np.intp]
    signs: Matrix  # (N, K) labels as −1 and +1
    weights: Matrix  # (R, K)
    decisions: Matrix  # (N, K)
    objective: Matrix  # (K,)

    def only(self, chosen: NDArray[np.bool_]) -> "_Problems":
        return _Problems(*(member[..., chosen] for member in vars(self).values()))


class LogisticSolver:
    """Solves every column of a label matrix for one C after another, each warm-started by the one before.

    samples: (N, R) float64 with orthogonal columns, the last one all ones for the intercept.
    tolerance: a solution is accepted when ‖gradient‖ ≤ tolerance · ‖w‖. The objective is 1-strongly convex in w,
    so this bounds ‖w − w*‖ / ‖w‖ as well, up to a factor for the intercept (the samples' mean norm).
    """

    def __init__(self, samples: Matrix, tolerance: float = 1e-9) -> None:
        self.samples = samples
        self.tolerance = tolerance
        self.spectrum = np.square(samples).sum(axis=0)[:, None]
        self.penalty = np.ones((samples.shape[1], 1))
        self.penalty[-1] = 0.0
        self.rounding = 1e-15 * np.sqrt(self.spectrum.sum() * len(samples))

    def path(self, labels: NDArray[np.bool_], strengths: Matrix) -> Iterator[Matrix]:
        """Optimal weights (R, K) of every label column of (N, K), for each C of ascending `strengths`.

        Raises ProbeNotConvergedError rather than return a column that is not at its optimum, and
        TooFewGroupsError for a column with a single class, which has no optimum.
        """
        if (labels.all(axis=0) | ~labels.any(axis=0)).any():
            raise TooFewGroupsError("all training samples have the same label; a probe needs both classes")
        signs = np.where(labels, 1.0, -1.0)
        weights: Matrix = np.zeros((self.samples.shape[1], signs.shape[1]))
        for strength in strengths:
            weights = self.solve(signs, float(strength), weights)
            yield weights

    def solve(self, signs: Matrix, strength: float, start: Matrix) -> Matrix:
        """Optimal weights (R, K) of labels −1/+1 (N, K) at C = `strength`, found from `start` (R, K)."""
        solved = np.empty_like(start)
        decisions = self.samples @ start
        objective = self._objective(signs, strength, start, decisions)
        todo = _Problems(np.arange(signs.shape[1]), signs, start, decisions, objective)
        for _ in range(MAX_NEWTON_STEPS):
            misfit = _sigmoid(-todo.signs * todo.decisions)
            gradient = self.penalty * todo.weights - strength * (self.samples.T @ (todo.signs * misfit))
            size = np.linalg.norm(gradient, axis=0)
            scale = np.maximum(np.linalg.norm(todo.weights[:-1], axis=0), size)
            relative = size / np.maximum(scale, np.finfo(float).tiny)
            # Negated, so that NaN stays open and ends in an error.
            open_ = ~((relative <= self.tolerance) | (size <= self.rounding * strength))
            solved[:, todo.columns[~open_]] = todo.weights[:, ~open_]
            if not open_.any():
                return solved
            curvature = strength * (misfit * (1 - misfit))[:, open_]
            # A step more precise than the point it starts from is wasted work.
            precision = np.minimum(0.1, np.sqrt(relative[open_]))
            step = self._newton_step(gradient[:, open_], curvature, precision)
            todo = self._moved(todo.only(open_), strength, gradient[:, open_], step)
        raise ProbeNotConvergedError(
            f"{todo.columns.size} of {signs.shape[1]} logistic problems (N={len(signs)}, C={strength:g}) are "
            f"not at their optimum after {MAX_NEWTON_STEPS} Newton steps: worst relative gradient "
            f"{relative.max():.1e}, expected at most {self.tolerance:.0e}. Look for extreme feature values."
        )

    def _newton_step(self, gradient: Matrix, curvature: Matrix, precision: Matrix) -> Matrix:
        """Solve (penalty + ZᵀSZ) step = −gradient per column, to relative `precision`.

        Columns that conjugate gradients do not settle in time are solved exactly.
        """
        step = np.zeros_like(gradient)
        todo = np.arange(gradient.shape[1])
        target = precision * np.linalg.norm(gradient, axis=0)
        diagonal = self.penalty + self.spectrum * curvature.mean(axis=0)
        rest = -gradient
        direction = rest / diagonal
        slope = (rest * direction).sum(axis=0)
        for _ in range(MAX_CG_STEPS):
            product = self.penalty * direction + self.samples.T @ (curvature * (self.samples @ direction))
            length = slope / (direction * product).sum(axis=0)
            step[:, todo] += length * direction
            rest = rest - length * product
            keep = np.linalg.norm(rest, axis=0) > target[todo]
            if not keep.any():
                return step
            if not keep.all():
                todo = todo[keep]
                rest, direction, diagonal, curvature = (
                    part[:, keep] for part in (rest, direction, diagonal, curvature)
                )
                slope = slope[keep]
            scaled = rest / diagonal
            previous, slope = slope, (rest * scaled).sum(axis=0)
            direction = scaled + (slope / previous) * direction
        for column, weight in zip(todo, curvature.T, strict=True):
            step[:, column] = self._exact_newton_step(gradient[:, column], weight)
        return step

    def _exact_newton_step(self, gradient: Matrix, curvature: Matrix) -> Matrix:
        hessian = (self.samples.T * curvature) @ self.samples
        hessian[np.diag_indices_from(hessian)] += self.penalty[:, 0]
        step: Matrix = np.linalg.solve(hessian, -gradient).astype(np.float64)
        return step

    def _moved(self, todo: _Problems, strength: float, gradient: Matrix, step: Matrix) -> _Problems:
        """`todo` moved along `step`, which is halved per column until the objective falls enough."""
        change = self.samples @ step
        slope = (gradient * step).sum(axis=0)
        length = np.ones(step.shape[1])
        while True:
            weights, decisions = todo.weights + length * step, todo.decisions + length * change
            objective = self._objective(todo.signs, strength, weights, decisions)
            bound = todo.objective + 1e-4 * length * slope + 1e-12 * np.abs(todo.objective)
            too_far = objective > bound
            if not too_far.any():
                return _Problems(todo.columns, todo.signs, weights, decisions, objective)
            length[too_far] /= 2

    def _objective(self, signs: Matrix, strength: float, weights: Matrix, decisions: Matrix) -> Matrix:
        margins = signs * decisions
        loss = (np.maximum(-margins, 0.0) + np.log1p(np.exp(-np.abs(margins)))).sum(axis=0)
        total: Matrix = strength * loss + 0.5 * (self.penalty * weights * weights).sum(axis=0)
        return total


def _sigmoid(values: Matrix) -> Matrix:
    with np.errstate(over="ignore"):  # exp(large) = inf gives the right limit, 0
        result: Matrix = 1.0 / (1.0 + np.exp(-values))
    return result
