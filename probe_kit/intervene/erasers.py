"""Erasing the linearly decodable part of an answer, token by token: LEACE, INLP and class-mean differences.

LEACE: Belrose, Schneider-Joseph, Ravfogel, Cotterell, Raff, Biderman: LEACE: Perfect linear concept erasure in
closed form, NeurIPS 2023. INLP: Ravfogel, Elazar, Gonen, Twiton, Goldberg: Null it out, ACL 2020. Both are written
anew from the papers' formulas, for one binary answer, fewer episodes than dimensions, and one eraser per position.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.table_cells import is_count
from probe_kit._system.types import Matrix
from probe_kit.errors import NoDirectionError, UsageError

Way = Literal["leace", "mean-difference", "inlp"]
WAYS: tuple[Way, ...] = get_args(Way)
RANK = 5
"""Default number of directions that are removed where several can be; beyond, controls break as well."""
FEWEST = 4
"""Episodes of either answer that a position must have in training; with fewer it is left as it is."""
_TINY = 1e-10
"""Relative size of float64 sums below which a number is rounding."""
NO_DIRECTION = (
    "the class means of left and right are equal, as before a layer combines picture and instruction; choose "
    "later --sites or other --roles (to patch whole tokens only: --direction none)"
)
"""Reason, for messages, why an answer has no direction."""


@dataclass(frozen=True)
class Method:
    """A way to erase an answer.

    Attributes:
        way: Name of the way.
        rank: Number of directions per token, always 1 for `leace`, which needs no more.
    """

    way: Way = "leace"
    rank: int = 1

    @classmethod
    def of(cls, text: str) -> "Method":
        """Return the method of a name: `leace`, `mean-difference:K` or `inlp:K`.

        Raises:
            UsageError: For another name, or a number of directions that does not fit.
        """
        way, _, rank = text.partition(":")
        if way not in WAYS:
            raise UsageError(
                f"unknown way to erase {text!r}; expected leace, mean-difference:K or inlp:K, K directions each"
            )
        if way == "leace":
            if rank:
                raise UsageError("leace takes one direction per token, and no number; leave it out")
            return cls()
        if rank and not (is_count(rank) and int(rank) > 0):
            raise UsageError(f"{text!r}: expected a number of directions behind the colon, such as {way}:{RANK}")
        return cls(way, int(rank or RANK))

    def __str__(self) -> str:
        return self.way if self.way == "leace" else f"{self.way}:{self.rank}"


@dataclass(frozen=True)
class PaddedTokens:
    """Tokens of N episodes at T positions.

    Attributes:
        values: (N, T, D) tokens; any value where not present.
        present: (N, T) whether an episode has the position.
    """

    values: Matrix
    present: NDArray[np.bool_]

    def only(self, rows: NDArray[np.int64]) -> "PaddedTokens":
        """Return some of the episodes."""
        return PaddedTokens(self.values[rows], self.present[rows])

    def usable(self, is_left: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the positions (T,) at which either answer has `FEWEST` episodes."""
        counts = [self.present[is_left == side].sum(axis=0) for side in (True, False)]
        return np.asarray(np.minimum(*counts) >= FEWEST)

    def centred(self) -> "tuple[Matrix, Matrix]":
        """Return the tokens (N, T, D) minus their means (T, D) over the samples with the position, and the means.

        Both are zero at positions that no sample has.
        """
        mask = self.present[..., None]
        counts = np.maximum(mask.sum(axis=0), 1)
        means = np.where(mask, self.values, 0).sum(axis=0) / counts
        return np.where(mask, self.values - means, 0), means


