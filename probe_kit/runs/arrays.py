"""The arrays of a run: shapes, chunks, codec, where the inner chunks of a shard lie, and reading of rows.

Arrays of tokens and of later inferences hold the bits of bfloat16 as uint16, because Zarr v3 has no bfloat16.
Inputs of recorded frames lie beside the streams, one chunk per row of the plan:

    data.zarr/inputs/state        float32 (episode, call, number), as recorded
    data.zarr/inputs/action       float32 (episode, call, step, number): the recorded actions from the frame on
    data.zarr/inputs/prediction   float32 (episode, call, step, number), in the checkpoint's own units
    data.zarr/inputs/columns      float64 (episode, call, column): timestamp, reward … as the data set has them
    data.zarr/inputs/pixels       uint8 (episode, call, camera, y, x, colour): 32 × 32
    data.zarr/inputs/picture.NAME uint8 (episode, call, y, x, colour): whole pictures of a camera, as received

Rows behind the last frame of a stretch are not numbers; of pixels and pictures they are zero.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.abc.store import Store
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, ShardingCodec
from zarr.core.array_spec import ArrayConfigLike, ArraySpec
from zarr.core.buffer import Buffer
from zarr.core.metadata import ArrayV3Metadata
from zarr.errors import ChunkNotFoundError
from zarr.registry import register_codec

from probe_kit._system.table_cells import Cell
from probe_kit.errors import RunDamagedError
from probe_kit.hooks.contract.sites import PADDING, plays
from probe_kit.runs.folder import MOST_OBJECT_BYTES
from probe_kit.runs.layout import CLASSES, INPUTS, LATER, MEAN_VIEW, ROOM, TRUTHS, LaterViews, StoredStream

ENTRY, CHECKSUM = 16, 4
"""The bytes of offset and length of a chunk as two uint64, and of the crc32c after all entries.

Both are in the index that Zarr writes at the end of every shard.
"""
_RESTORE = "Restore the run from a copy, or extract it again"
_MOST_CHUNKS = 10_000_000
"""The most chunks of an array: ten times `ROOM`. Metadata that claims more was made up, to fill all memory."""
_ONE_AT_A_TIME = Lock()
_BLOSC_SIZE = slice(4, 8)
"""The place of the unpacked size in the header of a chunk that blosc wrote."""
_ABSENT = (1 << 64) - 1
"""The offset and the length of an inner chunk that was never written, as Zarr's sharding stores them."""
NOT_A_NUMBER = 0x7FC0
"""The bits of bfloat16 where nothing was captured."""
# Zarr's default leaves out chunks that equal the fill value (and compares every chunk with it to find out), but
# a reader must be able to tell an empty chunk from a lost one. Not stored in the array, so asked for each time.
WRITE_ALL: ArrayConfigLike = {"write_empty_chunks": True}


def create_arrays(
    store: Store, streams: list[StoredStream], calls: int, with_tokens: bool, codec: str,
    later_views: LaterViews = "all",
) -> None:  # fmt: skip
    """Create every array with `ROOM` for episodes; afterwards chunks are written.

    `array_lengths` tells other tools how many episodes there are.

    Pooled rows are float32 (episode, call, [iteration,] layer, view, feature), one chunk per episode, NaN where
    nothing was captured. Tokens are uint16, one shard per episode, with inner chunks of one layer x 128 tokens.

    With `mean` for `later_views`, pooled rows hold the first inference alone, and `later` that view of the others.
    These are uint16 (episode, call, [iteration,] layer, feature), one chunk per episode, `NOT_A_NUMBER` where
    nothing was captured.
    """
    root = zarr.open_group(store, mode="w-", zarr_format=3)
    full = calls if later_views == "all" else 1
    for stream in streams:
        group = root.create_group(stream.name)
        pooled = (*stream.lead, len(stream.views), stream.width)
        create_array(  # one object per episode, which its commit can name and hash
            group, "pooled", (ROOM, full, *pooled), (1, full, *pooled), "float32", np.nan, codec,
            ("episode", "call", *stream.dimensions, "view", "feature"), {"views": list(stream.views)},
        )  # fmt: skip
        if later_views == MEAN_VIEW:
            later = (calls - 1, *stream.lead, stream.width)
            create_array(
                group, LATER, (ROOM, *later), (1, *later), "uint16", NOT_A_NUMBER, codec,
                # Not `call`: names are of one length in a group, or xarray refuses all of it.
                ("episode", "later_call", *stream.dimensions, "feature"),
                {"probe_kit:dtype": "bfloat16", "view": MEAN_VIEW},
            )  # fmt: skip
        if with_tokens:
            tokens = (calls, *stream.lead, stream.stored_tokens, stream.width)
            block = (1, 1, *(1 for _ in stream.lead), stream.token_block, stream.width)
            create_array(
                group, "tokens", (ROOM, *tokens), block, "uint16", 0, codec,
                ("episode", "call", *stream.dimensions, "token", "feature"),
                {"probe_kit:dtype": "bfloat16", "tokens": stream.tokens}, shards=(1, *tokens),
            )  # fmt: skip


