"""Conjugate gradients for many problems on the same samples, one column each, as matrix–matrix products."""

from dataclasses import dataclass

import numpy as np

from probe_kit.train.solver.backend import Array, array_namespace
from probe_kit.train.solver.design_matrix import Design

MAX_CG_STEPS = 100
"""Columns that need more are solved by factorising; another number changes times, not optima."""


@dataclass(frozen=True)
class NewtonSteps:
    """Newton steps, (R, K), and what they change in the decisions: Z · step, (N, K), which costs no product more.

    unsettled: numbers of the columns that were not found in time, and are nothing.
    """

    step: Array
    change: Array
    unsettled: Array


def newton_steps(
    design: Design, penalty: Array, gradient: Array, curvature: Array, precision: Array
) -> NewtonSteps:
    """Solve (penalty + ZᵀSZ) step = −gradient per column, to relative `precision` (K,), in the design's precision.

    penalty: (R, 1). gradient: (R, K). curvature: (N, K), the diagonals S.
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
            return NewtonSteps(step * size, change * size, live[keep])
        if not keep.all():
            solved[:, live[~keep]], changed[:, live[~keep]] = step[:, ~keep], change[:, ~keep]
            live, slope, precision = live[keep], slope[keep], precision[keep]
            residual, direction, diagonal, curvature, step, change = (
                part[:, keep] for part in (residual, direction, diagonal, curvature, step, change)
            )
            bent, scaled = xp.empty_like(curvature), xp.empty_like(residual)
        xp.divide(residual, diagonal, out=scaled)
        previous, slope = slope, _dots(residual, scaled)
        direction *= slope / previous
        direction += scaled
    solved[:, live], changed[:, live] = 0.0, 0.0
    return NewtonSteps(solved * size, changed * size, live)


def _dots(first: Array, second: Array) -> Array:
    """(K,) products of columns."""
    return array_namespace(first).einsum("rk,rk->k", first, second)
