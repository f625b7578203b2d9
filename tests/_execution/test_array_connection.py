"""Messages between a process and its child arrive as they were sent, whatever way their arrays take."""

import os
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit._execution.array_connection import SLOT_BYTES, SMALLEST_BYTES, ArrayConnection, open_shared_memory

Ends = tuple[ArrayConnection, ArrayConnection]
PICTURE = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)


@pytest.fixture(params=["memory", "file"])
def ends(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ends]:
    """The parent's and the child's end; both in this process."""
    if request.param == "file":  # of systems other than Linux
        monkeypatch.delattr(os, "memfd_create", raising=False)
    ours, theirs = (Connection(end.detach()) for end in socket.socketpair())
    memory = open_shared_memory()
    with ArrayConnection(ours, os.dup(memory), False) as parent, ArrayConnection(theirs, memory, True) as child:
        yield parent, child


@pytest.fixture(params=["to the child", "to the parent"])
def way(request: pytest.FixtureRequest, ends: Ends) -> Ends:
    """The end that sends, and the one that receives."""
    parent, child = ends
    return (parent, child) if request.param == "to the child" else (child, parent)


def received(way: Ends, message: object) -> Any:
    """The message at the other end; read meanwhile, because the socket holds little of it."""
    sender, receiver = way
    with ThreadPoolExecutor(1) as thread:
        sending = thread.submit(sender.send, message)
        arrived = receiver.recv()
        sending.result()
    return arrived


def sent_bytes(sender: ArrayConnection, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The bytes of every later message that pass through the socket."""
    counted: list[int] = []
    send_bytes = sender._connection.send_bytes

    def count(content: bytes) -> None:
        counted.append(len(content))
        send_bytes(content)

    monkeypatch.setattr(sender._connection, "send_bytes", count)
    return counted


@pytest.mark.parametrize(
    "values",
    [
        PICTURE,
        PICTURE[:, ::2],
        PICTURE.transpose(1, 0, 2),
        np.full(SMALLEST_BYTES // 8, np.nan),
        np.zeros(0, np.float32),
        np.array(3.5),
        np.array([1.5, float("inf")], np.float16),
    ],
    ids=["whole", "strided", "transposed", "the smallest in memory", "empty", "scalar", "small"],
)
def test_arrays_arrive_as_they_were_sent_and_can_be_written_to(way: Ends, values: NDArray[Any]) -> None:
    for _ in range(3):
        message = received(way, {"name": "A", "values": values, "beside": [PICTURE]})
        assert message["name"] == "A"
        assert message["values"].dtype == values.dtype
        np.testing.assert_array_equal(message["values"], values)
        np.testing.assert_array_equal(message["beside"], [PICTURE])
        message["values"][...] = 1


def test_a_picture_does_not_pass_through_the_socket(way: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    sender, receiver = way
    counted = sent_bytes(sender, monkeypatch)
    for number in range(5):
        sender.send(PICTURE + np.uint8(number))
        np.testing.assert_array_equal(receiver.recv(), PICTURE + np.uint8(number))
    assert max(counted) < 1000


def test_messages_that_wait_are_not_overwritten_by_later_ones(way: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    sender, receiver = way
    counted = sent_bytes(sender, monkeypatch)
    little = [np.full(SMALLEST_BYTES, number, np.uint8) for number in range(7)]
    for values in little[:4]:
        sender.send(values)
    assert [size < 1000 for size in counted] == [True, True, False, False], (
        "two wait in memory, later ones are sent"
    )
    for values in little[:3]:
        np.testing.assert_array_equal(receiver.recv(), values)
    for values in little[4:]:
        sender.send(values)
    for values in little[3:]:
        np.testing.assert_array_equal(receiver.recv(), values)


def test_a_message_larger_than_its_slot_arrives_too(way: Ends) -> None:
    half = np.arange(SLOT_BYTES // 8 * 3 // 4)
    first, second, third = received(way, [half, half + 1, half[:10]])
    np.testing.assert_array_equal(first, half)
    np.testing.assert_array_equal(second, half + 1)
    np.testing.assert_array_equal(third, half[:10])


def test_an_object_that_cannot_be_pickled_costs_no_slot(way: Ends) -> None:
    sender, receiver = way
    for _ in range(3):
        with pytest.raises(Exception, match=r"pickle|local object"):
            sender.send([PICTURE, lambda: None])
    sender.send(PICTURE)
    np.testing.assert_array_equal(receiver.recv(), PICTURE)


def test_a_closed_end_is_noticed_at_the_other(ends: Ends) -> None:
    parent, child = ends
    child.close()
    child.close()
    with pytest.raises(EOFError):
        parent.recv()
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        parent.send(PICTURE)
