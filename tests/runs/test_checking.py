"""A checked store names the same object however its objects come in."""

import asyncio
from hashlib import blake2b

import pytest
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import MemoryStore, WrapperStore

from probe_kit.errors import RunDamagedError
from probe_kit.runs.checking import CheckedStore
from probe_kit.runs.records import Sum

KEYS = ("a", "b", "c", "d")


class Staggered(WrapperStore[MemoryStore]):
    """The objects come in another order than they were asked for."""

    def __init__(self, store: MemoryStore, late: tuple[str, ...]) -> None:
        super().__init__(store)
        self._late = late

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        for _ in range(20 * self._late.index(key)):
            await asyncio.sleep(0)
        return await super().get(key, prototype, byte_range)


@pytest.mark.parametrize("order", [KEYS, KEYS[::-1], ("c", "a", "d", "b")])
def test_of_several_wrong_objects_the_first_that_was_asked_for_is_named(order: tuple[str, ...]) -> None:
    prototype = default_buffer_prototype()
    objects = {key: prototype.buffer.from_bytes(blake2b(key.encode()).digest()) for key in KEYS}
    sums = {key: Sum.of(value.to_bytes()) for key, value in objects.items()}
    objects["b"], objects["d"] = objects["d"], objects["b"]
    checked = CheckedStore(Staggered(MemoryStore(objects), order), sums, str, lambda _key: "Restore it")

    async def read() -> None:
        await asyncio.gather(*(checked.get(key, prototype) for key in KEYS))

    with pytest.raises(RunDamagedError, match=r"^b has other bytes"):
        asyncio.run(read())