@dataclass(frozen=True)
class Eraser:
    """An edit of tokens: x becomes x − Σ_k removed_k (read_k · (x − mean)), at every position of its own.

    All numbers are float64. Rounding to fewer digits leaves traces of the answer in a plane that is otherwise
    empty, where ordinary least squares find it.

    Attributes:
        means: (T, D) means of the training tokens.
        removed: (T, K, D) or, the same for all positions, (1, K, D) directions that are removed.
        read: (T, K, D) or (1, K, D) directions that read how much is removed.
        fitted: (T,) positions with enough episodes to fit on and a direction; the others are left as they are.
    """

    means: Matrix
    removed: Matrix
    read: Matrix
    fitted: NDArray[np.bool_]

    def __call__(self, values: Matrix) -> Matrix:
        """Return tokens (…, T, D) erased; T may be less than the number of positions that were fitted."""
        count = values.shape[-2]
        apart = np.where(self.fitted[:count, None], values - self.means[:count], 0.0)
        removed, read = (
            np.broadcast_to(directions, (self.fitted.size, *directions.shape[1:]))[:count]
            for directions in (self.removed, self.read)
        )
        change: Matrix = np.einsum("...tk,tkd->...td", np.einsum("...td,tkd->...tk", apart, read), removed)
        return np.asarray(values - change)


def fit_eraser(tokens: PaddedTokens, is_left: NDArray[np.bool_], method: Method) -> Eraser:
    """Fit the eraser of the answer to tokens.

    Args:
        tokens: Tokens of the training episodes.
        is_left: (N,) the answer: whether the correct picture lies left.
        method: Way to erase, with its number of directions.

    Raises:
        NoDirectionError: If no position has a direction.
        UsageError: If no position has enough episodes of either answer, or if there are fewer directions than the
            method's name says.
    """
    _check(tokens, is_left)
    centred, means = tokens.centred()
    usable = tokens.usable(is_left)
    _check_more(method, min(centred.shape[2], len(is_left)))
    if method.way == "leace":
        removed, read = _leace(centred, tokens.present, _answer(tokens, is_left), usable)
    elif method.way == "inlp":
        removed = read = _inlp(centred, tokens.present, is_left, usable, method.rank)
    else:
        size = float(np.abs(tokens.values[tokens.present]).max())
        removed = read = _shared_directions(
            _differences(centred, tokens.present, is_left)[usable], method.rank, size
        )
    ranks = (np.linalg.norm(removed, axis=-1) > 0).sum(axis=1)
    if not ranks.any():
        raise NoDirectionError(f"no direction for {method}: {NO_DIRECTION}")
    _check_more(method, int(ranks[ranks > 0].min()))
    return Eraser(means, removed, read, usable & (ranks > 0))


def fit_control(
    tokens: PaddedTokens, is_left: NDArray[np.bool_], method: Method, eraser: Eraser, draw: np.random.Generator
) -> Eraser:
    """Draw a control: an eraser of no answer, with as many random directions orthogonal to `eraser`.

    The directions have the data's covariance. For `leace`, a label drawn at random, uncorrelated with the answer,
    is erased in the same way.

    Args:
        tokens: Tokens of the training episodes.
        is_left: (N,) the answer: whether the correct picture lies left.
        method: Way to erase, with its number of directions.
        eraser: Eraser of the answer, fitted to the same tokens.
        draw: Generator of the draws.

    Raises:
        UsageError: If there is no room for as many directions orthogonal to `eraser`.
    """
    _check(tokens, is_left)
    centred, means = tokens.centred()
    usable = eraser.fitted
    if method.way == "leace":
        answer = _answer(tokens, is_left)
        # Without its part along the answer, so that erasing the label takes nothing of the answer with it.
        label = np.where(tokens.present, draw.normal(size=len(is_left))[:, None], 0.0)
        share = (label * answer).sum(axis=0) / np.maximum((answer**2).sum(axis=0), _TINY)
        label = np.where(tokens.present, label - share * answer, 0.0)
        counts = np.maximum(tokens.present.sum(axis=0), 1)
        label = np.where(tokens.present, label - label.sum(axis=0) / counts, 0.0)
        return Eraser(means, *_leace(centred, tokens.present, label, usable), usable)
    if method.way == "inlp":
        weights = draw.normal(size=(method.rank, len(is_left)))
        drawn = np.einsum("kn,ntd->tkd", weights, centred)
    else:
        weights = draw.normal(size=(method.rank, *centred.shape[:2]))
        drawn = np.einsum("knt,ntd->kd", weights, centred)[None]
    controls = np.stack(
        [_basis(directions, past=erased) for directions, erased in zip(drawn, eraser.removed, strict=True)]
    )
    fitted = usable if len(controls) == usable.size else slice(None)
    room = int((np.linalg.norm(controls[fitted], axis=-1) > 0).sum(axis=1).min())
    if room < method.rank:
        raise UsageError(
            f"{method} leaves room for {room} random directions beside it, of {centred.shape[2]} dimensions and "
            f"{len(is_left)} episodes; expected {method.rank}. Ask for fewer directions, or for --controls 0"
        )
    return Eraser(means, controls, controls, usable)


