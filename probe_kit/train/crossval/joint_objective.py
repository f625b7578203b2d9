"""Logistic regressions of several training sets of one site, solved together by Newton's method.

The training sets share large matrix products. The objective is that of `solver.logistic`. Steps are found by
conjugate gradients in float32, which halves their time. Far from the optimum the gradient is float32 too; near it
the gradient is float64, on the exact data. A solution is accepted only when this exact gradient is below the
tolerance. So float32 decides how a solution is found, never what it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeNotConvergedError
from probe_kit.train.crossval.nested_folds import NestedFold
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Array, Moments, RowSubset, array_namespace, to_numpy
from probe_kit.train.solver.design_matrix import narrow_axes

# -- the site ------------------------------------------------------------------------------------------------

ROWS_PER_BLOCK = 512
"""Rows of a block: 8 MB of float64 at a width of 2,048. It is used twice, so it should stay in the cache."""

ROWS_PER_PRODUCT = 8192
"""Rows multiplied with themselves at once: products of fewer are slower, float32 sums over more less exact."""

LEAST_SCALE = 0.1
"""Deviation in a training set, as a share of the site's, below which its probes need axes of their own."""


@dataclass(frozen=True)
class Block:
    """A slice of consecutive rows of a site, all of episodes that the same outer fold tests.

    Attributes:
        rows: B rows of the site, as a slice.
        episode: (B,) episode of every row.
        outer: Number of the outer fold that tests them.
    """

    rows: slice
    episode: NDArray[np.intp]
    outer: int


@dataclass(frozen=True)
class TrainingSets:
    """The F sets of episodes on which probes are trained: of every inner fold, then of every outer one.

    Attributes:
        member: (F, E) float32, 1 where an episode belongs to a set.
        outer: (F,) the outer fold each belongs to, of whose test episodes it has none.
        counts: (F,) number of samples.
        mean: (F, D) float64 means that standardise a set, measured from the site's mean in units of its scale.
        scale: (F, D) float64 scales that standardise a set, in units of the site's scale.
    """

    member: NDArray[np.float32]
    outer: NDArray[np.intp]
    counts: NDArray[np.float64]
    mean: Array
    scale: Array


@dataclass(frozen=True)
class JointSite:
    """The M samples of E episodes, standardised by the site's own mean and scale and sorted by outer fold.

    Attributes:
        features: (M, D) raw rows in this order.
        blocks: Blocks that cover all rows.
        mean: (D,) float64 mean of every feature.
        scale: (D,) float64 deviation of every feature; infinite for a feature that never varies.
        unclear: Whether any feature is so near to never varying that training sets may disagree on it.
        sets: The training sets of all folds.
        axes: (D, D) float32, principal axes of the standardised samples.
        variances: (D,) squared lengths along them.
        turned: (M, D) float32, standardised samples along the axes: they shape steps, never a gradient that
            decides about acceptance.
    """

    features: RowSubset
    blocks: tuple[Block, ...]
    mean: Array
    scale: Array
    unclear: bool
    sets: TrainingSets
    axes: Array
    variances: Array
    turned: Array

    @classmethod
    def of(cls, samples: Samples, folds: Sequence[NestedFold]) -> "JointSite":
        """Return the site of `samples`.

        It takes the memory of their copy in float32, of some (D, D) matrices, and of a block in float64.
        """
        features, blocks = _sort_rows(samples, folds)
        xp = array_namespace(features.matrix)
        mean, scale, rounding = Moments.of(features)
        unclear = bool(((scale > 0.25 * rounding) & (scale < 4 * rounding)).any())
        scale[scale <= rounding] = np.inf
        turned = xp.empty(features.shape, dtype=xp.float32, device=mean.device)
        member = np.zeros((len(training_sets(folds)), len(samples.counts)))
        for number, members in enumerate(training_sets(folds)):
            member[number, members] = 1
        sums, squares = 0.0, 0.0
        for block in blocks:
            exact = (features.matrix[features.rows[block.rows]] - mean) / scale
            turned[block.rows] = exact
            of_block = xp.asarray(member[:, block.episode], device=mean.device)
            sums, squares = sums + of_block @ exact, squares + of_block @ exact**2
        counts = member @ samples.counts
        size = xp.asarray(counts, device=mean.device)[:, None]
        set_mean = sums / size
        set_scale = xp.sqrt((squares / size - set_mean**2).clip(0.0))
        axes, variances = narrow_axes(_products(turned)), xp.zeros_like(mean)
        for block in blocks:
            turned[block.rows] = turned[block.rows] @ axes
            variances += xp.square(turned[block.rows]).sum(axis=0)
        outer = np.append(np.repeat(np.arange(len(folds)), [len(f.inner) for f in folds]), np.arange(len(folds)))
        sets = TrainingSets(member.astype(np.float32), outer, counts, set_mean, set_scale)
        return cls(features, blocks, mean, scale, unclear, sets, axes, variances, turned)

    @property
    def alike(self) -> bool:
        """Whether all training sets drop the site's constant features only, and scale the others about as it does.

        Only then do the site's axes fit them.
        """
        varies = np.isfinite(to_numpy(self.scale))
        return not self.unclear and bool((to_numpy(self.sets.scale)[:, varies] > LEAST_SCALE).all())

    def centred(self, block: Block) -> Array:
        """Return the block's raw rows without the site's mean, (B, D) float64."""
        return self.features.matrix[self.features.rows[block.rows]] - self.mean


