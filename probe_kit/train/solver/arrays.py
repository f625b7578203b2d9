"""Arrays of numpy and torch, rows of large ones, and their standardisation."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.machine import check_device_name, what_is_here
from probe_kit.errors import MissingExtraError, UsageError

if TYPE_CHECKING:
    import torch


Array = Any
"""A numpy array, or a torch tensor on any device."""


def array_namespace(array: Array) -> Any:
    """Return the module that made `array`: numpy or torch."""
    return np if isinstance(array, np.ndarray) else import_module("torch")


def to_device(array: NDArray[Any], device: "str | torch.device | None") -> Array:
    """Return `array` as a torch tensor on `device`, or as it is without one."""
    if device is None:
        return array
    import torch

    # Of an array of a run, or out of Ray's memory, which may not be written to, `as_tensor` warns.
    return torch.as_tensor(array if array.flags.writeable else array.copy(), device=device)


def to_device_of(like: Array, array: NDArray[Any]) -> Array:
    """Return `array` on the device of `like`, and made by the same module."""
    return array if isinstance(like, np.ndarray) else to_device(array, like.device)


def to_numpy(array: Array) -> NDArray[Any]:
    """Return `array` as a numpy array in this machine's memory."""
    return array if isinstance(array, np.ndarray) else np.asarray(array.cpu())


def check_device(device: str | None) -> None:
    """Raise an error for a device that torch cannot use; None is always accepted.

    Raises:
        MissingExtraError: For a device without torch.
        UsageError: For a device that torch does not know or see.
    """
    if device is None:
        return
    check_device_name(device)
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"device {device!r} needs torch. Install it, or leave `device` out.") from error
    try:
        torch.zeros(1, dtype=torch.float64, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:  # what torch raises: unknown, absent, no float64
        reason = str(error).partition("\n")[0]
        raise UsageError(
            f"device {device!r} cannot be used: {reason}. {what_is_here()}; or leave `device` out"
        ) from error


def keep_freed_memory() -> None:
    """Have glibc keep up to 64 MB of freed memory for the next arrays, instead of returning it to the system.

    It sets this limit by the largest block, up to 32 MB, that was ever freed. Arrays of some megabytes that come
    and go with every step are otherwise mapped anew each time. Costs nothing: the block is never touched.
    """
    np.empty(2**25 - 2**16, np.uint8)  # below 32 MB, with what glibc adds to a block


WORTH_THREADS = 2**18
"""Size N · min(N, D) of features from which on several threads of BLAS gain more than they wait for another."""


@contextmanager
def threads_for(features: "Features") -> Iterator[None]:
    """Let BLAS compute in one thread here, unless products of (N, D) features are worth several."""
    count, width = features.shape
    limit = None if count * min(count, width) >= WORTH_THREADS else 1
    with _thread_pools(len(sys.modules)).limit(limits=limit, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _thread_pools(modules: int) -> Any:
    """Return the control of the libraries that have threads, while no more `modules` are imported.

    It looks for them among all libraries of the process, which takes some milliseconds beside torch and lerobot.
    """
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

    del modules
    return ThreadpoolController()


# -- rows of large arrays ------------------------------------------------------------------------------------

ROWS_PER_BLOCK = 2048
"""Rows of a block: 32 MB of float64 at a width of 2,048."""


@dataclass(frozen=True)
class RowSubset:
    """The `rows` (N,) of `matrix` (M, D), numpy or torch. Indexing selects among them, without a copy."""

    matrix: Array
    rows: NDArray[np.intp]

    @classmethod
    def all(cls, matrix: Array) -> "RowSubset":
        """Return every row."""
        return cls(matrix, np.arange(len(matrix)))

    @property
    def shape(self) -> tuple[int, int]:
        """The shape (N, D)."""
        return len(self.rows), self.matrix.shape[1]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, rows: NDArray[np.intp]) -> "RowSubset":
        return RowSubset(self.matrix, self.rows[rows])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(to_numpy(self.read()), dtype)

    def read(self) -> Array:
        """Return the rows (N, D), copied."""
        return self.matrix[self.rows]

    def blocks(self) -> Iterator[Array]:
        """Yield all rows in order, ROWS_PER_BLOCK at a time, each block a copy."""
        for start in range(0, len(self), ROWS_PER_BLOCK):
            yield self.matrix[self.rows[start : start + ROWS_PER_BLOCK]]

    def to(self, device: str | None) -> "RowSubset":
        """Return the same with the matrix as a torch tensor on `device`; unchanged without one."""
        return RowSubset(to_device(self.matrix, device), self.rows)


Features = Array | RowSubset
"""Features (N, D) in memory, or rows that are visited block by block."""


def blocks_of(features: Features) -> Iterator[Array]:
    """Return the rows of `features` in blocks; an array is one block, itself."""
    return features.blocks() if isinstance(features, RowSubset) else iter([features])


def module_of(features: Features) -> Any:
    """Return the module that holds `features`: numpy or torch."""
    return array_namespace(features.matrix if isinstance(features, RowSubset) else features)


# -- standardisation -----------------------------------------------------------------------------------------


class Moments(NamedTuple):
    """The moments of D features, (D,) float64 each.

    Attributes:
        mean: Mean of every feature.
        scale: Standard deviation of every feature.
        rounding: Rounding of the mean in the stored type of the features, at least one unit in the last place.
    """

    mean: Array
    scale: Array
    rounding: Array

    @classmethod
    def of(cls, features: Features) -> "Moments":
        """Return the moments of (N, D) samples.

        Sums are of differences from the first sample in float64. A feature that never varies has deviation 0, and
        a variation that is small against its offset is exact.
        """
        xp, count = module_of(features), len(features)
        first = xp.asarray(next(blocks_of(features))[0], dtype=xp.float64)
        shift = sum((block - first).sum(axis=0) for block in blocks_of(features)) / count
        mean = first + shift
        scale = xp.sqrt(sum(xp.square(block - first - shift).sum(axis=0) for block in blocks_of(features)) / count)
        return cls(mean, scale, xp.finfo(next(blocks_of(features)).dtype).eps * abs(mean))


@dataclass(frozen=True)
class Standardiser:
    """The mean and scale of every feature that varies, learned on training samples only.

    Attributes:
        varies: (D,) bool, features with non-zero variance.
        mean: (V,) float64 mean of these V features.
        scale: (V,) float64 standard deviation of these V features.
    """

    varies: Array
    mean: Array
    scale: Array

    @classmethod
    def fit(cls, features: Features) -> "Standardiser":
        """Learn from (N, D) training samples.

        A feature counts as constant when its deviation is within the rounding of its own mean: about one unit in
        the last place of the stored type.
        """
        mean, scale, rounding = Moments.of(features)
        # Divided by a deviation that is rounding, a constant feature would become noise of size 1.
        varies = scale > rounding
        return cls(varies, mean[varies], scale[varies])

    def __call__(self, features: Array) -> Array:
        """Return (N, D) samples as (N, V) float64 with the training samples' mean 0 and deviation 1."""
        samples = features[:, self.varies] - self.mean
        samples /= self.scale
        return samples
