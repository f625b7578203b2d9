"""A connection between a process and its child. Large arrays pass through memory that both share.

Through a socket, a picture of 640 × 480 pixels is copied six times. It passes in parts, and for each part one
process waits until the other is woken.
"""

import mmap
import os
import pickle
import tempfile
from array import array
from multiprocessing.connection import Connection
from typing import Any, Self

SLOT_BYTES = 2**24
"""The bytes of arrays that one message can hold in shared memory; the others are sent."""
SMALLEST_BYTES = 2**15
"""The bytes from which an array is worth a place in shared memory."""
_SLOTS = 2
"""The messages of one direction whose arrays are in memory at a time: a player sends an ending and a picture."""
_COUNTER_BYTES = 8
_DIRECTION_BYTES = _SLOTS * SLOT_BYTES
_ALL_BYTES = mmap.PAGESIZE + 2 * _DIRECTION_BYTES


def open_shared_memory() -> int:
    """Return the descriptor of new memory for two ends; it takes room only where something was written."""
    if hasattr(os, "memfd_create"):  # Linux alone; elsewhere a file without a name
        descriptor = os.memfd_create("probe-kit")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.truncate(descriptor, _ALL_BYTES)
    return descriptor


class ArrayConnection:
    """One end of a connection.

    A message is pickled. Its large arrays are copied into a slot of the direction, of which two take turns. While
    both wait to be read, arrays are sent with the rest.

    Args:
        connection: The connection for everything but large arrays.
        memory: The descriptor of the memory that both ends share; it is closed here.
        is_child: Whether this end is the child's.
    """

    def __init__(self, connection: Connection, memory: int, is_child: bool) -> None:
        self._connection = connection
        self._map = mmap.mmap(memory, _ALL_BYTES)
        os.close(memory)
        self._memory = memoryview(self._map)
        # The reader of each direction counts what it has read, so that the writer knows which slots are free.
        self._read_counts = self._memory[: 2 * _COUNTER_BYTES].cast("Q")
        self._outward, self._inward = (1, 0) if is_child else (0, 1)
        self._sent = self._received = 0

    def fileno(self) -> int:
        """Return the descriptor that is ready when a message has come."""
        return self._connection.fileno()

    def send(self, message: object) -> None:
        """Send a message, as `Connection.send`."""
        position = self._first_byte(self._outward, self._sent)
        end = position + SLOT_BYTES if self._sent - self._read_counts[self._outward] < _SLOTS else position
        sizes = array("Q")

        def is_sent(buffer: pickle.PickleBuffer) -> bool:
            """Copy an array into the slot, or return True where it has no place there."""
            nonlocal position
            content = buffer.raw()
            if content.nbytes < SMALLEST_BYTES or position + content.nbytes > end:
                return True
            self._memory[position : position + content.nbytes] = content
            position += content.nbytes
            sizes.append(content.nbytes)
            return False

        pickled = pickle.dumps(message, protocol=5, buffer_callback=is_sent)
        self._connection.send_bytes(array("Q", [len(sizes)]).tobytes() + sizes.tobytes() + pickled)
        self._sent += 1

    def recv(self) -> Any:
        """Wait for a message and return it; its arrays are copies that may be written to.

        Raises:
            EOFError: If the other end is closed.
        """
        received = memoryview(self._connection.recv_bytes())
        (count,) = received[:_COUNTER_BYTES].cast("Q")
        pickled = received[_COUNTER_BYTES * (1 + count) :]
        position, contents = self._first_byte(self._inward, self._received), []
        for size in received[_COUNTER_BYTES : _COUNTER_BYTES * (1 + count)].cast("Q"):
            contents.append(bytearray(self._memory[position : position + size]))
            position += size
        self._received += 1
        self._read_counts[self._inward] = self._received
        return pickle.loads(pickled, buffers=contents)

    def close(self) -> None:
        """Close this end; a second call does nothing."""
        self._connection.close()
        self._read_counts.release()
        self._memory.release()
        self._map.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @staticmethod
    def _first_byte(direction: int, message: int) -> int:
        return mmap.PAGESIZE + direction * _DIRECTION_BYTES + message % _SLOTS * SLOT_BYTES