def _products(rows: Array) -> Array:
    """Return the moments (D, D) of rows (M, D) in float32.

    They precondition only, so float32 is sufficient, in half the time.
    """
    parts = (rows[start : start + ROWS_PER_PRODUCT] for start in range(0, len(rows), ROWS_PER_PRODUCT))
    return sum(part.T @ part for part in parts)


def training_sets(folds: Sequence[NestedFold]) -> list[NDArray[np.intp]]:
    """Return the episodes of every inner fold's training set, then of every outer one's."""
    return [inner.train for fold in folds for inner in fold.inner] + [fold.outer.train for fold in folds]


def _sort_rows(samples: Samples, folds: Sequence[NestedFold]) -> tuple[RowSubset, tuple[Block, ...]]:
    """Return rows and blocks, in which the episodes that an outer fold tests are together."""
    rows = samples.features if isinstance(samples.features, RowSubset) else RowSubset.all(samples.features)
    order = np.concatenate([fold.outer.test for fold in folds])
    sorted_ = Samples(rows, samples.counts, samples.means).of(order)
    assert isinstance(sorted_.features, RowSubset)
    episode = np.repeat(order, sorted_.counts)
    ends = np.cumsum([0, *(samples.counts[fold.outer.test].sum() for fold in folds)]).tolist()
    spans = [
        (fold, slice(start, min(start + ROWS_PER_BLOCK, end)))
        for fold, (first, end) in enumerate(pairwise(ends))
        for start in range(first, end, ROWS_PER_BLOCK)
    ]
    return sorted_.features, tuple(Block(rows, episode[rows], fold) for fold, rows in spans)


# -- the objective -------------------------------------------------------------------------------------------

TOLERANCE = 1e-9
"""Relative gradient of a solution: it is accepted when ‖gradient‖ ≤ TOLERANCE · ‖w‖, in float64."""
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

    Attributes:
        value: (k,) C · Σ loss + penalty.
        gradient: (k, R) derivative by weights along axes, float64.
        size: (k,) norm of the gradient as scikit-learn's objective has it.
        length: (k,) norm of the weights as scikit-learn's objective has it.
        curvature: (k, …) curvature of every sample's loss, which products with the Hessian need.
    """

    value: Array
    gradient: Array
    size: Array
    length: Array
    curvature: Array

    @property
    def relative(self) -> Array:
        """The size of the gradient in units of the weights, (k,)."""
        larger = array_namespace(self.size).maximum(self.length, self.size)
        return self.size / larger.clip(TINY)

    def only(self, mask: NDArray[np.bool_]) -> "NewtonState":
        """Return the state of some of the problems."""
        return self if mask.all() else NewtonState(*(part[mask] for part in vars(self).values()))

    def replace(self, mask: NDArray[np.bool_], states: "NewtonState") -> None:
        """Replace the state of some of the problems by `states`."""
        for part, other in zip(vars(self).values(), vars(states).values(), strict=True):
            part[mask] = other


Inside = Callable[[Array, Block, NDArray[np.intp]], Array]
"""Function between a product with the samples and one with their transpose, (k, B).