def create_array(
    group: zarr.Group, name: str, shape: tuple[int, ...], chunks: tuple[int, ...], dtype: Any, fill_value: Any,
    codec: str, dimensions: Sequence[str] | None = None, attributes: dict[str, Any] | None = None,
    shards: tuple[int, ...] | None = None,
) -> zarr.Array[Any]:  # fmt: skip
    """Create one array of a run; `codecs` explains the names of `codec`."""
    return group.create_array(
        name, shape=shape, chunks=chunks, shards=shards, dtype=dtype, fill_value=fill_value,
        compressors=codecs(codec, np.dtype(dtype).itemsize), dimension_names=dimensions, attributes=attributes,
        config=WRITE_ALL,
    )  # fmt: skip


def write_row(store: Store, name: str, number: int, values: NDArray[Any]) -> None:
    """Store the values (n, …) of episode `number`, and the fill value behind the last one."""
    array: zarr.Array[Any] = zarr.open_array(store, path=name, mode="r+", zarr_format=3, config=WRITE_ALL)
    row = np.full(array.shape[1:], array.fill_value, array.dtype)
    row[: len(values)] = values
    array[number] = row


def codecs(name: str, typesize: int) -> list[BytesBytesCodec]:
    """Return blosc, then a checksum; blosc shuffles numbers of `typesize` bytes before it compresses them."""
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

    Raises:
        RunDamagedError: For codecs, and for sizes, that probe_kit never writes.
    """
    with bounded_codecs():
        array = zarr.open_array(store, path=name, mode="r", zarr_format=3, config={"read_missing_chunks": False})
    check_bounds(array)
    return array


class BoundedBloscCodec(BloscCodec):
    """A blosc codec that unpacks only to the size of the array's chunks, whatever size a chunk declares."""

    def _decode_sync(self, chunk_bytes: Buffer, chunk_spec: ArraySpec) -> Buffer:
        expected = math.prod(chunk_spec.shape) * chunk_spec.dtype.to_native_dtype().itemsize
        declared = int.from_bytes(chunk_bytes.as_numpy_array()[_BLOSC_SIZE].tobytes(), "little")
        if declared != expected:
            raise ValueError(f"a chunk of {expected:,} bytes unpacks to {declared:,}")
        return super()._decode_sync(chunk_bytes, chunk_spec)


register_codec("blosc", BoundedBloscCodec)  # chosen where `bounded_codecs` says so


@contextmanager
def bounded_codecs() -> Iterator[None]:
    """Make arrays that are opened in the body unpack no more bytes than a chunk has."""
    # The configuration of zarr is one for all threads; another thread's end would set it back too early.
    name = f"{BoundedBloscCodec.__module__}.{BoundedBloscCodec.__qualname__}"
    with _ONE_AT_A_TIME, zarr.config.set({"codecs.blosc": name}):
        yield


def check_bounds(array: zarr.Array[Any]) -> None:
    """Raise RunDamagedError for an array that no run has: foreign metadata may claim any shape and codec."""
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
    """Convert bit patterns of bfloat16, as uint16, to float32, exactly."""
    return (bits.astype(np.uint32) << 16).view(np.float32)


def encode_bfloat16(values: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert float32 to the bits of bfloat16, to the nearest and half to even; NaN stays NaN."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    # Half a unit of the kept bits, less one, plus the lowest kept bit: ties go to even. Wraps around for NaN only.
    rounded = (bits + (0x7FFF + ((bits >> 16) & 1))) >> 16
    encoded: NDArray[np.uint16] = np.where(np.isnan(values), NOT_A_NUMBER, rounded).astype(np.uint16)
    return encoded


def index_bytes(count: int) -> int:
    """Return the length of the index of a shard of `count` inner chunks."""
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


# -- rows --------------------------------------------------------------------------------------------------------


Spans = Sequence[tuple[str, int, int]]
_BLOCK_BYTES = 1 << 24
"""The bytes of rows that are read at a time, in order: beginning a request takes longer than reading."""
_DAMAGE = (ChunkNotFoundError, ValueError, RuntimeError)
"""The errors of Zarr and its codecs for missing and for changed bytes."""


@dataclass(frozen=True)
class EpisodeRows:
    """An array with one row per planned episode, seen through the committed ones.

    Attributes:
        numbers: The plan's number of every committed episode, in order.
    """

    array: "zarr.Array[Any]"
    numbers: Sequence[int]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, position: int) -> NDArray[Any]:
        """Return all of one episode."""
        return self.read(position, ())

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield all of every episode, in order, as `between` does."""
        return self.between(0, len(self))

    def between(self, start: int, stop: int) -> Iterator[NDArray[Any]]:
        """Yield all of the episodes from `start` up to `stop`, in order; several are read at a time.

        Raises:
            RunDamagedError: At a damaged episode, after those before it.
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
        """Return a part of one episode. Raises RunDamagedError if bytes are missing or fail their checksum."""
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
    """The tokens `start` up to `start + T` of one site. Values outside the mask are zero.

    Attributes:
        values: (E, T, D) float32.
        mask: (E, T) bool.
    """

    start: int
    values: NDArray[np.float32]
    mask: NDArray[np.bool_]


