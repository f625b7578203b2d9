"""A location: the folder or object-store prefix of a run, and the operations that a run needs.

Everything in a run is an object with a key such as `commits/00000003.json`. All reads and writes of objects go
through its location; differences between folders and object stores (locks, renaming, free space, flushing) are
handled in `folder` and `bucket` only.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import BinaryIO

from zarr.abc.store import Store

from probe_kit.errors import RunDamagedError, StoreError

MOST_RECORD_BYTES, MOST_OBJECT_BYTES = 256 << 20, 4 << 30
"""The largest record, and the largest other object, that is read at once.

Far above what runs have. They keep a file that was made up, such as a sparse one, from taking all memory.
"""


def check_size(key: str, size: int, where: object) -> None:
    """Raise RunDamagedError for an object that is larger than any that probe_kit writes, before it is read."""
    most = MOST_RECORD_BYTES if key.endswith(".json") else MOST_OBJECT_BYTES
    if size > most:
        raise RunDamagedError(
            f"{where}/{key} has {size / 1e6:,.0f} MB; expected at most {most / 1e6:,.0f} MB. Restore it from a "
            "copy, or extract the run again"
        )


class Location(ABC):
    """The place of a run. `str()` gives what the user called it."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The last part: what the run is called."""

    @property
    @abstractmethod
    def path(self) -> Path:
        """The folder. Raises UsageError in an object store, where there is none."""

    @property
    @abstractmethod
    def address(self) -> str:
        """The text by which `locate` finds the same location in another process, in any working directory."""

    @abstractmethod
    def path_of_export(self, name: str) -> Path:
        """Default path of a file that is made from the run."""

    @abstractmethod
    def free_bytes(self) -> int | None:
        """Free space, None where it has no bound."""

    @abstractmethod
    def in_words(self) -> AbstractContextManager[None]:
        """Errors in the body that come from what is below (a full disk, a network) say what to do.

        Raises DiskSpaceError or StoreError in place of the system's error.
        """

    # -- objects ---------------------------------------------------------------------------------------

    @abstractmethod
    def exists(self, key: str) -> bool:
        """Whether there is an object of that key."""

    @abstractmethod
    def read(self, key: str) -> bytes:
        """All of one object. Raises FileNotFoundError."""

    def pieces(self, key: str) -> Iterator[bytes | memoryview]:
        """One object from its beginning to its end; a piece is good until the next one is asked for.

        Raises FileNotFoundError.
        """
        yield self.read(key)

    @abstractmethod
    def open(self, key: str) -> BinaryIO:
        """One object as a file with random access. Raises FileNotFoundError."""

    @abstractmethod
    def read_all(self, folder: str, suffix: str) -> dict[str, bytes]:
        """The objects right in `folder` whose name ends so, by name, in order."""

    @abstractmethod
    def keys(self, folder: str) -> list[str]:
        """The objects anywhere below `folder`, in order."""

    @abstractmethod
    def sizes(self, folder: str, keys: Iterable[str]) -> dict[str, int]:
        """Bytes of the objects `keys` below `folder`, as far as they exist."""

    @abstractmethod
    def flush(self, keys: Iterable[str]) -> None:
        """Bring these objects, just written by Zarr, onto the disk. Called before a record names them."""

    @abstractmethod
    def create(self, key: str, content: bytes) -> bool:
        """Write an object unless it exists; True if this call wrote it. Complete or not at all, and durable."""

    @abstractmethod
    def write(self, key: str, content: bytes, durable: bool = True) -> None:
        """Write an object over any former one. Complete or not at all; durable unless it can be made again."""

    def check_exclusive(self, key: str) -> None:
        """Raise StoreError unless a second `create` of the object `key` is refused, on which commits rely."""
        if self.create(key, self.read(key)):
            raise StoreError(
                f"{self}: the store created {key} a second time: it ignores conditional puts (If-None-Match), and "
                "cannot keep two writers apart. Use another store, or a folder"
            )

    @abstractmethod
    def delete(self, key: str) -> None:
        """Remove one object, if it exists."""

    @abstractmethod
    def remove(self, folder: str) -> None:
        """Remove everything below `folder`, if there is anything."""

    @abstractmethod
    def store(self, folder: str, read_only: bool = False) -> Store:
        """Return Zarr's store for the group or array that lies in `folder`."""

    # -- runs ------------------------------------------------------------------------------------------

    @abstractmethod
    def begin(self, objects: Mapping[str, bytes], last: str) -> None:
        """Begin with these objects; `last`, one of them, never appears without all others.

        If another process is first, its objects stay. Raises SettingsMismatchError if something else is there.
        """

    @abstractmethod
    def locked(self, clear: Callable[[], None]) -> AbstractContextManager[None]:
        """Lock the run while the body runs. A process that is alone first calls `clear` to remove leftovers."""

    @abstractmethod
    def tended(self, folder: str) -> AbstractContextManager[None]:
        """Let processes that work on `folder` take turns; drafts of killed ones in it are removed."""
