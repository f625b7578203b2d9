"""The objects of one folder of a run, for Zarr: hashed as they are written, checked as they are read."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from typing import Any

from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype

from probe_kit.errors import RunDamagedError
from probe_kit.runs.array_lengths import is_metadata, without_length
from probe_kit.runs.arrays import chunk_slices, index_bytes, inner_chunks
from probe_kit.runs.records import BLOCK_BYTES, Checksum, block_digest, digest
from probe_kit.runs.store import Location

_BLOCK = 2 * BLOCK_BYTES
"""The hex digits of the hash of one inner chunk, of which `Checksum.blocks` is a row."""

_SPARE = 1 << 20
"""The bytes that an object may have too many and is still read: an enlarged file never takes all memory."""


class ArrayStore(Store):
    """The objects below `folder` that are known by their sums; any other object there does not exist for it.

    A wrong or missing object raises RunDamagedError. Of a shard, only the parts that are read are checked.

    Attributes:
        written: The sums of what was written through the store.
        shards: The number of inner chunks in every object of a sharded array, by the array's path. It is filled in
            before the array is written.

    Args:
        location: The run that holds the folder.
        folder: The folder below which the keys lie, such as `data.zarr`.
        sums: The sums by key; an object that is written is known from then on.
        advice: A function of a key that returns what to do if its object is wrong. The default returns no advice.
        read_only: Whether Zarr refuses to write.
    """

    supports_writes = supports_deletes = supports_listing = True

    def __init__(
        self,
        location: Location,
        folder: str,
        sums: Mapping[str, Checksum],
        advice: Callable[[str], str] = lambda _key: "",
        read_only: bool = False,
    ) -> None:
        super().__init__(read_only=read_only)
        self._location, self._folder, self._advice = location, folder, advice
        self.sums, self.written, self.shards = dict(sums), dict[str, Checksum](), dict[str, int]()
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
        """Return one object or a part of it; None if it is not known. Raises RunDamagedError."""
        if key not in self.sums:
            return None
        return prototype.buffer.from_bytes(await asyncio.to_thread(self._read, key, byte_range))

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Return parts of several objects."""
        return list(await asyncio.gather(*(self.get(key, prototype, part) for key, part in key_ranges)))

    async def get_ranges(
        self, key: str, byte_ranges: Sequence[ByteRequest | None], *, prototype: BufferPrototype, **_: Any
    ) -> AsyncIterator[Sequence[tuple[int, Buffer | None]]]:
        """Yield parts of one object, never merged: each of them has a hash, and two together have none."""
        parts = await self.get_partial_values(prototype, [(key, byte_range) for byte_range in byte_ranges])
        yield list(enumerate(parts))

    async def exists(self, key: str) -> bool:
        """Whether there is an object of that key, wrong or not."""
        return key in self.sums and await asyncio.to_thread(self._location.exists, self._key(key))

    async def list(self) -> AsyncIterator[str]:
        """Yield the keys of all known objects."""
        for key in [*self.sums]:
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield the known keys that begin with a prefix."""
        for key in [key for key in self.sums if key.startswith(prefix)]:
            yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Yield the names of known objects and folders directly in a folder."""
        inside = f"{prefix.rstrip('/')}/" if prefix.strip("/") else ""
        names = (key.removeprefix(inside).partition("/")[0] for key in self.sums if key.startswith(inside))
        for name in dict.fromkeys(names):
            yield name

    def _read(self, key: str, byte_range: ByteRequest | None) -> bytes:
        """Return the bytes of an object or of a part. Raises RunDamagedError unless they are as written."""
        stored = self.sums[key]
        try:
            if byte_range is None:
                content = self._location.read(self._key(key), most=stored.length + _SPARE)
                if (problem := stored.problem(content)) and is_metadata(key):
                    content = without_length(content)
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
        """Return the fault in the index at the end of a shard; of a whole index, keep the hashes of the parts."""
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
        self.sums[key] = self.written[key] = Checksum(len(content), digest(content), blocks)

    async def delete(self, key: str) -> None:
        """Remove one object."""
        self.sums.pop(key, None)
        self.written.pop(key, None)
        await asyncio.to_thread(self._location.delete, self._key(key))


def _range_of(byte_range: ByteRequest, length: int) -> slice:
    """Return the bytes that Zarr asks for, of an object of this length."""
    if isinstance(byte_range, RangeByteRequest):
        return slice(byte_range.start, byte_range.end)
    if isinstance(byte_range, OffsetByteRequest):
        return slice(byte_range.offset, length)
    return slice(max(0, length - byte_range.suffix), length)
