"""Newton's method with steps in float32 and a certificate in float64, for many logistic regressions at once.

The objective is that of `solver`: C · Σ log(1 + exp(−y f)) + ½‖w‖². Conjugate gradients find every step in
float32, which halves their time. Far from the optimum the gradient is float32 too; near it the gradient is float64
on the exact data, and no problem is given back before this gradient is below the tolerance. So float32 decides how
a solution is found, never what it is.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeNotConvergedError
from probe_kit.train.solver.backend import Array, array_namespace, to_numpy

TOLERANCE = 1e-9
"""A solution is accepted when ‖gradient‖ ≤ TOLERANCE · ‖w‖, in float64."""
NEAR = 0.1
"""Relative gradient, in float32, after which one more step is made and gradients are float64. A smaller one saves
none of these: with 1e-3, solving took a sixth longer."""
MAX_ROUGH_STEPS = 12
MAX_NEWTON_STEPS = 60
MAX_CG_STEPS = 200
MAX_HALVINGS = 30
"""Bounds of loops. Rough steps may stop short, as exact ones follow; columns whose conjugate gradients do are
factorised; after the last Newton step `ProbeNotConvergedError` is raised."""

Rows = NDArray[np.intp]
TINY = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True)
class NewtonState:
    """The objective of k problems at some weights.

    value: (k,) C · Σ loss + penalty. gradient: (k, R) by weights along axes, float64. size, length: (k,) norms
    of gradient and weights as scikit-learn's objective has them. curvature: (k, …) what products with the Hessian
    need.
    """

    value: Array
    gradient: Array
    size: Array
    length: Array
    curvature: Array

    @property
    def relative(self) -> Array:
        """(k,) size of the gradient in units of the weights."""
        larger = array_namespace(self.size).maximum(self.length, self.size)
        return self.size / larger.clip(TINY)

    def only(self, mask: NDArray[np.bool_]) -> "NewtonState":
        """Some of the problems."""
        return self if mask.all() else NewtonState(*(part[mask] for part in vars(self).values()))

    def replace(self, mask: NDArray[np.bool_], states: "NewtonState") -> None:
        """Put `states` in the place of some of the problems."""
        for part, other in zip(vars(self).values(), vars(states).values(), strict=True):
            part[mask] = other


class Problems(Protocol):
    """K logistic regressions, a row of R weights for each, the intercept last; `rows` (k,) are some of them.

    Weights are on features, or turned along axes on which Hessians are nearly diagonal.
    """

    @property
    def strength(self) -> NDArray[np.float64]:
        """(K,) C."""

    def point(self, weights: Array, rows: Rows, *, exact: bool) -> NewtonState:
        """The objective at turned `weights` (k, R), in float32, or at ones on features, exactly: in float64.

        Exact is on the data as they are, whatever the axes are.
        """

    def turned(self, weights: Array) -> Array:
        """(k, R) weights on features, along axes."""

    def turned_back(self, weights: Array) -> Array:
        """(k, R) weights along axes, on features."""

    def rounding(self, rows: Rows) -> Array:
        """(k,) size of a gradient that is all rounding, in float64."""

    def curved(self, directions: Array, curvature: Array, rows: Rows) -> Array:
        """Hessian times `directions` (k, R) float32, by the curvature of a point."""

    def diagonal(self, curvature: Array, rows: Rows) -> Array:
        """(k, R) float32, about the Hessian's diagonal; its inverse preconditions."""

    def exact_step(self, gradient: Array, curvature: Array, row: int) -> Array:
        """(R,) Newton step of one problem, found by factorising its Hessian."""

    def __len__(self) -> int: ...


def solve(problems: Problems, start: Array) -> Array:
    """Optimal weights (K, R) of all problems, found from `start` (K, R).

    Raises ProbeNotConvergedError rather than return one that is not at its optimum.
    """
    search = _NewtonSolver(problems)
    return search.refined(problems.turned_back(search.rough(problems.turned(start))))


