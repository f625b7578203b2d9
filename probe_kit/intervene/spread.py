"""Displacement toward the source's action, in spreads of clean actions. Needs no model.

Numbers of the actions without spread are left out.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FLAT = 1e-6
"""Share of a number's size below which its spread is rounding."""


def spread_of(clean: NDArray[np.float32]) -> Array:
    """Return (N,) 1 / variance of every number of the clean actions (E, N); 0 for numbers without spread."""
    values = np.ascontiguousarray(clean, np.float64)
    variance = values.var(axis=0)
    varies = np.sqrt(variance) > _FLAT * np.maximum(np.abs(values).max(axis=0, initial=0.0), _FLAT)
    return np.where(varies, 1 / np.where(varies, variance, 1.0), 0.0)


def directions_of(clean: Array, source: Array, weights: Array) -> tuple[Array, Array]:
    """Return (E, N) the directions that displacements are read along, and (E,) the sources' own displacements.

    clean, source: (E, N). A displacement of x is (x − clean) · direction: its component toward the source, in root
    mean squares of spreads. Zero where the source changes nothing.
    """
    apart = source - clean
    count = max(int((weights > 0).sum()), 1)
    squares = (apart**2 * weights).sum(axis=1) / count
    lengths = np.sqrt(squares)
    scale = np.where(lengths > 0, 1 / np.where(lengths > 0, lengths, 1.0), 0.0)
    return apart * weights / count * scale[:, None], lengths


def displacements_toward(chunks: NDArray[np.float32], source: int, clean: int = 0) -> Array:
    """Return (K, E) displacements toward the source's action of K conditions. chunks: (K, E, N)."""
    values = np.ascontiguousarray(chunks, np.float64)  # sums are rounded by how an array lies
    weights = spread_of(chunks[clean])
    directions, _ = directions_of(values[clean], values[source], weights)
    return np.asarray(((values - values[clean]) * directions).sum(axis=2))


def sizes(chunks: NDArray[np.float32], clean: int = 0) -> Array:
    """Return (K, E) the distance of K conditions' actions from clean ones, in root mean squares of spreads."""
    values = np.ascontiguousarray(chunks, np.float64)  # sums are rounded by how an array lies
    weights = spread_of(chunks[clean])
    count = max(int((weights > 0).sum()), 1)
    return np.asarray(np.sqrt(((values - values[clean]) ** 2 * weights).sum(axis=2) / count))
