"""The messages of openpi's wire: what its client packs is read, within bounds."""

import msgpack
import numpy as np
import pytest

from probe_kit.errors import ObservationError
from probe_kit.serve.codec import MOST_ENTRIES, MOST_ITEMS, MessageError, pack, unpack

ARRAY = {b"__ndarray__": True, b"data": bytes(12), b"dtype": "|u1", b"shape": [2, 2, 3]}


@pytest.mark.parametrize("dtype", ["u1", "<f4", ">f8", "<f2", "?", "<i8"])
@pytest.mark.parametrize("shape", [(), (0,), (8,), (3, 4, 4), (2, 1, 2, 3)], ids=str)
def test_an_array_of_numbers_arrives_as_it_was_sent(dtype: str, shape: tuple[int, ...]) -> None:
    array = np.random.default_rng(0).integers(0, 200, shape).astype(dtype)
    read = unpack(pack({"state": array}))["state"]
    assert read.dtype == array.dtype
    assert read.shape == array.shape
    assert read.tobytes() == np.ascontiguousarray(array).tobytes()


def test_a_number_of_numpy_and_bytes_arrive() -> None:
    scalar = {b"__npgeneric__": True, b"data": 0.5, b"dtype": "<f8"}
    assert unpack(msgpack.packb({"a": scalar, "prompt": b"put it"})) == {"a": 0.5, "prompt": b"put it"}


@pytest.mark.parametrize(
    "changed",
    [
        {b"dtype": "|O"},
        {b"dtype": "<U3"},
        {b"dtype": "<c8"},
        {b"dtype": "V12"},
        {b"dtype": "u1,u1"},
        {b"dtype": 3},
        {b"shape": [2, 2, 4]},
        {b"shape": [-1, 12]},
        {b"shape": [2, 2, 3.0]},
        {b"shape": [1 << 62, 1 << 62]},
        {b"shape": "223"},
        {b"data": "text"},
    ],
    ids=str,
)
def test_an_array_that_is_no_numbers_of_its_shape_is_refused(changed: dict[bytes, object]) -> None:
    with pytest.raises(ObservationError):
        unpack(msgpack.packb({"image": ARRAY | changed}))


def nested(levels: int) -> object:
    return [] if not levels else {"a": nested(levels - 1)}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xc1",
        msgpack.packb([1]),
        msgpack.packb({1: 2}),
        msgpack.packb({f"{number}": 0 for number in range(MOST_ENTRIES + 1)}),
        msgpack.packb({"a": [0] * (MOST_ITEMS + 1)}),
        msgpack.packb({"a": [[0] * 4000] * 6}),
        msgpack.packb({"a": "x" * (64 * 1024 + 1)}),
        msgpack.packb({"a": nested(9)}),
        msgpack.packb({"a": nested(900)}),
        msgpack.packb({"a": msgpack.ExtType(5, b"x")}),
        msgpack.packb({"a": 1}) + b"\x00",
    ],
    ids=range(12),
)
def test_a_message_beyond_the_bounds_cannot_be_read(content: bytes) -> None:
    with pytest.raises(MessageError):
        unpack(content)


def test_random_changes_of_a_request_are_refused_or_read_and_raise_nothing_else() -> None:
    rng = np.random.default_rng(0)
    request = pack(
        {"image": np.zeros((4, 4, 3), np.uint8), "state": np.zeros(8), "prompt": "put it", "m": {"id": "a"}}
    )
    refused: list[str] = []
    for _ in range(400):
        content = bytearray(request)
        for at in rng.integers(0, len(content), rng.integers(1, 6)):
            content[at] = rng.integers(0, 256)
        try:
            unpack(bytes(content[: rng.integers(1, len(content) + 1)]))
        except ObservationError as error:
            refused.append(str(error))
    assert refused
    assert all(len(text.splitlines()) == 1 for text in refused)