It takes decisions (k, B), their block, and the problems that they belong to."""


@dataclass(frozen=True)
class JointProblems:
    """The K logistic problems on one site.

    Weights are rows (D + 1): v on features as the site standardises them, and the intercept b. The decision about
    a sample x is f = x·v − mean·v + b. The penalty is ½‖scale ∘ v‖²: scale ∘ v are the weights on features as the
    training set standardises them.

    Steps, and rough weights, are rows (D + 1) along the site's axes: u with v = axes · u, and b. Exact weights are
    never turned. A turn's rounding in float64 would return times the curvature along the first axis. With 80,000
    samples that is more than a gradient of 1e-9 of the weights.

    Rows that the outer fold of a set tests are left out of its products. Rows that only an inner fold tests are
    masked, which wastes a quarter of the products.

    Attributes:
        site: Samples and training sets.
        set_of: (K,) training set of every problem.
        signs: (K, E) labels −1/+1 of the episodes.
        strength: (K,) C of every problem.
    """

    site: JointSite
    set_of: NDArray[np.intp]
    signs: NDArray[np.int8]
    strength: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.set_of)

    def rounding(self, rows: NDArray[np.intp]) -> Array:
        """Return the size (k,) of a gradient that is all rounding, in float64."""
        scale = 1e-15 * self.site.sets.counts.max() * self.site.turned.shape[1] ** 0.5
        return scale * self._strength(rows, self.site.mean)[:, 0]

    def point(self, weights: Array, rows: NDArray[np.intp], *, exact: bool) -> NewtonState:
        """Return the objective of problems at some weights.

        Args:
            weights: (k, D + 1) weights: on features if `exact`, else along axes.
            rows: (k,) numbers of the problems.
            exact: Whether products are float64; else they are float32.
        """
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
        """Return the Hessian times `directions` (k, D + 1), by a point's curvature; all float32."""
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
        """Return about the Hessian's diagonal, (k, D + 1) float32: as if all samples were curved alike."""
        xp = array_namespace(curvature)
        weight = self._strength(rows, curvature) * curvature.sum(axis=1)[:, None]
        share = xp.asarray(self.site.variances / len(self.site.features), dtype=xp.float32)
        return xp.hstack([self._penalty_diagonal[self.set_of[rows]] + weight * share, weight])

    def exact_step(self, gradient: Array, curvature: Array, row: int) -> Array:
        """Return the Newton step (D + 1,) of one problem, by its whole Hessian."""
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
        """Return weights on features (k, D + 1) as weights along axes."""
        return array_namespace(weights).hstack([weights[:, :-1] @ self._wide_axes, weights[:, -1:]])

    def turned_back(self, weights: Array) -> Array:
        """Return weights along axes (k, D + 1) as weights on features."""
        return array_namespace(weights).hstack([weights[:, :-1] @ self._wide_axes.T, weights[:, -1:]])

    def raw(self, weights: Array) -> tuple[Array, Array]:
        """Return weights (K, D) and intercepts (K,) on raw features."""
        v = weights[:, :-1]
        raw = v / self.site.scale
        shift = weights[:, -1] - (self.site.sets.mean[self.set_of] * v).sum(axis=1)
        return raw, shift - raw @ self.site.mean

    def decisions(self, weights: Array, samples: Array) -> Array:
        """Return the decisions (K, n) on other samples (n, D)."""
        v = weights[:, :-1]
        shift = weights[:, -1] - (self.site.sets.mean[self.set_of] * v).sum(axis=1)
        return (v / self.site.scale) @ (samples - self.site.mean).T + shift[:, None]

    def deviations(self, weights: Array) -> Array:
        """Return the deviation of every problem's decisions over its training samples, (K,)."""
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
        """Return Σ inside(f)·x (k, D) and Σ inside(f) (k,) over samples x, with f = vectors·x + shift.

        With float64 vectors x are raw samples without the site's mean, with float32 ones samples along the axes.
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
        """Return (k, B) the label −1/+1 of every sample, and 1 where its episode belongs to the training set."""
        signs = self.signs[np.ix_(rows, block.episode)]
        member = self.site.sets.member[:, block.episode][self.set_of[rows]]
        return _like(signs, like), _like(member, like)

    def _strength(self, rows: NDArray[np.intp], like: Array) -> Array:
        """Return the C of some problems, (k, 1)."""
        return _like(self.strength[rows][:, None], like)

    @cached_property
    def _wide_axes(self) -> Array:
        return _as(self.site.axes, "float64")

    @cached_property
    def _turned_mean(self) -> Array:
        """The training sets' means along the axes, (F, D) float32."""
        return _as(self.site.sets.mean @ self._wide_axes, "float32")

    @cached_property
    def _square_scale(self) -> Array:
        return _as(self.site.sets.scale**2, "float32")

    @cached_property
    def _penalty_diagonal(self) -> Array:
        """The diagonal of axesᵀ · diag(scale²) · axes, (F, D) float32."""
        return _as(self.site.sets.scale**2 @ self._wide_axes**2, "float32") + np.finfo(np.float32).tiny

    @cached_property
    def _divisor(self) -> Array:
        """The training sets' scales (F, D); 1 for a feature that never varies, whose gradient is 0."""
        xp = array_namespace(self.site.scale)
        return xp.where(xp.isinf(self.site.scale), 1.0, self.site.sets.scale)