def ledoit_wolf(centred: Matrix) -> float:
    """Return in [0, 1] how far Ledoit and Wolf (2004) shrink the covariance of data (N, D) toward a sphere.

    It is computed from the (N, N) products of episodes: dimensions are many and episodes few.
    """
    count, width = centred.shape
    gram = centred @ centred.T
    squares = float((gram**2).sum()) / count**2
    mean = float(np.trace(gram)) / (count * width)
    spread = squares / width - mean**2
    noise = (float((np.diag(gram) ** 2).sum()) / count - squares) / (count * width)
    return 0.0 if spread <= 0 else float(np.clip(noise / spread, 0.0, 1.0))


def leace_direction(centred: Matrix, label: Matrix, shrinkage: float | None = None) -> tuple[Matrix, Matrix]:
    """Return the direction that LEACE removes for one label, and the one that reads it, both (D,).

    The eraser is P = removed · readᵀ, with P = Σ_xz (Σ_xzᵀ Σ⁻¹ Σ_xz)⁻¹ Σ_xzᵀ Σ⁻¹ of the covariances. Whatever the
    shrinkage, nothing correlated with the label is left in the data that it was fitted on. Without shrinkage, no
    other affine map that achieves this changes the data less.

    Args:
        centred: (N, D) data with mean 0.
        label: (N,) label with mean 0.
        shrinkage: Shrinkage in [0, 1]; None for `ledoit_wolf`.
    """
    amount = ledoit_wolf(centred) if shrinkage is None else shrinkage
    count, width = centred.shape
    along = centred.T @ label / count
    _, values, axes = np.linalg.svd(centred, full_matrices=False)
    variances = values**2 / count
    shrunk = (1 - amount) * variances + amount * variances.sum() / width
    varies = variances > _TINY * max(variances.max(initial=0.0), _TINY)
    read = axes[varies].T @ ((axes[varies] @ along) / shrunk[varies])
    if np.linalg.norm(along) <= _TINY * np.sqrt(variances.sum() * (label @ label) / count):
        return np.zeros(width), np.zeros(width)
    strength = float(along @ read)
    return (along, read / strength) if strength > 0 else (np.zeros(width), np.zeros(width))


def _check(tokens: PaddedTokens, is_left: NDArray[np.bool_]) -> None:
    if not tokens.usable(is_left).any():
        raise UsageError(
            f"no position has {FEWEST} episodes of either answer among {len(is_left)} to learn from; expected "
            "more items (leave --items out, or extract more)"
        )


def _check_more(method: Method, available: int) -> None:
    """Refuse a method with more directions than there are: its name states the number.

    Raises:
        UsageError: For more directions than the tokens have.
    """
    if method.rank > available:
        raise UsageError(
            f"{method} asks for {method.rank} directions, and these tokens have {available} to find; expected "
            f"{method.way}:{available} or fewer"
        )


