"""The object-store client beneath Zarr: retries, time limits and errors."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from probe_kit.errors import StoreError

LONGEST_PAUSE = 5.0
"""Seconds between two requests of the same thing."""


def pauses_between() -> Iterator[float]:
    """Seconds to wait before every further try."""
    pause = 0.1
    while True:
        yield pause
        pause = min(2 * pause, LONGEST_PAUSE)


class PatientStore(WrapperStore[Store]):
    """A store whose errors are those of the location that it belongs to, and that are waited for to pass.

    in_words: raises StoreError in place of what is below. passing: whether such an error may pass by itself.
    seconds: so long a request is repeated. obstore repeats most of them, but not an answer that breaks off
    while it says that there is no such object.
    """

    def __init__(
        self,
        store: Store,
        in_words: Callable[[], AbstractContextManager[None]],
        passing: Callable[[StoreError], bool],
        seconds: float,
    ) -> None:
        super().__init__(store)
        self._in_words, self._passing, self._seconds = in_words, passing, seconds

    def _with_store(self, store: Store) -> "PatientStore":
        return PatientStore(store, self._in_words, self._passing, self._seconds)

    async def _asked[T](self, ask: Callable[[], Awaitable[T]]) -> T:
        pauses, end = pauses_between(), time.monotonic() + self._seconds
        while True:
            try:
                with self._in_words():
                    return await ask()
            except StoreError as error:
                pause = next(pauses)
                if not self._passing(error) or time.monotonic() + pause > end:
                    raise
            await asyncio.sleep(pause)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """One object or a part of it."""
        return await self._asked(lambda: self._store.get(key, prototype, byte_range))

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Parts of several."""
        wanted = list(key_ranges)
        return await self._asked(lambda: self._store.get_partial_values(prototype, wanted))

    async def get_ranges(
        self, key: str, byte_ranges: Sequence[ByteRequest | None], *, prototype: BufferPrototype, **how: Any
    ) -> AsyncIterator[Sequence[tuple[int, Buffer | None]]]:
        """Parts of one."""
        with self._in_words():
            async for group in super().get_ranges(key, byte_ranges, prototype=prototype, **how):
                yield group

    async def exists(self, key: str) -> bool:
        """Whether it is there."""
        return await self._asked(lambda: self._store.exists(key))

    async def set(self, key: str, value: Buffer) -> None:
        """Write one."""
        await self._asked(lambda: self._store.set(key, value))

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write one unless it is there."""
        await self._asked(lambda: self._store.set_if_not_exists(key, value))

    async def delete(self, key: str) -> None:
        """Remove one."""
        await self._asked(lambda: self._store.delete(key))

    async def delete_dir(self, prefix: str) -> None:
        """Remove all below."""
        await self._asked(lambda: self._store.delete_dir(prefix))

    async def list(self) -> AsyncIterator[str]:
        """All keys."""
        with self._in_words():
            async for key in super().list():
                yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Those that begin so."""
        with self._in_words():
            async for key in super().list_prefix(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Names right in a folder."""
        with self._in_words():
            async for name in super().list_dir(prefix):
                yield name


class BlankStore(WrapperStore[Store]):
    """A store that shows only what was written through it."""

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self._written: set[str] = set()

    async def set(self, key: str, value: Buffer) -> None:
        """Write one object, which is there from now on."""
        self._written.add(key)
        await super().set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write one object over whatever lies there from before."""
        if key not in self._written:
            await self.set(key, value)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """One object or a part of it, if it was written here."""
        return await super().get(key, prototype, byte_range) if key in self._written else None

    async def exists(self, key: str) -> bool:
        """Whether it was written here."""
        return key in self._written

    async def delete_dir(self, prefix: str) -> None:
        """Remove what was written here below `prefix`."""
        for key in [key for key in self._written if key.startswith(prefix)]:
            await self.delete(key)
