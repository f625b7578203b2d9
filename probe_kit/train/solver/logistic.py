"""Exact solver of many L2-regularised logistic regressions on the same samples.

The objective is scikit-learn's: C · Σ log(1 + exp(−y f)) + ½‖w‖², f = Zw, the intercept not penalised. Samples
come in principal coordinates (`design_matrix.Projection`), whose columns are nearly orthogonal: there the Hessian
I + C·ZᵀSZ is nearly diagonal. So Newton steps by conjugate gradients with a diagonal preconditioner need a few
products each. All label columns share these as matrix–matrix products.

With many samples, products are float32 between two points that are known exactly: decisions and sums there are
float64, and float32 only adds what changed since. Whether a solution is accepted is decided at an exact point, so
that the precision of a step shapes the way, never the optimum. Samples may be numpy arrays or torch tensors; those
on a GPU are solved there.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeNotConvergedError, TooFewGroupsError
from probe_kit.train.solver.arrays import Array, array_namespace, keep_freed_memory
from probe_kit.train.solver.design_matrix import Design

# -- one Newton step, by conjugate gradients -----------------------------------------------------------------

MAX_CG_STEPS = 100
"""Steps beyond which a column is solved by factorising; another number changes times, not optima."""


def newton_steps(
    design: Design, penalty: Array, gradient: Array, curvature: Array, precision: Array
) -> tuple[Array, Array, Array]:
    """Solve (penalty + ZᵀSZ) step = −gradient per column, in the design's precision.

    Args:
        design: N samples Z in R coordinates.
        penalty: (R, 1) diagonal of the penalty.
        gradient: (R, K) gradient of every column.
        curvature: (N, K), the diagonals S.
        precision: (K,) relative precision of every column's step.

    Returns:
        The steps (R, K), the change Z · step (N, K) of the decisions, which needs no further product, and the
        numbers of the columns that were not solved in time, whose steps are 0.
    """
    xp = array_namespace(gradient)
    # Scaled to length 1: `precision` is relative, and no square underflows in float32.
    size = xp.linalg.norm(gradient, axis=0).clip(np.finfo(float).tiny)
    spectrum = design.spectrum
    penalty, residual, curvature, precision = (
        xp.asarray(part, dtype=spectrum.dtype) for part in (penalty, -gradient / size, curvature, precision)
    )
    live = xp.arange(residual.shape[1], device=residual.device)
    solved, changed, step, change = (
        make(part) for make in (xp.empty_like, xp.zeros_like) for part in (residual, curvature)
    )
    diagonal = penalty + spectrum * curvature.mean(axis=0)
    direction = residual / diagonal
    slope = _dots(residual, direction)
    bent, scaled = xp.empty_like(curvature), xp.empty_like(residual)
    for _ in range(MAX_CG_STEPS):
        along = design @ direction
        product = design.gather(xp.multiply(curvature, along, out=bent))
        product += xp.multiply(penalty, direction, out=scaled)
        length = slope / _dots(direction, product)
        step += xp.multiply(length, direction, out=scaled)
        along *= length
        change += along
        product *= length
        residual -= product
        keep = _dots(residual, residual) > precision**2
        if not keep.any():
            if len(live) < len(size):
                solved[:, live], changed[:, live] = step, change
                step, change = solved, changed
            return step * size, change * size, live[keep]
        if not keep.all():
            solved[:, live[~keep]], changed[:, live[~keep]] = step[:, ~keep], change[:, ~keep]
            live, slope, precision = live[keep], slope[keep], precision[keep]
            residual, direction, diagonal, curvature, step, change = _columns_of(
                keep, residual, direction, diagonal, curvature, step, change
            )
            bent, scaled = xp.empty_like(curvature), xp.empty_like(residual)
        xp.divide(residual, diagonal, out=scaled)
        previous, slope = slope, _dots(residual, scaled)
        direction *= slope / previous
        direction += scaled
    solved[:, live], changed[:, live] = 0.0, 0.0
    return solved * size, changed * size, live


def _columns_of(mask: Array, *arrays: Array) -> list[Array]:
    """Return the columns of a mask (K,) of every array (…, K)."""
    if not isinstance(mask, np.ndarray):
        return [array[:, mask] for array in arrays]
    # Of numpy, `take` costs half of a mask.
    numbers = np.flatnonzero(mask)
    return [array.take(numbers, axis=1) for array in arrays]


def _dots(first: Array, second: Array) -> Array:
    """Return the scalar products of columns, (K,)."""
    return array_namespace(first).einsum("rk,rk->k", first, second)


# -- the solver ----------------------------------------------------------------------------------------------

MAX_NEWTON_STEPS = 100
"""Bound after which `ProbeNotConvergedError` is raised: no probe is used that is not at its optimum."""
MAX_STEPS_BETWEEN = 10
"""Newton steps by products in float32 from one exact point to the next."""
COARSEST, FINEST = 0.1, 1e-5
"""Relative precision of a step: the coarsest that is useful, and the finest before rounding in float32."""
NEAR = 2e-2
"""Relative gradient after which one more step in float32 is made, before a point is computed exactly."""
GAIN = 1e-5
"""Share of an exact point's gradient that steps in float32 leave: less would be their rounding."""
EXACT = 1e-12
"""Share of an objective that is rounding in float64."""
SAFETY = 0.3
"""Share of the tolerance at which steps aim, so that the exact gradient is below it."""


