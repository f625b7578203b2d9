"""Stores of Zarr that hash what passes through them: everything that is written, every part that is read."""

from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable, Mapping, Sequence
from itertools import count
from typing import Any

from zarr.abc.store import ByteRequest, RangeByteRequest, Store, SuffixByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore, WrapperStore

from probe_kit.errors import RunDamagedError
from probe_kit.runs.arrays import chunk_slices, index_bytes, inner_chunks
from probe_kit.runs.records import BLOCK_BYTES, Sum, block_digest, digest

_BLOCK = 2 * BLOCK_BYTES
"""Hex digits of the hash of one inner chunk, of which `Sum.blocks` is a row."""


class RecordingStore(WrapperStore[Store]):
    """Passes writes on and keeps length and hash of every object, computed while its bytes are at hand.

    shards: number of inner chunks in every object of a sharded array, by the array's path.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self.sums: dict[str, Sum] = {}
        self.shards: dict[str, int] = {}

    async def set(self, key: str, value: Buffer) -> None:
        """Write one object."""
        self._record(key, value)
        await super().set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write one object unless it is there; Zarr does so with groups on the way to an array."""
        if key not in self.sums:
            self._record(key, value)
        await super().set_if_not_exists(key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write one object from synchronous code."""
        self._record(key, value)
        super().set_sync(key, value)

    def _record(self, key: str, value: Buffer) -> None:
        content = value.to_bytes()
        # Zarr calls the chunks of an array `ARRAY/c/…`; everything else is metadata, which has no inner chunks.
        count = self.shards.get(key.partition("/c/")[0], 0) if "/c/" in key else 0
        blocks = "".join(block_digest(content[part]) for part in inner_chunks(content, count)) if count else ""
        self.sums[key] = Sum(len(content), digest(content), blocks)


class BlankStore(RecordingStore):
    """A recording store that shows only what was written through it.

    What a killed process left in its folder, or another one writes there at the same time, does not exist for it.
    """

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write one object over any former one."""
        if key not in self.sums:
            await self.set(key, value)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """One object or a part of it, if it was written here."""
        return await super().get(key, prototype, byte_range) if key in self.sums else None

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """The same, from synchronous code."""
        return super().get_sync(key, prototype=prototype, byte_range=byte_range) if key in self.sums else None

    async def exists(self, key: str) -> bool:
        """Whether it was written here."""
        return key in self.sums

    async def delete_dir(self, prefix: str) -> None:
        """Remove what was written here below `prefix`."""
        for key in [key for key in self.sums if key.startswith(prefix)]:
            await self.delete(key)


class CheckedStore(WrapperStore[Store]):
    """Reads objects that are known by their sums; whatever else lies in the store does not exist for it.

    where: full name of an object, for messages. advice: what to do if one is wrong.
    A wrong or missing object raises RunDamagedError. Of a shard, only the parts that are read are checked. Of
    several wrong objects that are read at once, the one that was asked for first is named, whichever comes first.
    """

    def __init__(
        self, store: Store, sums: Mapping[str, Sum], where: Callable[[str], str], advice: Callable[[str], str]
    ) -> None:
        super().__init__(store)
        self._sums, self._where, self._advice = sums, where, advice
        self._indexes: dict[str, dict[tuple[int, int], str]] = {}
        self._numbers = count()
        self._underway: dict[int, str] = {}

    @property
    def _supports_sync_io(self) -> bool:
        """Zarr's synchronous reading merges parts of a shard, which then have no hash of their own."""
        return False

    def _with_store(self, store: Store) -> "CheckedStore":
        return CheckedStore(store, self._sums, self._where, self._advice)

    async def exists(self, key: str) -> bool:
        """Whether there is such an object, wrong or not."""
        return key in self._sums and await super().exists(key)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """One object or a part of it."""
        if key not in self._sums:
            return None
        # Zarr reads many chunks at once. Without numbers, which of two damaged ones is named would be a race.
        number = next(self._numbers)
        self._underway[number] = key
        try:
            self._check_size(key)
            value = await super().get(key, prototype, byte_range)
            # The hashes of parts are in the order of the index, which says where each part lies.
            if isinstance(byte_range, RangeByteRequest) and key not in self._indexes:
                await self._read_index(key, prototype)
            return self._checked(key, value, byte_range)
        except RunDamagedError as error:
            raise await self._first(number, prototype) or error from None
        finally:
            del self._underway[number]

    async def _first(self, number: int, prototype: BufferPrototype) -> RunDamagedError | None:
        """The damage of objects that were requested before and have not come yet."""
        for key in [key for earlier, key in sorted(self._underway.items()) if earlier < number]:
            try:
                self._checked(key, await super().get(key, prototype, None), None)
            except RunDamagedError as error:
                return error
        return None

    async def _read_index(self, key: str, prototype: BufferPrototype) -> None:
        count = len(self._sums[key].blocks) // _BLOCK - 1  # the last block is the index itself
        await self.get(key, prototype, SuffixByteRequest(index_bytes(max(count, 0))))

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """The same, from synchronous code."""
        if key not in self._sums:
            return None
        prototype = prototype or default_buffer_prototype()
        self._check_size(key)
        value = super().get_sync(key, prototype=prototype, byte_range=byte_range)
        return self._checked(key, value, byte_range)

    async def get_ranges(
        self, key: str, byte_ranges: Sequence[ByteRequest | None], *, prototype: BufferPrototype, **how: Any
    ) -> AsyncIterator[Sequence[tuple[int, Buffer | None]]]:
        """Parts of one object, fetched in the way of the store below."""
        if key not in self._indexes and any(
            isinstance(byte_range, RangeByteRequest) for byte_range in byte_ranges
        ):
            await self._read_index(key, prototype)
        async for group in super().get_ranges(key, byte_ranges, prototype=prototype, **how):
            yield [(number, self._checked(key, value, byte_ranges[number])) for number, value in group]

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """One after another."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    async def list(self) -> AsyncIterator[str]:
        """Keys of all that is known."""
        for key in self._sums:
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield the keys that begin so."""
        for key in self._sums:
            if key.startswith(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Names of what is known right in a folder."""
        inside = f"{prefix.rstrip('/')}/" if prefix.strip("/") else ""
        names = (key.removeprefix(inside).partition("/")[0] for key in self._sums if key.startswith(inside))
        for name in dict.fromkeys(names):
            yield name

    async def _get_many(
        self, requests: Iterable[tuple[str, BufferPrototype, ByteRequest | None]]
    ) -> AsyncGenerator[tuple[str, Buffer | None], None]:
        for key, prototype, byte_range in requests:
            yield key, await self.get(key, prototype, byte_range)

    def _check_size(self, key: str) -> None:
        """Raise RunDamagedError for a file that was made larger: a sparse one stands for all memory."""
        if not isinstance(self._store, LocalStore):
            return
        file, expected = self._store.root / key, self._sums[key]
        if file.is_file() and (size := file.stat().st_size) > expected.length:
            raise self._damaged(key, str(expected.size_problem(size)))

    def _checked(self, key: str, value: Buffer | None, byte_range: ByteRequest | None) -> Buffer:
        if value is None:
            raise self._damaged(key, "is missing")
        expected, content = self._sums[key], value.to_bytes()
        if byte_range is None:
            problem = expected.problem(content)
        elif isinstance(byte_range, SuffixByteRequest):
            problem = self._index_problem(key, content)
        else:
            problem = self._block_problem(key, content, byte_range)
        if problem:
            raise self._damaged(key, problem)
        return value

    def _index_problem(self, key: str, content: bytes) -> str | None:
        blocks = self._sums[key].blocks
        digests = [blocks[start : start + _BLOCK] for start in range(0, len(blocks), _BLOCK)]
        if not digests or block_digest(content) != digests[-1]:
            return "has another index than was written"
        self._indexes[key] = {
            (part.start, part.stop): block for part, block in zip(chunk_slices(content), digests, strict=False)
        }
        return None

    def _block_problem(self, key: str, content: bytes, byte_range: ByteRequest) -> str | None:
        if not isinstance(byte_range, RangeByteRequest):
            return f"was asked for {byte_range}, which no hash covers"
        expected = self._indexes.get(key, {}).get((byte_range.start, byte_range.end))
        return None if block_digest(content) == expected else "has other bytes than were written"

    def _damaged(self, key: str, problem: str) -> RunDamagedError:
        return RunDamagedError(f"{self._where(key)} {problem}. {self._advice(key)}")