def _as(array: Array, dtype: str) -> Array:
    xp = array_namespace(array)
    return xp.asarray(array, dtype=getattr(xp, dtype))


def _like(array: NDArray[Any], like: Array) -> Array:
    return array_namespace(like).asarray(array, dtype=like.dtype, device=like.device)


def _losses(margins: Array) -> tuple[Array, Array, Array]:
    """Return log(1 + exp(−m)) of margins m, its negative slope and its curvature."""
    xp = array_namespace(margins)
    small = xp.exp(-abs(margins))
    slope = xp.where(margins > 0, small, xp.ones_like(small)) / (1 + small)
    return xp.log1p(small) + (-margins).clip(0.0), slope, small / (1 + small) ** 2


def solve(problems: JointProblems, start: Array) -> Array:
    """Return the optimal weights (K, R) of all problems, found from `start` (K, R).

    Raises:
        ProbeNotConvergedError: If a problem is not at its optimum after the last step.
    """
    search = _NewtonSolver(problems)
    return search.refined(problems.turned_back(search.rough(problems.turned(start))))


@dataclass(frozen=True)
class _NewtonSolver:
    problems: JointProblems

    def rough(self, start: Array) -> Array:
        """Return turned weights near the optimum, found from `start` in float32; the last step is not checked."""
        solved, rows, weights = start + 0.0, np.arange(len(start)), start
        point = self.problems.point(weights, rows, exact=False)
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
            weights, point = self._move(weights, point, rows, step, slope, exact=False)
            solved[rows] = weights
        return solved

    def refined(self, start: Array) -> Array:
        """Return the weights at the optimum, found from `start` and certified by float64 gradients."""
        solved, rows, weights = array_namespace(start).empty_like(start), np.arange(len(start)), start
        point = self.problems.point(weights, rows, exact=True)
        for _ in range(MAX_NEWTON_STEPS):
            # Negated, so that NaN stays open and ends in an error.
            open_ = to_numpy(~((point.relative <= TOLERANCE) | (point.size <= self.problems.rounding(rows))))
            solved[rows[~open_]] = weights[~open_]
            if not open_.any():
                return solved
            rows, weights, point = rows[open_], weights[open_], point.only(open_)
            step = self._newton_step(point, rows)
            slope = (point.gradient * step).sum(axis=1)
            weights, point = self._move(weights, point, rows, self.problems.turned_back(step), slope, exact=True)
        strength = self.problems.strength[rows]
        raise ProbeNotConvergedError(
            f"{len(rows)} of {len(self.problems)} logistic problems (C from {strength.min():g} to "
            f"{strength.max():g}) are not at their optimum after {MAX_NEWTON_STEPS} Newton steps: worst relative "
            f"gradient {float(point.relative.max()):.1e}, expected at most {TOLERANCE:.0e}. Look for extreme "
            "feature values."
        )

    def _move(
        self, weights: Array, point: NewtonState, rows: Rows, step: Array, slope: Array, *, exact: bool
    ) -> tuple[Array, NewtonState]:
        """Return weights and state after one step, halved per problem until the objective falls enough.

        Args:
            weights: (k, D + 1) weights of the problems.
            point: State of the problems at these weights.
            rows: (k,) numbers of the problems.
            step: (k, D + 1) step, in the coordinates of `weights`.
            slope: (k,) slope of the objective along the step.
            exact: As in `JointProblems.point`.
        """
        length = array_namespace(step).ones_like(slope)
        noise = (1e-11 if exact else 1e-6) * abs(point.value)
        moved = weights + step
        state = self.problems.point(moved, rows, exact=exact)
        for _ in range(MAX_HALVINGS):
            too_far = to_numpy(state.value > point.value + 1e-4 * length * slope + noise)
            if not too_far.any():
                break
            length[too_far] /= 2
            moved[too_far] = weights[too_far] + length[too_far, None] * step[too_far]
            state.replace(too_far, self.problems.point(moved[too_far], rows[too_far], exact=exact))
        return moved, state

    def _newton_step(self, point: NewtonState, rows: Rows) -> Array:
        """Return Hessian⁻¹ · −gradient, (k, R) float64, as precisely as the point is worth.

        Problems that conjugate gradients do not settle in time are solved by factorising.
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
    """Return the share of the gradient that a step may leave, (k,): a more precise step would be wasted."""
    relative = point.relative
    return array_namespace(relative).maximum(relative.clip(1e-4, 0.1), 0.5 * TOLERANCE / relative)