@dataclass(frozen=True)
class _Point:
    """The weights of problems, one column each, and the objective there.

    Attributes:
        weights: (R, K) weights.
        decisions: (N, K) Z · weights.
        loss: (K,) loss summed over all samples.
        misfit: (N, K) 1 − P(label).
        pulled: (R, K) Zᵀ · (signs ∘ misfit).
    """

    weights: Array
    decisions: Array
    loss: Array
    misfit: Array
    pulled: Array

    def like(self) -> "_Point":
        """Return as many points without values."""
        return _Point(*(array_namespace(part).empty_like(part) for part in vars(self).values()))

    def only(self, mask: Array) -> "_Point":
        """Return some of the points."""
        return _Point(*(part[..., mask] for part in vars(self).values()))

    def put(self, mask: Array, points: "_Point") -> None:
        """Replace some of the points by `points`."""
        for part, other in zip(vars(self).values(), vars(points).values(), strict=True):
            part[..., mask] = other


@dataclass(frozen=True)
class _Problems:
    """The problems still to be solved, one column each, and their points."""

    samples: Design
    columns: Array
    strength: Array  # (K,)
    rounding: Array  # (K,) gradients as small as this are zero
    signs: Array  # (N, K) labels as −1 and +1
    at: _Point

    def only(self, mask: Array) -> "_Problems":
        """Return some of the problems."""
        if mask.all():
            return self
        columns, strength, rounding = self.columns[mask], self.strength[mask], self.rounding[mask]
        return _Problems(
            self.samples.of(mask), columns, strength, rounding, self.signs[:, mask], self.at.only(mask)
        )


