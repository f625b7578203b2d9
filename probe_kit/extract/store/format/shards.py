"""Positions of the inner chunks of a shard, from the index that Zarr writes at the end of every shard."""

import numpy as np

ENTRY, CHECKSUM = 16, 4
"""Bytes: offset and length of a chunk as two uint64, and the crc32c that follows all entries."""
_ABSENT = (1 << 64) - 1


def index_bytes(count: int) -> int:
    """Length of the index of a shard of so many inner chunks."""
    return count * ENTRY + CHECKSUM


def chunk_slices(index: bytes) -> list[slice]:
    """Where every inner chunk lies in its shard, in the order of the index; an absent one is empty."""
    entries = np.frombuffer(index[:-CHECKSUM], "<u8").reshape(-1, 2)
    return [
        slice(0, 0) if start == _ABSENT else slice(start, start + length) for start, length in entries.tolist()
    ]


def inner_chunks(shard: bytes, count: int) -> list[slice]:
    """Where the `count` inner chunks of a whole shard lie, then where its index does."""
    index = slice(len(shard) - index_bytes(count), len(shard))
    return [*chunk_slices(shard[index]), index]
