"""The arrays of a run: shapes, chunks, codec, and where the inner chunks of a shard lie.

Arrays of tokens and of later inferences hold the bits of bfloat16 as uint16, because Zarr v3 has no bfloat16.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.abc.store import Store
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, ShardingCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer
from zarr.core.metadata import ArrayV3Metadata
from zarr.registry import register_codec

from probe_kit.errors import RunDamagedError
from probe_kit.runs.layout import LATER, MEAN_VIEW, LaterViews, StoredStream
from probe_kit.runs.location import MOST_OBJECT_BYTES

ENTRY, CHECKSUM = 16, 4
"""Bytes: offset and length of a chunk as two uint64, and the crc32c after all entries, in the
index that Zarr writes at the end of every shard."""
_RESTORE = "Restore the run from a copy, or extract it again"
_MOST_CHUNKS = 10_000_000
"""Of an array: ten times `ROOM`. Metadata that claims more was made up; reading by it would fill all memory."""
_ONE_AT_A_TIME = Lock()
_BLOSC_SIZE = slice(4, 8)
"""Place of the size, unpacked, in the header of a chunk that blosc wrote."""
_ABSENT = (1 << 64) - 1
"""Offset and length of an inner chunk that was never written, as Zarr's sharding has it."""
ROOM = 1_000_000
"""Episodes that an array has room for; one chunk holds one episode, and no chunk exists before its episode."""
NOT_A_NUMBER = 0x7FC0
"""Bits of bfloat16 where nothing was captured."""


def create_arrays(
    store: Store, streams: list[StoredStream], calls: int, with_tokens: bool, codec: str,
    later_views: LaterViews = "all",
) -> None:  # fmt: skip
    """Create every array with `ROOM` for episodes, so that metadata never changes; afterwards chunks are written.

    Pooled rows: float32 (episode, call, [iteration,] layer, view, feature), one chunk per episode, NaN where
    nothing was captured. Tokens: uint16, one shard per episode, inner chunks of one layer x 128 tokens. With
    later_views `mean`, pooled rows hold the first inference alone, and `later` that view of the others: uint16
    (episode, call, [iteration,] layer, feature), one chunk per episode, `NOT_A_NUMBER` where nothing was captured.
    """
    root = zarr.open_group(store, mode="w-", zarr_format=3)
    full = calls if later_views == "all" else 1
    for stream in streams:
        group = root.create_group(stream.name)
        pooled = (*stream.lead, len(stream.views), stream.width)
        group.create_array(
            "pooled",
            shape=(ROOM, full, *pooled),
            chunks=(1, full, *pooled),  # one object per episode, which its commit can name and hash
            dtype="float32",
            fill_value=np.nan,
            compressors=codecs(codec, typesize=4),
            dimension_names=("episode", "call", *stream.dimensions, "view", "feature"),
            attributes={"views": list(stream.views)},
            config={"write_empty_chunks": True},
        )
        if later_views == MEAN_VIEW:
            later = (*stream.lead, stream.width)
            group.create_array(
                LATER,
                shape=(ROOM, calls - 1, *later),
                chunks=(1, calls - 1, *later),
                dtype="uint16",
                fill_value=NOT_A_NUMBER,
                compressors=codecs(codec, typesize=2),
                dimension_names=("episode", "call", *stream.dimensions, "feature"),
                attributes={"probe_kit:dtype": "bfloat16", "view": MEAN_VIEW},
                config={"write_empty_chunks": True},
            )
        if with_tokens:
            tokens = (*stream.lead, stream.stored_tokens, stream.width)
            group.create_array(
                "tokens",
                shape=(ROOM, calls, *tokens),
                shards=(1, calls, *tokens),
                chunks=(1, 1, *(1 for _ in stream.lead), stream.token_block, stream.width),
                dtype="uint16",
                fill_value=0,
                compressors=codecs(codec, typesize=2),
                dimension_names=("episode", "call", *stream.dimensions, "token", "feature"),
                attributes={"probe_kit:dtype": "bfloat16", "tokens": stream.tokens},
                config={"write_empty_chunks": True},
            )


def codecs(name: str, typesize: int) -> list[BytesBytesCodec]:
    """Blosc, then a checksum. typesize: bytes of a number, which blosc shuffles before it compresses."""
    if name == "none":
        return [Crc32cCodec()]
    fast = name == "fast"
    blosc = BloscCodec(
        typesize=typesize,
        cname="lz4" if fast else "zstd",
        clevel=1,
        shuffle="bitshuffle" if fast else "shuffle",
        blocksize=524288,  # bytes; blosc's own choice at level 1 is small, and loses most of the gain
    )
    return [blosc, Crc32cCodec()]


