"""Principal axes of samples, numpy arrays or torch tensors: exact, or found in float32 where there are many."""

import numpy as np

from probe_kit.train.solver.backend import Array, array_namespace, to_device_of, to_numpy

WORTH_NARROWING = 1024
"""Features from which on eigenvectors in float32, made orthogonal again, take less time than in float64."""

LEADING, POWERS, SETTLED = 64, 4, 1e-3
"""Axes looked for first, by so many products with a block of vectors, and the share of their variance that they
may miss to be kept. They are the steepest, and would blur the others: float32 knows eigenvectors up to a part of
the largest eigenvalue, which may be 10,000 times the hundredth."""


def principal_axes(samples: Array) -> Array:
    """Orthonormal axes whose span holds the rows of `samples`: (D, R) for (N, D), R = min(N, D).

    An L2-penalised linear model fitted on `samples @ axes` is the one fitted on `samples`: what lies outside
    their span is only penalised, so its weight is zero. In these coordinates the samples' second moments are
    diagonal; only nearly so where there are many, which is enough for steps to be short. Both factors are
    orthogonal to machine precision, or 1e-10 where there are many, also for nearly equal samples, which the
    eigenvectors of a Gram matrix, scaled back, are not.
    """
    xp = array_namespace(samples)
    if samples.shape[0] < samples.shape[1]:
        span = xp.linalg.qr(samples.T)[0]
        return span @ principal_axes(samples @ span)
    moments = samples.T @ samples
    if len(moments) < WORTH_NARROWING:
        return xp.linalg.eigh(moments)[1]
    return _orthogonal(narrow_axes(moments))


def narrow_axes(moments: Array) -> Array:
    """(D, D) float32 principal axes of samples with such moments, which are lost, by ascending variance.

    They shape steps only, so that float32 will do, in half the time.
    """
    xp = array_namespace(moments)
    if len(moments) < WORTH_NARROWING:
        return _eigenvectors(xp.asarray(moments, dtype=xp.float32))
    moments = xp.asarray(moments, dtype=xp.float64)
    leading, variances = _leading(moments)
    count = len(variances)
    if count:
        # They stay eigenvectors, all with four times the least of their variances.
        pulled = moments @ leading - 0.5 * leading * (variances + 4 * variances[0])
        moments -= pulled @ leading.T
        moments -= leading @ pulled.T
    axes = _eigenvectors(xp.asarray(moments, dtype=xp.float32))
    axes[:, len(axes) - count :] = leading
    return axes


def _leading(moments: Array) -> tuple[Array, Array]:
    """(D, k) axes of the largest variances, and these, ascending: as many as a few products settle, maybe none."""
    xp = array_namespace(moments)
    start = np.random.default_rng(0).standard_normal((len(moments), LEADING))
    block = to_device_of(moments, start)
    for _ in range(POWERS):
        block = xp.linalg.qr(moments @ block)[0]
    variances, turn = xp.linalg.eigh(block.T @ moments @ block)
    block = block @ turn
    missed = xp.linalg.norm(moments @ block - block * variances, axis=0)
    unsettled = np.flatnonzero(to_numpy(~(missed <= SETTLED * variances)))
    first = int(unsettled[-1]) + 1 if unsettled.size else 0
    return block[:, first:], variances[first:]


def _eigenvectors(moments: Array) -> Array:
    """(D, D) of symmetric `moments` in float32, which are lost, by ascending eigenvalue."""
    if not isinstance(moments, np.ndarray):
        return array_namespace(moments).linalg.eigh(moments)[1]
    from scipy.linalg import eigh  # type: ignore[import-untyped]  # numpy's takes as long in float32 as in float64

    return eigh(moments, driver="evd", overwrite_a=True, check_finite=False)[1]


def _orthogonal(axes: Array) -> Array:
    """(D, D) float64: float32 axes after a step of Newton and Schulz, which squares what they lack, some 2e-6."""
    xp = array_namespace(axes)
    exact = xp.asarray(axes, dtype=xp.float64)
    lacking = exact.T @ exact
    diagonal = xp.arange(len(axes))
    lacking[diagonal, diagonal] -= 1.0
    missing = (xp.asarray(lacking, dtype=xp.float32) @ axes.T).T  # laid out as axes are
    missing *= 0.5
    exact -= missing
    return exact
