"""A store that records the hash of everything written through it."""

from collections.abc import Mapping

from zarr.abc.store import Store
from zarr.core.buffer import Buffer
from zarr.storage import WrapperStore

from probe_kit.runs.arrays import inner_chunks
from probe_kit.runs.records import Sum, block_digest, digest


class RecordingStore(WrapperStore[Store]):
    """Passes writes on and keeps length and hash of every object, computed while its bytes are at hand.

    shards: number of inner chunks in every object of a sharded array, by the array's path.
    """

    def __init__(self, store: Store, shards: Mapping[str, int] | None = None) -> None:
        super().__init__(store)
        self.sums: dict[str, Sum] = {}
        self.shards = dict(shards or {})

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
        count = self.shards.get(key.partition("/c/")[0], 0) if "/c/" in key else 0
        blocks = "".join(block_digest(content[part]) for part in inner_chunks(content, count)) if count else ""
        self.sums[key] = Sum(len(content), digest(content), blocks)
