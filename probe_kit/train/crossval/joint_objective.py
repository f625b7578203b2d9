"""Logistic objectives of several training sets of one site, evaluated in shared products."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.crossval.joint_design import Block, JointSite
from probe_kit.train.solver.backend import Array, array_namespace
from probe_kit.train.solver.mixed_precision import NewtonState

Inside = Callable[[Array, Block, NDArray[np.intp]], Array]
"""What stands between a product with the samples and one with their transpose: from (k, B) decisions, their block,
and which of the problems they are of, (k, B)."""


@dataclass(frozen=True)
class JointProblems:
    """K problems on one site: (K,) training set of each, (K, E) labels −1/+1 of the episodes, and (K,) C.

    Weights are rows (D + 1): v on features as the site standardises them, and the intercept b. Decisions are
    f = x·v − mean·v + b for a sample x, and the penalty is ½‖scale ∘ v‖²: scale ∘ v are the weights on features as
    the training set standardises them. Steps, and rough weights, are rows (D + 1) along the site's axes: u with
    v = axes · u, and b. Exact weights are never turned: what float64 loses in a turn comes back times the
    curvature along the first axis, which of 80,000 samples is more than a gradient of 1e-9 of the weights.

    Rows that the outer fold of a set tests are left out of its products; those that only an inner fold tests are
    masked, a quarter of the products in vain.
    """

    site: JointSite
    set_of: NDArray[np.intp]
    signs: NDArray[np.int8]
    strength: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.set_of)

    def rounding(self, rows: NDArray[np.intp]) -> Array:
        """(k,) size of a gradient that is all rounding, in float64."""
        scale = 1e-15 * self.site.sets.counts.max() * self.site.turned.shape[1] ** 0.5
        return scale * self._strength(rows, self.site.mean)[:, 0]

    def point(self, weights: Array, rows: NDArray[np.intp], *, exact: bool) -> NewtonState:
        """Objective of `rows`: in float32, at `weights` (k, D + 1) along axes, or exactly, of ones on features."""
        xp, sets = array_namespace(weights), self.set_of[rows]
        loss = xp.zeros(len(rows), dtype=xp.float64, device=weights.device)
        curvature = xp.zeros((len(rows), len(self.site.features)), dtype=xp.float32, device=weights.device)

        def inside(f: Array, block: Block, use: NDArray[np.intp]) -> Array:
            signs, member = self._of_samples(block, rows[use], f)
            each, misfit, bend = _losses(signs * f)
            loss[use] += (each * member).sum(axis=1)
            curvature[use, block.rows] = xp.asarray(bend * member, dtype=xp.float32)
            return -signs * misfit * member

        strength = self._strength(rows, weights)
        if exact:
            mean, v = self.site.sets.mean[sets], weights[:, :-1]
            shrunk = self.site.sets.scale[sets] ** 2 * v
            pulled, total = self._blockwise_products(
                v / self.site.scale, weights[:, -1] - (mean * v).sum(axis=1), sets, inside
            )
            by_feature = shrunk + strength * (pulled / self.site.scale - mean * total[:, None])
            by_axis, measured = by_feature @ self._wide_axes, by_feature / self._divisor[sets]
        else:
            mean, narrow = self._turned_mean[sets], xp.asarray(weights, dtype=xp.float32)
            v, shift = narrow[:, :-1] @ self.site.axes.T, narrow[:, -1] - (mean * narrow[:, :-1]).sum(axis=1)
            shrunk = self._square_scale[sets] * v
            pulled, total = self._blockwise_products(narrow[:, :-1], shift, sets, inside)
            by_axis = shrunk @ self.site.axes + strength * (pulled - mean * total[:, None])
            measured = by_axis  # as long as by features, but for their scales: nothing is accepted by it
        gradient = xp.hstack([by_axis, strength * total[:, None]])
        penalty = (shrunk * v).sum(axis=1, dtype=xp.float64)
        size = (measured**2).sum(axis=1) + gradient[:, -1] ** 2
        return NewtonState(strength[:, 0] * loss + 0.5 * penalty, gradient, size**0.5, penalty**0.5, curvature)

    def curved(self, directions: Array, curvature: Array, rows: NDArray[np.intp]) -> Array:
        """Hessian times `directions` (k, D + 1), by a point's curvature; all float32."""
        xp, sets = array_namespace(directions), self.set_of[rows]
        mean, along = self._turned_mean[sets], directions[:, :-1]
        shift = directions[:, -1] - (mean * along).sum(axis=1)
        pulled, total = self._blockwise_products(
            along, shift, sets, lambda f, block, use: f * curvature[use, block.rows]
        )
        penalty = (self._square_scale[sets] * (along @ self.site.axes.T)) @ self.site.axes
        strength = self._strength(rows, directions)
        inner = penalty + strength * (pulled - mean * total[:, None])
        return xp.hstack([inner, strength * total[:, None]])

    def diagonal(self, curvature: Array, rows: NDArray[np.intp]) -> Array:
        """(k, D + 1) float32, about the Hessian's diagonal: as if all samples were curved alike."""
        xp = array_namespace(curvature)
        weight = self._strength(rows, curvature) * curvature.sum(axis=1)[:, None]
        share = xp.asarray(self.site.variances / len(self.site.features), dtype=xp.float32)
        return xp.hstack([self._penalty_diagonal[self.set_of[rows]] + weight * share, weight])

    def exact_step(self, gradient: Array, curvature: Array, row: int) -> Array:
        """(D + 1,) Newton step of one problem, by its whole Hessian."""
        xp, number, axes = array_namespace(gradient), self.set_of[row], self._wide_axes
        hessian = xp.zeros((len(gradient), len(gradient)), dtype=xp.float64, device=gradient.device)
        for block in self.site.blocks:
            centred = self.site.turned[block.rows] - self._turned_mean[number]
            x = xp.hstack([centred, xp.ones_like(centred[:, :1])])
            hessian += (x.T * curvature[block.rows]) @ x
        hessian *= self.strength[row]
        hessian[:-1, :-1] += (axes.T * self.site.sets.scale[number] ** 2) @ axes
        return xp.linalg.solve(hessian, -gradient)

    def turned(self, weights: Array) -> Array:
        """(k, D + 1) weights on features, along axes."""
        return array_namespace(weights).hstack([weights[:, :-1] @ self._wide_axes, weights[:, -1:]])

    def turned_back(self, weights: Array) -> Array:
        """(k, D + 1) weights along axes, on features."""
        return array_namespace(weights).hstack([weights[:, :-1] @ self._wide_axes.T, weights[:, -1:]])

    def raw(self, weights: Array) -> tuple[Array, Array]:
        """Weights (K, D) and intercepts (K,) on raw features."""
        v = weights[:, :-1]
        raw = v / self.site.scale
        shift = weights[:, -1] - (self.site.sets.mean[self.set_of] * v).sum(axis=1)
        return raw, shift - raw @ self.site.mean

    def decisions(self, weights: Array, samples: Array) -> Array:
        """(K, n) decisions on other samples (n, D)."""
        v = weights[:, :-1]
        shift = weights[:, -1] - (self.site.sets.mean[self.set_of] * v).sum(axis=1)
        return (v / self.site.scale) @ (samples - self.site.mean).T + shift[:, None]

    def deviations(self, weights: Array) -> Array:
        """(K,) deviation of every problem's decisions over its training samples."""
        xp = array_namespace(weights)
        v = weights[:, :-1]
        square, total = (xp.zeros(len(self), dtype=xp.float64, device=weights.device) for _ in range(2))
        for block in self.site.blocks:
            f = (v / self.site.scale) @ self.site.centred(block).T
            _, member = self._of_samples(block, np.arange(len(self)), f)
            square += (member * f**2).sum(axis=1)
            total += (member * f).sum(axis=1)
        count = xp.asarray(self.site.sets.counts[self.set_of], device=weights.device)
        return xp.sqrt((square / count - (total / count) ** 2).clip(0.0))

    def _blockwise_products(
        self, vectors: Array, shift: Array, sets: NDArray[np.intp], inside: Inside
    ) -> tuple[Array, Array]:
        """Σ inside(f)·x (k, D) and Σ inside(f) (k,) over samples x, with f = left·x + shift.

        float64: x are raw samples without the site's mean; float32: samples along the axes.
        """
        xp = array_namespace(vectors)
        exact = vectors.dtype == xp.float64
        pulled, total = xp.zeros_like(vectors), xp.zeros_like(shift)
        for fold, blocks in groupby(self.site.blocks, key=lambda block: block.outer):
            use = np.flatnonzero(self.site.sets.outer[sets] != fold)
            some, start = vectors[use], shift[use][:, None]
            fold_pulled, fold_total = xp.zeros_like(some), xp.zeros_like(start)
            for block in blocks if use.size else ():
                x = self.site.centred(block) if exact else self.site.turned[block.rows]
                values = inside(some @ x.T + start, block, use)
                fold_pulled += values @ x
                fold_total += values.sum(axis=1)[:, None]
            pulled[use] += fold_pulled
            total[use] += fold_total[:, 0]
        return pulled, total

    def _of_samples(self, block: Block, rows: NDArray[np.intp], like: Array) -> tuple[Array, Array]:
        """(k, B) label −1/+1 of every sample, and 1 where its episode belongs to the training set."""
        signs = self.signs[np.ix_(rows, block.episode)]
        member = self.site.sets.member[:, block.episode][self.set_of[rows]]
        return _like(signs, like), _like(member, like)

    def _strength(self, rows: NDArray[np.intp], like: Array) -> Array:
        """(k, 1) C of some problems."""
        return _like(self.strength[rows][:, None], like)

    @cached_property
    def _wide_axes(self) -> Array:
        return _as(self.site.axes, "float64")

    @cached_property
    def _turned_mean(self) -> Array:
        """(F, D) float32: the training sets' means along the axes."""
        return _as(self.site.sets.mean @ self._wide_axes, "float32")

    @cached_property
    def _square_scale(self) -> Array:
        return _as(self.site.sets.scale**2, "float32")

    @cached_property
    def _penalty_diagonal(self) -> Array:
        """(F, D) float32: the diagonal of axesᵀ · diag(scale²) · axes."""
        return _as(self.site.sets.scale**2 @ self._wide_axes**2, "float32") + np.finfo(np.float32).tiny

    @cached_property
    def _divisor(self) -> Array:
        """(F, D) the training sets' scales; 1 for a feature that never varies, whose gradient is 0."""
        xp = array_namespace(self.site.scale)
        return xp.where(xp.isinf(self.site.scale), 1.0, self.site.sets.scale)


def _as(array: Array, dtype: str) -> Array:
    xp = array_namespace(array)
    return xp.asarray(array, dtype=getattr(xp, dtype))


def _like(array: NDArray[Any], like: Array) -> Array:
    return array_namespace(like).asarray(array, dtype=like.dtype, device=like.device)


def _losses(margins: Array) -> tuple[Array, Array, Array]:
    """log(1 + exp(−m)), its negative slope and its curvature."""
    xp = array_namespace(margins)
    small = xp.exp(-abs(margins))
    slope = xp.where(margins > 0, small, xp.ones_like(small)) / (1 + small)
    return xp.log1p(small) + (-margins).clip(0.0), slope, small / (1 + small) ** 2