def _answer(tokens: PaddedTokens, is_left: NDArray[np.bool_]) -> Matrix:
    """Return the answer (N, T) as ±½, centred at every position over the episodes that are present there."""
    values = np.where(tokens.present, is_left[:, None] - 0.5, 0.0)
    means = values.sum(axis=0) / np.maximum(tokens.present.sum(axis=0), 1)
    return np.where(tokens.present, values - means, 0.0)


def _rows(present: NDArray[np.bool_], usable: NDArray[np.bool_]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    for position in np.flatnonzero(usable):
        yield int(position), np.flatnonzero(present[:, position])


def _leace(
    centred: Matrix, present: NDArray[np.bool_], label: Matrix, usable: NDArray[np.bool_]
) -> tuple[Matrix, Matrix]:
    """Return the directions of `leace_direction` at every position, (T, 1, D) each, for labels (N, T)."""
    removed, read = (np.zeros((usable.size, 1, centred.shape[2])) for _ in range(2))
    for position, rows in _rows(present, usable):
        removed[position, 0], read[position, 0] = leace_direction(centred[rows, position], label[rows, position])
    return removed, read


def _inlp(
    centred: Matrix, present: NDArray[np.bool_], is_left: NDArray[np.bool_], usable: NDArray[np.bool_], rank: int
) -> Matrix:
    """Return directions (T, K, D): at every position, a probe's, then that of a probe without it, and so on."""
    from sklearn.linear_model import LogisticRegression

    directions = np.zeros((usable.size, rank, centred.shape[2]))
    for position, rows in _rows(present, usable):
        values = centred[rows, position]
        scale = float(values.std()) or 1.0
        for number in range(rank):
            past = directions[position, :number]
            residual = (values - (values @ past.T) @ past) / scale
            # scikit-learn's default penalty, on values of unit spread.
            weights = LogisticRegression(C=1.0, max_iter=200).fit(residual, is_left[rows]).coef_
            if np.linalg.norm(weights) <= _TINY:
                break
            directions[position, number] = _basis(weights, past=past)[0]
    return directions


def _differences(centred: Matrix, present: NDArray[np.bool_], is_left: NDArray[np.bool_]) -> Matrix:
    """Return the differences (T, D) between the means of either answer."""
    sums = [
        centred[is_left == side].sum(axis=0) / np.maximum(present[is_left == side].sum(axis=0), 1)[:, None]
        for side in (True, False)
    ]
    return np.asarray(sums[0] - sums[1])


def half_differences(tokens: PaddedTokens, is_left: NDArray[np.bool_], eraser: Eraser) -> Matrix:
    """Return (T, K) half the differences of class means along an eraser's shared directions, toward `left`.

    They are zero at the positions at which nothing was fitted.
    """
    centred, _ = tokens.centred()
    halves = _differences(centred, tokens.present, is_left) @ eraser.removed[0].T / 2
    return np.where(eraser.fitted[:, None], halves, 0.0)


def _shared_directions(differences: Matrix, rank: int, size: float) -> Matrix:
    """Return the directions (1, K, D) along which positions' differences (T, D) lie most, the same for all.

    Args:
        differences: (T, D) differences of class means by position.
        rank: Most directions.
        size: Size of the largest number whose differences these are.
    """
    _, values, axes = np.linalg.svd(differences, full_matrices=False)
    directions = axes[: min(rank, int((values > _TINY * max(values[0], size)).sum()))]
    return np.asarray(directions[None])


def _basis(directions: Matrix, past: Matrix) -> Matrix:
    """Return directions (K, D) without the span of `past` (J, D), orthonormal; zero where nothing is left."""
    past_units = [direction / np.linalg.norm(direction) for direction in past if np.linalg.norm(direction) > 0]
    units: list[Matrix] = []
    for direction in directions:
        length = float(np.linalg.norm(direction))
        for _ in range(2):  # once more for rounding
            for other in [*past_units, *units]:
                direction = direction - other * (other @ direction)
        remainder = float(np.linalg.norm(direction))
        units.append(direction / remainder if remainder > 1e-6 * length else np.zeros_like(direction))
    return np.array(units)
