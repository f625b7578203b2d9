"""The objects of one folder of a run as Zarr has them: hashed as they are written, checked as they are read."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from typing import Any

from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype

from probe_kit.errors import RunDamagedError
from probe_kit.runs.arrays import chunk_slices, index_bytes, inner_chunks
from probe_kit.runs.records import BLOCK_BYTES, Sum, block_digest, digest
from probe_kit.runs.store import Location

_BLOCK = 2 * BLOCK_BYTES
"""Hex digits of the hash of one inner chunk, of which `Sum.blocks` is a row."""

_SPARE = 1 << 20
"""Bytes that an object may have too many and is still read: a file that was made larger never takes all memory."""


class ArrayStore(Store):
    """The objects below `folder` that are known by their sums; whatever else lies there does not exist for it.

    written: the sums of what was written through it. shards: number of inner chunks in every object of a sharded
    array, by the array's path, to be filled in before it is written.

    Args:
        sums: By key; an object that is written is known from then on.
        advice: What to do if the object of a key is wrong. A wrong or missing object raises RunDamagedError. Of a
            shard, only the parts that are read are checked.
    """

    supports_writes = supports_deletes = supports_listing = True

    def __init__(
        self,
        location: Location,
        folder: str,
        sums: Mapping[str, Sum],
        advice: Callable[[str], str] = lambda _key: "",
        read_only: bool = False,
    ) -> None:
        super().__init__(read_only=read_only)
        self._location, self._folder, self._advice = location, folder, advice
        self.sums, self.written, self.shards = dict(sums), dict[str, Sum](), dict[str, int]()
        self._indexes: dict[str, dict[tuple[int, int], str]] = {}

    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = object.__hash__

    def _key(self, key: str) -> str:
        return f"{self._folder}/{key}"

    # -- reading ---------------------------------------------------------------------------------------

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """One object or a part of it; None if it is not known. Raises RunDamagedError."""
        if key not in self.sums:
            return None
        return prototype.buffer.from_bytes(await asyncio.to_thread(self._read, key, byte_range))

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Parts of several objects."""
        return list(await asyncio.gather(*(self.get(key, prototype, part) for key, part in key_ranges)))

    async def get_ranges(
        self, key: str, byte_ranges: Sequence[ByteRequest | None], *, prototype: BufferPrototype, **_: Any
    ) -> AsyncIterator[Sequence[tuple[int, Buffer | None]]]:
        """Parts of one object, never merged: each of them has a hash, and two together have none."""
        parts = await self.get_partial_values(prototype, [(key, byte_range) for byte_range in byte_ranges])
        yield list(enumerate(parts))

    async def exists(self, key: str) -> bool:
        """Whether there is such an object, wrong or not."""
        return key in self.sums and await asyncio.to_thread(self._location.exists, self._key(key))

    async def list(self) -> AsyncIterator[str]:
        """Keys of all that is known."""
        for key in [*self.sums]:
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield the keys that begin so."""
        for key in [key for key in self.sums if key.startswith(prefix)]:
            yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Names of what is known right in a folder."""
        inside = f"{prefix.rstrip('/')}/" if prefix.strip("/") else ""
        names = (key.removeprefix(inside).partition("/")[0] for key in self.sums if key.startswith(inside))
        for name in dict.fromkeys(names):
            yield name

    def _read(self, key: str, byte_range: ByteRequest | None) -> bytes:
        """The bytes of an object or of a part. Raises RunDamagedError unless they are what was written."""
        stored = self.sums[key]
        try:
            if byte_range is None:
                content = self._location.read(self._key(key), most=stored.length + _SPARE)
                problem = stored.problem(content)
            else:
                part = _range_of(byte_range, stored.length)
                content = self._location.read(self._key(key), part)
                is_index = part.stop == stored.length
                problem = self._index_problem(key, content) if is_index else self._part_problem(key, part, content)
        except FileNotFoundError:
            problem = "is missing"
        if problem:
            raise RunDamagedError(f"{self._location}/{self._key(key)} {problem}. {self._advice(key)}")
        return content

    def _index_problem(self, key: str, content: bytes) -> str | None:
        """The fault in the index at the end of a shard; a whole one says where the parts lie."""
        blocks = self.sums[key].blocks
        digests = [blocks[start : start + _BLOCK] for start in range(0, len(blocks), _BLOCK)]
        if not digests or block_digest(content) != digests[-1]:
            return "has another index than was written"
        self._indexes[key] = {
            (part.start, part.stop): block for part, block in zip(chunk_slices(content), digests, strict=False)
        }
        return None

    def _part_problem(self, key: str, part: slice, content: bytes) -> str | None:
        if key not in self._indexes:  # the hashes of parts are in the order of the index
            length, count = self.sums[key].length, len(self.sums[key].blocks) // _BLOCK - 1
            index = slice(length - index_bytes(max(count, 0)), length)
            if problem := self._index_problem(key, self._location.read(self._key(key), index)):
                return problem
        expected = self._indexes[key].get((part.start, part.stop))
        return None if block_digest(content) == expected else "has other bytes than were written"

    # -- writing ---------------------------------------------------------------------------------------

    async def set(self, key: str, value: Buffer) -> None:
        """Write one object; it is durable once `Location.flush` was called."""
        content = value.to_bytes()
        # Zarr calls the chunks of an array `ARRAY/c/…`; everything else is metadata, which has no inner chunks.
        count = self.shards.get(key.partition("/c/")[0], 0) if "/c/" in key else 0
        blocks = "".join(block_digest(content[part]) for part in inner_chunks(content, count)) if count else ""
        await asyncio.to_thread(self._location.write, self._key(key), content, durable=False)
        self.sums[key] = self.written[key] = Sum(len(content), digest(content), blocks)

    async def delete(self, key: str) -> None:
        """Remove one object."""
        self.sums.pop(key, None)
        self.written.pop(key, None)
        await asyncio.to_thread(self._location.delete, self._key(key))


def _range_of(byte_range: ByteRequest, length: int) -> slice:
    """The bytes of an object of this length that Zarr asks for."""
    if isinstance(byte_range, RangeByteRequest):
        return slice(byte_range.start, byte_range.end)
    if isinstance(byte_range, OffsetByteRequest):
        return slice(byte_range.offset, length)
    return slice(max(0, length - byte_range.suffix), length)