def role_mask(spans: Sequence[Spans], tokens: int, role: str | None) -> NDArray[np.bool_]:
    """Return the mask (E, tokens) of the positions of `role`, or of all but padding; `spans` is per episode."""
    mask = np.zeros((len(spans), tokens), bool)
    for row, episode in enumerate(spans):
        for name, start, stop in episode:
            mask[row, start:stop] = name != PADDING if role is None else plays(name, role)
    return mask


def token_blocks(
    rows: EpisodeRows, at: tuple[int, ...], mask: NDArray[np.bool_], block: int
) -> Iterator[TokenBlock]:
    """Yield blocks of `block` tokens at `at` (call, [iteration,] layer); a block that `mask` lacks is left out.

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


# -- inputs of recorded frames -----------------------------------------------------------------------------------


_TYPES = {"columns": "float64", "pixels": "uint8"}
"""The types of the inputs that are not float32.

Columns hold timestamps and indices, for which float32 has too few digits.
"""
_DIMENSIONS = {"columns": ("column",), "pixels": ("camera", "y", "x", "colour")}
"""The names of the axes of the inputs that are no vectors of numbers."""
PICTURE_OF = "picture."
"""The prefix of the kind of input that holds the whole pictures of a camera, before its name."""


def type_of_input(name: str) -> np.dtype[Any]:
    """Return the type in which a kind of input is stored."""
    return np.dtype("uint8" if name.startswith(PICTURE_OF) else _TYPES.get(name, "float32"))


def create_inputs(store: Store, calls: int, shapes: Mapping[str, list[int]], codec: str) -> None:
    """Create the arrays of inputs, from the shapes of one inference by kind."""
    group = zarr.open_group(store, mode="a", zarr_format=3).create_group(INPUTS)
    for name, shape in shapes.items():
        dtype = type_of_input(name)
        fill_value = 0 if dtype.kind == "u" else np.nan
        dimensions = ("episode", "call", *_dimensions_of(name, len(shape)))
        create_array(group, name, (ROOM, calls, *shape), (1, calls, *shape), dtype, fill_value, codec, dimensions)


def _dimensions_of(name: str, axes: int) -> Sequence[str]:
    """Return names of the axes of one inference, which no other input shares: their lengths differ."""
    if name.startswith(PICTURE_OF):
        return f"{name}_y", f"{name}_x", "colour"
    names = _DIMENSIONS.get(name, (f"{name}_step", f"{name}_number")[-axes:])
    return names if len(names) == axes else [f"{name}_{axis}" for axis in range(axes)]


class StoredInputs:
    """The inputs of the committed rows of a run, in their order.

    Attributes:
        kinds: The kinds that are stored.
        columns: The names of the numbers of the kind `columns`.
        names: The names of the numbers of `state` and `action`.
        truths: The columns that are truth values, stored as 0 and 1.
        classes: The texts of which a column stores the position, by column of texts.
    """

    def __init__(self, store: Store, numbers: list[int], dataset: Mapping[str, Any]) -> None:
        self._store, self._numbers = store, numbers
        self.kinds: tuple[str, ...] = tuple(dataset["inputs"])
        self.columns: tuple[str, ...] = tuple(dataset["columns"])
        self.names: dict[str, tuple[str, ...]] = {name: tuple(names) for name, names in dataset["names"].items()}
        self.truths: tuple[str, ...] = self.names.pop(TRUTHS, ())
        self.classes: dict[str, tuple[str, ...]] = {
            name: self.names.pop(CLASSES + name) for name in self.columns if CLASSES + name in self.names
        }

    def read(self, kind: str) -> NDArray[Any]:
        """Return all inputs (E, C, …) of one kind. Raises KeyError for one that is not stored, RunDamagedError."""
        if kind not in self.kinds:
            raise KeyError(kind)
        rows = EpisodeRows(open_array(self._store, f"{INPUTS}/{kind}"), self._numbers)
        return np.stack(list(rows))

    def row(self, kind: str, position: int) -> NDArray[Any]:
        """Return the inputs (C, …) of one kind, of the row at a position. Raises KeyError, RunDamagedError."""
        if kind not in self.kinds:
            raise KeyError(kind)
        return EpisodeRows(open_array(self._store, f"{INPUTS}/{kind}"), self._numbers)[position]

    def column(self, name: str) -> NDArray[np.float64]:
        """Return one column (E, C) of the data set. Raises KeyError for one that is not stored."""
        if name not in self.columns:
            raise KeyError(name)
        values: NDArray[np.float64] = self.read("columns")[..., self.columns.index(name)]
        return values

    def cell(self, name: str, value: float) -> Cell:
        """Return a number of a column as its source had it: number, truth value or text; None if not finite."""
        if not np.isfinite(value):
            return None
        if texts := self.classes.get(name):
            return texts[int(value)]
        return bool(value) if name in self.truths and value in (0, 1) else value