@dataclass(frozen=True)
class _NewtonSolver:
    problems: Problems

    def rough(self, start: Array) -> Array:
        """Turned `start` brought near the optimum in float32. The last step is not looked back at."""
        solved, rows, weights = start + 0.0, np.arange(len(start)), start
        point = self._at(weights, rows, exact=False)
        for _ in range(MAX_ROUGH_STEPS):
            moving = to_numpy(point.relative > TOLERANCE)
            rows, weights, point = rows[moving], weights[moving], point.only(moving)
            if not rows.size:
                return solved
            step = self._newton_step(point, rows)
            near = to_numpy(point.relative <= NEAR)
            solved[rows[near]] = weights[near] + step[near]
            if near.all():
                return solved
            rows, weights, point, step = rows[~near], weights[~near], point.only(~near), step[~near]
            slope = (point.gradient * step).sum(axis=1)
            weights, point = self._moved(weights, point, rows, step, slope, exact=False)
            solved[rows] = weights
        return solved

    def refined(self, start: Array) -> Array:
        """`start` brought to the optimum, certified by float64 gradients."""
        solved, rows, weights = array_namespace(start).empty_like(start), np.arange(len(start)), start
        point = self._at(weights, rows, exact=True)
        for _ in range(MAX_NEWTON_STEPS):
            # Negated, so that NaN stays open and ends in an error.
            open_ = to_numpy(~((point.relative <= TOLERANCE) | (point.size <= self.problems.rounding(rows))))
            solved[rows[~open_]] = weights[~open_]
            if not open_.any():
                return solved
            rows, weights, point = rows[open_], weights[open_], point.only(open_)
            step = self._newton_step(point, rows)
            slope = (point.gradient * step).sum(axis=1)
            weights, point = self._moved(weights, point, rows, self.problems.turned_back(step), slope, exact=True)
        strength = self.problems.strength[rows]
        raise ProbeNotConvergedError(
            f"{len(rows)} of {len(self.problems)} logistic problems (C from {strength.min():g} to "
            f"{strength.max():g}) are not at their optimum after {MAX_NEWTON_STEPS} Newton steps: worst relative "
            f"gradient {float(point.relative.max()):.1e}, expected at most {TOLERANCE:.0e}. Look for extreme "
            "feature values."
        )

    def _at(self, weights: Array, rows: Rows, *, exact: bool) -> NewtonState:
        return self.problems.point(weights, rows, exact=exact)

    def _moved(
        self, weights: Array, point: NewtonState, rows: Rows, step: Array, slope: Array, *, exact: bool
    ) -> tuple[Array, NewtonState]:
        """One step on, halved per problem until the objective falls enough. slope: (k,) of it along the step."""
        length = array_namespace(step).ones_like(slope)
        noise = (1e-11 if exact else 1e-6) * abs(point.value)
        moved = weights + step
        state = self._at(moved, rows, exact=exact)
        for _ in range(MAX_HALVINGS):
            too_far = to_numpy(state.value > point.value + 1e-4 * length * slope + noise)
            if not too_far.any():
                break
            length[too_far] /= 2
            moved[too_far] = weights[too_far] + length[too_far, None] * step[too_far]
            state.replace(too_far, self._at(moved[too_far], rows[too_far], exact=exact))
        return moved, state

    def _newton_step(self, point: NewtonState, rows: Rows) -> Array:
        """(k, R) float64: Hessian · step = −gradient, as precisely as the point is worth.

        What conjugate gradients do not settle in time is solved by factorising.
        """
        xp = array_namespace(point.gradient)
        size = xp.amax(abs(point.gradient), axis=1)[:, None].clip(TINY)
        residual = xp.asarray(-point.gradient / size, dtype=xp.float32)
        step, live, curvature = xp.zeros_like(point.gradient), np.arange(len(residual)), point.curvature
        inverse = 1 / self.problems.diagonal(curvature, rows)
        direction = inverse * residual
        slope = (residual * direction).sum(axis=1)
        goal = xp.asarray(_precision(point) ** 2, dtype=xp.float32) * slope
        for _ in range(MAX_CG_STEPS):
            product = self.problems.curved(direction, curvature, rows[live])
            length = (slope / (direction * product).sum(axis=1))[:, None]
            step[live] += length * direction
            residual = residual - length * product
            scaled = inverse * residual
            previous, slope = slope, (residual * scaled).sum(axis=1)
            keep = to_numpy(slope > goal)
            if not keep.any():
                return step * size
            direction = scaled + (slope / previous)[:, None] * direction
            if not keep.all():
                live = live[keep]
                slope, goal, residual, direction, inverse, curvature = (
                    part[keep] for part in (slope, goal, residual, direction, inverse, curvature)
                )
        step = step * size
        for position in live:
            gradient, weight = point.gradient[position], point.curvature[position]
            step[position] = self.problems.exact_step(gradient, weight, int(rows[position]))
        return step


def _precision(point: NewtonState) -> Array:
    """(k,) the share of the gradient that a step may leave: a more precise step would be wasted."""
    relative = point.relative
    return array_namespace(relative).maximum(relative.clip(1e-4, 0.1), 0.5 * TOLERANCE / relative)