class LogisticSolver:
    """A solver of every column of a label matrix for one C after another, each warm-started by the one before.

    Args:
        samples: N samples in R orthogonal columns, the last one all ones for the intercept.
        tolerance: A solution is accepted when ‖gradient‖ ≤ tolerance · ‖w‖. The objective is 1-strongly convex in
            w, so this bounds ‖w − w*‖ / ‖w‖ as well, up to a factor for the intercept (the samples' mean norm).
    """

    def __init__(self, samples: Design, tolerance: float = 1e-9) -> None:
        self.samples = samples
        self.tolerance = tolerance
        spectrum = samples.spectrum
        self.xp = array_namespace(spectrum)
        self.penalty = self.xp.ones_like(spectrum[:, :1])
        self.penalty[-1] = 0.0
        # The unit of float64 times the largest norm that Zᵀ · misfit can have: ‖Z‖ · √N.
        self.rounding = 1e-15 * (spectrum.sum(axis=0) * samples.shape[0]) ** 0.5

    def path(self, labels: NDArray[np.bool_], strengths: NDArray[np.float64]) -> Iterator[Array]:
        """Yield the optimal weights (R, K) of every label column of (N, K), for each C of ascending `strengths`.

        Raises:
            ProbeNotConvergedError: If a column is not at its optimum after the last step.
            TooFewGroupsError: For a column with a single class, which has no optimum.
        """
        check_single_class(labels)
        signs = 2.0 * self.xp.asarray(labels, dtype=self.xp.float64, device=self.penalty.device) - 1.0
        yield from self.path_of_signs(signs, strengths)

    def path_of_signs(self, signs: Array, strengths: Iterable[float | Array]) -> Iterator[Array]:
        """Yield the weights of `path` for labels −1 and +1, (N, K).

        Args:
            signs: (N, K) labels; 0 leaves the sample out of that column.
            strengths: Ascending C, each a number or one per column (K,).

        Raises:
            ProbeNotConvergedError: If a column is not at its optimum after the last step.
        """
        if self._narrow is not self.samples:
            keep_freed_memory()
        shape = self.samples.shape[1], signs.shape[1]
        weights = self.xp.zeros(shape, dtype=signs.dtype, device=signs.device)
        at = self._point(self.samples, signs, weights, self.xp.zeros_like(signs))
        for strength in strengths:
            at = self._solve(signs, strength, at)
            yield at.weights

    def _solve(self, signs: Array, strength: float | Array, start: _Point) -> _Point:
        """Return the optima of labels −1/+1 (N, K), found from points `start` that are known exactly."""
        xp = self.xp
        solved = start.like()
        each = xp.ones_like(start.weights[-1])
        columns = xp.arange(signs.shape[1], device=signs.device)
        todo = _Problems(self.samples, columns, each * strength, each * self.rounding, signs, start)
        for _ in range(MAX_NEWTON_STEPS):
            gradient, size, relative = self._gradient(todo)
            # Negated, so that NaN stays open and ends in an error.
            open_ = ~((relative <= self.tolerance) | (size <= todo.rounding * todo.strength))
            solved.put(todo.columns[~open_], todo.at.only(~open_))
            if not open_.any():
                return solved
            todo, gradient, relative = todo.only(open_), gradient[:, open_], relative[open_]
            if self._narrow is self.samples:
                todo = replace(todo, at=self._step(todo, gradient, relative))
            else:
                todo = replace(todo, at=self._lead(todo, gradient, relative))
        raise ProbeNotConvergedError(
            f"{len(todo.columns)} of {signs.shape[1]} logistic problems (N={len(signs)}, "
            f"C={todo.strength[0]:g}) are not at their optimum after {MAX_NEWTON_STEPS} Newton steps: worst "
            f"relative gradient {relative.max():.1e}, expected at most {self.tolerance:.0e}. "
            "Look for extreme feature values."
        )

    def _lead(self, todo: _Problems, gradient: Array, relative: Array) -> _Point:
        """Return the exact points after steps in float32.

        Where those lead astray, it is the point after a single step that was checked.
        """
        weights = self._led_nearer(todo, gradient, relative)
        led = self._point(todo.samples, todo.signs, weights, todo.samples @ weights)
        before, after = self._objective(todo.strength, todo.at), self._objective(todo.strength, led)
        astray = ~(after <= before + EXACT * abs(before))
        if astray.any():
            led.put(astray, self._step(todo.only(astray), gradient[:, astray], relative[astray]))
        return led

    def _step(self, todo: _Problems, gradient: Array, relative: Array) -> _Point:
        """Return the exact points after one Newton step."""
        step, change = self._newton_steps(todo, gradient, relative, SAFETY * self.tolerance)
        if self._narrow is not self.samples:
            change = todo.samples @ step
        return self._move(todo, gradient, step, change, is_exact=True)

    def _led_nearer(self, todo: _Problems, gradient: Array, relative: Array) -> Array:
        """Return weights (R, K) nearer to the optimum, by products in float32 that add to the exact point.

        The last step is not checked: the exact point does that.
        """
        weights = self.xp.empty_like(todo.at.weights)
        goal = (GAIN * relative).clip(min=SAFETY * self.tolerance)
        todo = replace(todo, columns=self.xp.arange(len(relative), device=relative.device))
        for _ in range(MAX_STEPS_BETWEEN):
            step, change = self._newton_steps(todo, gradient, relative, goal)
            far = relative > NEAR
            weights[:, todo.columns[~far]] = todo.at.weights[:, ~far] + step[:, ~far]
            if not far.any():
                return weights
            todo, goal = todo.only(far), goal[far]
            if not far.all():
                gradient, step, change = gradient[:, far], step[:, far], change[:, far]
            todo = replace(todo, at=self._move(todo, gradient, step, change, is_exact=False))
            gradient, _, relative = self._gradient(todo)
        weights[:, todo.columns] = todo.at.weights
        return weights

    def _gradient(self, todo: _Problems) -> tuple[Array, Array, Array]:
        """Return the objective's gradient (R, K), its norm (K,), and the norm in units of the weights (K,)."""
        xp, at = self.xp, todo.at
        gradient = self.penalty * at.weights
        gradient -= todo.strength * at.pulled
        size = xp.linalg.norm(gradient, axis=0)
        scale = xp.maximum(xp.linalg.norm(at.weights[:-1], axis=0), size)
        return gradient, size, size / scale.clip(np.finfo(float).tiny)

    def _newton_steps(
        self, todo: _Problems, gradient: Array, relative: Array, goal: Array | float
    ) -> tuple[Array, Array]:
        """Return the steps (R, K) and Z · steps (N, K).

        They are as precise as `goal`, the requested relative gradient, needs.
        """
        curvature = todo.strength * todo.at.misfit * (1 - todo.at.misfit)
        if todo.samples.small:
            step = self._exact_newton_steps(todo.samples, gradient, curvature)
            return step, todo.samples @ step
        # More than the point has, or is asked, is wasted work.
        precision = self.xp.maximum(relative, (goal / relative).clip(min=FINEST)).clip(max=COARSEST)
        step, change, unsettled = newton_steps(self._narrow, self.penalty, gradient, curvature, precision)
        for column in unsettled:  # one after another: all Hessians may be more than the memory holds
            problem = gradient[:, column, None], curvature[:, column, None]
            step[:, column] = self._exact_newton_steps(self.samples, *problem)[:, 0]
            change[:, column] = self.samples @ step[:, column]
        return step, change

    @cached_property
    def _narrow(self) -> Design:
        """The samples with which steps are found."""
        return self.samples.narrow()

    def _exact_newton_steps(self, samples: Design, gradient: Array, curvature: Array) -> Array:
        hessians = samples.moments(curvature)
        diagonal = self.xp.arange(len(gradient))
        hessians[:, diagonal, diagonal] += self.penalty[:, 0]
        return self.xp.linalg.solve(hessians, -gradient.T[..., None])[..., 0].T

    def _move(self, todo: _Problems, gradient: Array, step: Array, change: Array, *, is_exact: bool) -> _Point:
        """Return the points along `step`, which is halved per column until the objective falls enough.

        Args:
            todo: K problems with their present points.
            gradient: (R, K) gradient at these points.
            step: (R, K) step of the weights.
            change: (N, K) change of the decisions by the step.
            is_exact: Whether the points are computed in float64; else float32 changes are added to the present
                ones.
        """
        start = todo.at
        value, slope = self._objective(todo.strength, start), (gradient * step).sum(axis=0)
        length = self.xp.ones_like(slope)
        noise = (EXACT if is_exact else 1e-6) * abs(value)
        weights, decisions = start.weights + step, start.decisions + change
        while True:  # ends: towards length 0 the value is that of the start, which the noise allows
            loss, misfit = _losses(todo.signs * decisions)
            bound = value + 1e-4 * length * slope + noise
            too_far = self._value(todo.strength, weights, loss) > bound
            if not too_far.any():
                break
            length[too_far] /= 2
            weights, decisions = start.weights + length * step, start.decisions + length * change
        if is_exact:
            pulled = todo.samples.gather(todo.signs * misfit)
        else:
            narrow = self._narrow
            more = self.xp.asarray(todo.signs * (misfit - start.misfit), dtype=narrow.spectrum.dtype)
            pulled = start.pulled + narrow.gather(more)
        return _Point(weights, decisions, loss, misfit, pulled)

    def _point(self, samples: Design, signs: Array, weights: Array, decisions: Array) -> _Point:
        """Return the objective at `weights`, in float64."""
        loss, misfit = _losses(signs * decisions)
        return _Point(weights, decisions, loss, misfit, samples.gather(signs * misfit))

    def _objective(self, strength: Array, at: _Point) -> Array:
        return self._value(strength, at.weights, at.loss)

    def _value(self, strength: Array, weights: Array, loss: Array) -> Array:
        return strength * loss + 0.5 * self.xp.square(weights[:-1]).sum(axis=0)


def check_single_class(labels: NDArray[np.bool_]) -> None:
    """Raise TooFewGroupsError for a column of (N, K) training labels that has no optimum."""
    if (labels.all(axis=0) | ~labels.any(axis=0)).any():
        raise TooFewGroupsError("all training samples have the same label; a probe needs both classes")


def _losses(margins: Array) -> tuple[Array, Array]:
    """Return the sums (K,) of log(1 + exp(−m)) over (N, K) margins, and each margin's 1 − P(label).

    The latter is the negative slope of a loss.
    """
    xp = array_namespace(margins)
    small = -abs(margins)  # exp of it never overflows, whatever the sign of the margin
    xp.exp(small, out=small)
    loss = (xp.log1p(small) + (-margins).clip(0.0)).sum(axis=0)
    misfit = xp.maximum(small, xp.asarray(margins <= 0, dtype=small.dtype))
    misfit /= 1.0 + small
    return loss, misfit
