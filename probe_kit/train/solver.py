"""Many L2-regularised logistic regressions on the same samples, solved exactly and at once.

The objective is scikit-learn's: C · Σ log(1 + exp(−y f)) + ½‖w‖², f = Zw, the intercept not penalised.
Samples come in principal coordinates (`features.Coordinates`), whose columns are orthogonal: there the
Hessian I + C·ZᵀSZ is nearly diagonal, so Newton steps by conjugate gradients with a diagonal preconditioner
need a few products each, and all label columns share them as matrix–matrix products. Steps through many samples
are found in float32; whether a solution is accepted is decided by gradients in float64, so that the precision of a
step shapes the way, never the optimum. numpy arrays or torch tensors: samples on a GPU are solved there.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeNotConvergedError, TooFewGroupsError
from probe_kit.train.arrays import Array, namespace
from probe_kit.train.design import Design

MAX_NEWTON_STEPS = 100
MAX_CG_STEPS = 100
FINEST = 1e-4
"""Relative precision of a step beyond which float32 is rounding."""


@dataclass(frozen=True)
class _Problems:
    """Problems still to be solved, one column each: where they are, and the objective there."""

    samples: Design
    columns: Array
    strength: Array  # (K,)
    rounding: Array  # (K,) gradients as small as this are zero
    signs: Array  # (N, K) labels as −1 and +1
    weights: Array  # (R, K)
    decisions: Array  # (N, K)
    objective: Array  # (K,)

    def only(self, chosen: Array) -> "_Problems":
        if chosen.all():
            return self
        arrays = {name: member[..., chosen] for name, member in vars(self).items() if name != "samples"}
        return _Problems(self.samples.of(chosen), **arrays)


class LogisticSolver:
    """Solves every column of a label matrix for one C after another, each warm-started by the one before.

    samples: N samples in R orthogonal columns, the last one all ones for the intercept.
    tolerance: a solution is accepted when ‖gradient‖ ≤ tolerance · ‖w‖. The objective is 1-strongly convex in w,
    so this bounds ‖w − w*‖ / ‖w‖ as well, up to a factor for the intercept (the samples' mean norm).
    """

    def __init__(self, samples: Design, tolerance: float = 1e-9) -> None:
        self.samples = samples
        self.tolerance = tolerance
        self.spectrum = samples.spectrum
        self.xp = namespace(self.spectrum)
        self.penalty = self.xp.ones_like(self.spectrum[:, :1])
        self.penalty[-1] = 0.0
        self.rounding = 1e-15 * (self.spectrum.sum(axis=0) * samples.shape[0]) ** 0.5

    def path(self, labels: NDArray[np.bool_], strengths: NDArray[np.float64]) -> Iterator[Array]:
        """Optimal weights (R, K) of every label column of (N, K), for each C of ascending `strengths`.

        Raises ProbeNotConvergedError rather than return a column that is not at its optimum, and
        TooFewGroupsError for a column with a single class, which has no optimum.
        """
        refuse_single_class(labels)
        signs = 2.0 * self.xp.asarray(labels, dtype=self.xp.float64, device=self.spectrum.device) - 1.0
        yield from self.path_of_signs(signs, strengths)

    def path_of_signs(self, signs: Array, strengths: Iterable[float | Array]) -> Iterator[Array]:
        """`path` for labels as −1 and +1, (N, K); a sample with 0 is none."""
        shape = self.samples.shape[1], signs.shape[1]
        weights = self.xp.zeros(shape, dtype=signs.dtype, device=signs.device)
        for strength in strengths:
            weights = self.solve(signs, strength, weights)
            yield weights

    def solve(self, signs: Array, strength: float | Array, start: Array) -> Array:
        """Optimal weights (R, K) of labels −1/+1 (N, K), found from `start` (R, K).

        strength: C of all, or (K,) of every column.
        """
        xp = self.xp
        solved = xp.empty_like(start)
        decisions = self.samples @ start
        each = xp.ones_like(start[-1])
        objective = self._objective(signs, strength, start, decisions)
        columns = xp.arange(signs.shape[1], device=signs.device)
        todo = _Problems(
            self.samples, columns, each * strength, each * self.rounding, signs, start, decisions, objective
        )
        for _ in range(MAX_NEWTON_STEPS):
            misfit = _sigmoid(-todo.signs * todo.decisions)
            gradient = self.penalty * todo.weights - todo.strength * todo.samples.gather(todo.signs * misfit)
            size = xp.linalg.norm(gradient, axis=0)
            scale = xp.maximum(xp.linalg.norm(todo.weights[:-1], axis=0), size)
            relative = size / scale.clip(np.finfo(float).tiny)
            # Negated, so that NaN stays open and ends in an error.
            open_ = ~((relative <= self.tolerance) | (size <= todo.rounding * todo.strength))
            solved[:, todo.columns[~open_]] = todo.weights[:, ~open_]
            if not open_.any():
                return solved
            todo, misfit, gradient = todo.only(open_), misfit[:, open_], gradient[:, open_]
            curvature = todo.strength * misfit * (1 - misfit)
            if todo.samples.small:
                step = self._exact_newton_steps(todo.samples, gradient, curvature)
            else:
                step = self._newton_steps(gradient, curvature, self._precision(relative[open_]))
            todo = self._moved(todo, gradient, step)
        raise ProbeNotConvergedError(
            f"{len(todo.columns)} of {signs.shape[1]} logistic problems (N={len(signs)}, "
            f"C={todo.strength[0]:g}) are not at their optimum after {MAX_NEWTON_STEPS} Newton steps: worst "
            f"relative gradient {relative.max():.1e}, expected at most {self.tolerance:.0e}. "
            "Look for extreme feature values."
        )

    def _precision(self, relative: Array) -> Array:
        """(K,) of a step from points with such gradients: more than the point has, or is asked, is wasted work."""
        enough = (0.1 * self.tolerance / relative).clip(min=FINEST)
        return self.xp.maximum(self.xp.sqrt(relative), enough).clip(max=0.1)

    def _newton_steps(self, gradient: Array, curvature: Array, precision: Array) -> Array:
        """Solve (penalty + ZᵀSZ) step = −gradient per column, to relative `precision`.

        Columns that conjugate gradients do not settle in time are solved exactly.
        """
        xp = self.xp
        design, exact = self._narrow, (gradient, curvature)
        penalty, spectrum, gradient, curvature, precision = (
            xp.asarray(part, dtype=design.spectrum.dtype)
            for part in (self.penalty, self.spectrum, gradient, curvature, precision)
        )
        step = xp.zeros_like(gradient)
        todo = xp.arange(gradient.shape[1], device=gradient.device)
        target = precision * xp.linalg.norm(gradient, axis=0)
        diagonal = penalty + spectrum * curvature.mean(axis=0)
        rest = -gradient
        direction = rest / diagonal
        slope = (rest * direction).sum(axis=0)
        for _ in range(MAX_CG_STEPS):
            product = penalty * direction + design.gather(curvature * (design @ direction))
            length = slope / (direction * product).sum(axis=0)
            step[:, todo] += length * direction
            rest = rest - length * product
            keep = xp.linalg.norm(rest, axis=0) > target[todo]
            if not keep.any():
                return xp.asarray(step, dtype=xp.float64)
            if not keep.all():
                todo = todo[keep]
                rest, direction, diagonal, curvature = (
                    part[:, keep] for part in (rest, direction, diagonal, curvature)
                )
                slope = slope[keep]
            scaled = rest / diagonal
            previous, slope = slope, (rest * scaled).sum(axis=0)
            direction = scaled + (slope / previous) * direction
        step, (gradient, curvature) = xp.asarray(step, dtype=xp.float64), exact
        for column in todo:  # one after another: all Hessians may be more than the memory holds
            one = gradient[:, column, None], curvature[:, column, None]
            step[:, column] = self._exact_newton_steps(self.samples, *one)[:, 0]
        return step

    @cached_property
    def _narrow(self) -> Design:
        """What steps are found with."""
        return self.samples.narrow()

    def _exact_newton_steps(self, samples: Design, gradient: Array, curvature: Array) -> Array:
        hessians = samples.moments(curvature)
        diagonal = self.xp.arange(len(gradient))
        hessians[:, diagonal, diagonal] += self.penalty[:, 0]
        return self.xp.linalg.solve(hessians, -gradient.T[..., None])[..., 0].T

    def _moved(self, todo: _Problems, gradient: Array, step: Array) -> _Problems:
        """`todo` moved along `step`, which is halved per column until the objective falls enough."""
        change = todo.samples @ step
        slope = (gradient * step).sum(axis=0)
        length = self.xp.ones_like(slope)
        while True:
            weights, decisions = todo.weights + length * step, todo.decisions + length * change
            objective = self._objective(todo.signs, todo.strength, weights, decisions)
            bound = todo.objective + 1e-4 * length * slope + 1e-12 * abs(todo.objective)
            too_far = objective > bound
            if not too_far.any():
                return replace(todo, weights=weights, decisions=decisions, objective=objective)
            length[too_far] /= 2

    def _objective(self, signs: Array, strength: float | Array, weights: Array, decisions: Array) -> Array:
        margins = signs * decisions
        loss = ((-margins).clip(0.0) + self.xp.log1p(self.xp.exp(-abs(margins)))).sum(axis=0)
        return strength * loss + 0.5 * (self.penalty * weights * weights).sum(axis=0)


def refuse_single_class(labels: NDArray[np.bool_]) -> None:
    """Raise TooFewGroupsError for a column of (N, K) training labels that has no optimum."""
    if (labels.all(axis=0) | ~labels.any(axis=0)).any():
        raise TooFewGroupsError("all training samples have the same label; a probe needs both classes")


def _sigmoid(values: Array) -> Array:
    with np.errstate(over="ignore"):  # exp(large) = inf gives the right limit, 0
        return 1.0 / (1.0 + namespace(values).exp(-values))
