"""Reading of the row store: the activations of one episode, and tokens by role."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.errors import ChunkNotFoundError

from probe_kit.errors import RunDamagedError
from probe_kit.hooks.contract.sites import PADDING, plays
from probe_kit.runs.arrays import decode_bfloat16

Spans = Sequence[tuple[str, int, int]]
_BLOCK_BYTES = 1 << 24
"""Rows that are read in order come this many bytes at a time: beginning a request takes longer than reading."""
_DAMAGE = (ChunkNotFoundError, ValueError, RuntimeError)
"""What Zarr and its codecs raise for missing and for changed bytes."""


@dataclass(frozen=True)
class Rows:
    """An array with one row per planned episode, seen through the committed ones.

    numbers: the plan's number of every committed episode, in order.
    """

    array: "zarr.Array[Any]"
    numbers: Sequence[int]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, position: int) -> NDArray[Any]:
        """All of one episode."""
        return self.read(position, ())

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """All of every episode, in order, as `between`."""
        return self.between(0, len(self))

    def between(self, start: int, stop: int) -> Iterator[NDArray[Any]]:
        """All of the episodes from `start` up to `stop`, in order; several are read at a time.

        Raises RunDamagedError at a damaged one.
        """
        per_row = math.prod(self.array.shape[1:]) * self.array.dtype.itemsize
        size = max(1, _BLOCK_BYTES // max(1, per_row))
        for first in range(start, stop, size):
            yield from self._block(range(first, min(first + size, stop)))

    def _block(self, positions: range) -> Iterator[NDArray[Any]]:
        try:
            numbers = [self.numbers[position] for position in positions]
            # Of an array with much room, a slice is quick; other indexing makes a table of all its chunks.
            consecutive = numbers == list(range(numbers[0], numbers[0] + len(numbers)))
            block = np.asarray(
                self.array[numbers[0] : numbers[-1] + 1] if consecutive else self.array.oindex[np.array(numbers)]
            )
        except (*_DAMAGE, RunDamagedError):
            yield from (self[position] for position in positions)  # up to the damaged one, which is then named
        else:
            yield from block

    def read(self, position: int, index: tuple[Any, ...]) -> NDArray[Any]:
        """Part of one episode. Raises RunDamagedError if bytes are missing or fail their checksum."""
        number = self.numbers[position]
        try:
            return np.asarray(self.array[(number, *index)])
        except _DAMAGE as error:
            raise RunDamagedError(
                f"{self.array.path or self.array.name} of episode {number} cannot be read: {error}. Delete "
                f"commits/{number:08d}.json and run the same `probe-kit extract` again to redo the episode"
            ) from error


@dataclass(frozen=True)
class TokenBlock:
    """Tokens `start` up to `start + T` of one site: values (E, T, D) float32 and mask (E, T) bool.

    Values outside the mask are zero.
    """

    start: int
    values: NDArray[np.float32]
    mask: NDArray[np.bool_]


def role_mask(spans: Sequence[Spans], tokens: int, role: str | None) -> NDArray[np.bool_]:
    """(E, tokens) bool: positions of `role`, or of all but padding, from one sequence of spans per episode."""
    mask = np.zeros((len(spans), tokens), bool)
    for row, episode in enumerate(spans):
        for name, start, stop in episode:
            mask[row, start:stop] = name != PADDING if role is None else plays(name, role)
    return mask


def token_blocks(rows: Rows, at: tuple[int, ...], mask: NDArray[np.bool_], block: int) -> Iterator[TokenBlock]:
    """Blocks of `block` tokens at `at` (call, [iteration,] layer); a block that `mask` never touches is left out.

    Reads only the inner chunks it needs, one block of all episodes at a time.
    """
    for start in range(0, mask.shape[1], block):
        block_mask = mask[:, start : start + block]
        if not block_mask.any():
            continue
        values = np.zeros((*block_mask.shape, rows.array.shape[-1]), np.float32)
        for position in np.flatnonzero(block_mask.any(axis=1)):
            bits = rows.read(position, (*at, slice(start, start + block)))
            # Not a product: padding may hold NaN or infinity, and NaN times 0 is NaN.
            values[position] = np.where(block_mask[position, :, None], decode_bfloat16(bits), 0)
        yield TokenBlock(start, values, block_mask)