def open_array(store: Store, name: str) -> zarr.Array[Any]:
    """Open one array for reading; a missing chunk is an error, never a fill value.

    Raises RunDamagedError for codecs, and for sizes, that probe_kit never writes.
    """
    with bounded_codecs():
        array = zarr.open_array(store, path=name, mode="r", zarr_format=3, config={"read_missing_chunks": False})
    check_bounds(array)
    return array


class BoundedBloscCodec(BloscCodec):
    """Blosc that unpacks a chunk of the array's own size alone, whatever size the chunk declares."""

    def _decode_sync(self, chunk_bytes: Buffer, chunk_spec: ArraySpec) -> Buffer:
        expected = math.prod(chunk_spec.shape) * chunk_spec.dtype.to_native_dtype().itemsize
        declared = int.from_bytes(chunk_bytes.as_numpy_array()[_BLOSC_SIZE].tobytes(), "little")
        if declared != expected:
            raise ValueError(f"a chunk of {expected:,} bytes unpacks to {declared:,}")
        return super()._decode_sync(chunk_bytes, chunk_spec)


register_codec("blosc", BoundedBloscCodec)  # chosen where `bounded_codecs` says so


@contextmanager
def bounded_codecs() -> Iterator[None]:
    """Give arrays that are opened inside codecs that unpack no more bytes than a chunk has."""
    # The configuration of zarr is one for all threads; another thread's end would set it back too early.
    name = f"{BoundedBloscCodec.__module__}.{BoundedBloscCodec.__qualname__}"
    with _ONE_AT_A_TIME, zarr.config.set({"codecs.blosc": name}):
        yield


def check_bounds(array: zarr.Array[Any]) -> None:
    """Raise RunDamagedError for an array that no run has: metadata of others may claim any shape and codec."""
    assert isinstance(array.metadata, ArrayV3Metadata), "it was opened as one"
    codecs = list(array.metadata.codecs)
    while codecs:
        codec = codecs.pop()
        if isinstance(codec, ShardingCodec):
            codecs += [*codec.codecs, *codec.index_codecs]
        elif not isinstance(codec, BytesCodec | BoundedBloscCodec | Crc32cCodec):
            raise RunDamagedError(f"{array.path} is stored by {type(codec).__name__}, which no run is. {_RESTORE}")
    grid = array.shards or array.chunks
    size = math.prod(array.chunks) * array.dtype.itemsize
    chunks = math.prod(-(-length // step) for length, step in zip(array.shape, grid, strict=True))
    if size > MOST_OBJECT_BYTES or chunks > _MOST_CHUNKS:
        raise RunDamagedError(
            f"{array.path} claims {chunks:,} chunks of {size:,} bytes; expected at most {_MOST_CHUNKS:,} of "
            f"{MOST_OBJECT_BYTES:,}. {_RESTORE}"
        )


def decode_bfloat16(bits: NDArray[np.uint16]) -> NDArray[np.float32]:
    """uint16 bit patterns of bfloat16 to float32, exactly."""
    return (bits.astype(np.uint32) << 16).view(np.float32)


def encode_bfloat16(values: NDArray[np.float32]) -> NDArray[np.uint16]:
    """float32 to the bits of bfloat16, to the nearest and half to even; NaN stays NaN."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    # Half a unit of the kept bits, less one, plus the lowest kept bit: ties go to even. Wraps around for NaN only.
    rounded = (bits + (0x7FFF + ((bits >> 16) & 1))) >> 16
    encoded: NDArray[np.uint16] = np.where(np.isnan(values), NOT_A_NUMBER, rounded).astype(np.uint16)
    return encoded


def index_bytes(count: int) -> int:
    """Length of the index of a shard of so many inner chunks."""
    return count * ENTRY + CHECKSUM


def chunk_slices(index: bytes) -> list[slice]:
    """Return the bytes of every inner chunk in its shard, in the order of the index; an absent one is empty."""
    entries = np.frombuffer(index[:-CHECKSUM], "<u8").reshape(-1, 2)
    return [
        slice(0, 0) if start == _ABSENT else slice(start, start + length) for start, length in entries.tolist()
    ]


def inner_chunks(shard: bytes, count: int) -> list[slice]:
    """Return the bytes of the `count` inner chunks of a whole shard, then those of its index."""
    index = slice(len(shard) - index_bytes(count), len(shard))
    return [*chunk_slices(shard[index]), index]
