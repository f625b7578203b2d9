"""The operations of a location, and a folder on this machine or a shared file system as one.

Everything in a run is an object with a key such as `commits/00000003.json`. All reads and writes of objects go
through its location. Differences between folders and object stores (locks, renaming, free space, flushing) are
handled here and in `store` only.
"""

import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, BinaryIO

from probe_kit.errors import FULL_DISK, DiskSpaceError, RunDamagedError
from probe_kit.runs.layout import COLUMNS, DATA, RUN_FILE

MOST_RECORD_BYTES, MOST_OBJECT_BYTES = 256 << 20, 4 << 30
"""The largest record, and the largest other object, that is read at once.

Both are far above what runs have. They keep a file that was made up, such as a sparse one, from taking all memory.
"""


def check_size(key: str, size: int, where: object, most: int | None = None) -> None:
    """Raise RunDamagedError for an object, before it is read, that is larger than any that probe_kit writes.

    Args:
        key: The object's key in the run.
        size: The object's size in bytes.
        where: The run, for the message.
        most: The most bytes that it may have, where that is known. None: the limit of its kind of object.
    """
    if most is None:
        most = MOST_RECORD_BYTES if key.endswith(".json") else MOST_OBJECT_BYTES
    if size > most:
        raise RunDamagedError(
            f"{where}/{key} has {size / 1e6:,.0f} MB; expected at most {most / 1e6:,.0f} MB. Restore it from a "
            "copy, or extract the run again"
        )


DRAFT = ".tmp"
"""The ending of an object without its final name yet."""
_DRAFTS = ("*.tmp", "*/*.tmp", f"{DATA}/**/*.tmp", f"{COLUMNS}/**/*.tmp")
"""The patterns of what a killed process leaves: objects without their final name."""
_PIECE = 1 << 20
"""The bytes that are hashed at a time: they stay in the processor's cache."""
_TRIES = 5
"""The times that a file is written whose folder another process clears or removes meanwhile."""
_FLUSHERS = 16
"""The files that are flushed at once, so that the file system writes its journal once for many."""


class Folder:
    """A folder on a file system with hard links and `flock`; `str()` returns the path as the user typed it.

    Its methods are the contract of a location, which `store.Bucket` keeps too.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return str(self._path)

    @property
    def name(self) -> str:
        """The last part of the path: the name of the run."""
        return self._path.resolve().name

    @property
    def path(self) -> Path:
        """The folder as the user typed it. An object store has none and raises UsageError."""
        return self._path

    @property
    def address(self) -> str:
        """The text by which `locate` finds the same location in another process, in any working directory."""
        return str(self._path.resolve())

    def path_of_export(self, name: str) -> Path:
        """Return the default path of a file that is made from the run: next to the folder."""
        return self._path.resolve().parent / name if self._path.name in ("", "..") else self._path.with_name(name)

    def free_bytes(self) -> int:
        """Return the free bytes of the disk where the folder lies or will lie; None where there is no bound."""
        existing = next(p for p in (self._path, *self._path.resolve().parents) if p.exists())
        return shutil.disk_usage(existing).free

    @contextmanager
    def explained_errors(self) -> Iterator[None]:
        """Replace errors of the layer below (a full disk, a network) in the body by errors that say what to do.

        Raises:
            DiskSpaceError: In place of the system's error, if the disk takes no more.
            StoreError: In place of the error of an object store.
        """
        try:
            yield
        except OSError as error:
            if error.errno not in FULL_DISK:
                raise
            free = f"{self.free_bytes() / 1e6:.1f} MB free"
            raise DiskSpaceError(
                f"the disk of {self} {FULL_DISK[error.errno]} ({free}); every committed episode is whole and "
                "kept. Free some space, then the same command continues"
            ) from error

    # -- objects ---------------------------------------------------------------------------------------

    def exists(self, key: str) -> bool:
        """Whether there is an object of that key."""
        return is_inside(key) and (self._path / key).is_file()

    def read(self, key: str, part: slice | None = None, most: int | None = None) -> bytes:
        """Return one object, or a part of its bytes; `check_size` explains `most`. Raises FileNotFoundError."""
        path = self._object(key)
        if part is None:
            check_size(key, path.stat().st_size, self, most)
            return path.read_bytes()
        with path.open("rb") as file:
            file.seek(part.start)
            return file.read(part.stop - part.start)

    def pieces(self, key: str) -> Iterator[memoryview]:
        """Yield one object from its beginning to its end; a piece is valid until the next one is asked for.

        Raises:
            FileNotFoundError: If there is no such object.
        """
        buffer = memoryview(bytearray(_PIECE))  # again and again: it stays in the processor's cache
        with self._object(key).open("rb", buffering=0) as file:
            while length := file.readinto(buffer):
                yield buffer[:length]

    def open(self, key: str) -> BinaryIO:
        """Open one object as a file with random access. Raises FileNotFoundError."""
        return self._object(key).open("rb")

    def read_all(self, folder: str, suffix: str) -> dict[str, bytes]:
        """Return the objects directly in `folder` whose name ends in `suffix`, by name, in order."""
        contents = {}
        for path in sorted((self._path / folder).glob(f"*{suffix}")):
            with suppress(FileNotFoundError):  # no plain file, or removed since: seals and failures come and go
                contents[path.name] = self.read(f"{folder}/{path.name}")
        return contents

    def keys(self, folder: str) -> list[str]:
        """Return the keys of the objects anywhere below `folder`, in order."""
        below = (self._path / folder).rglob("*")
        return sorted(path.relative_to(self._path).as_posix() for path in below if path.is_file())

    def sizes(self, folder: str, keys: Iterable[str]) -> dict[str, int]:
        """Return the bytes of the objects `keys` below `folder`, as far as they exist."""
        paths = {key: self._path / folder / key for key in keys if is_inside(key)}
        return {key: path.stat().st_size for key, path in paths.items() if path.is_file()}

    def flush(self, keys: Iterable[str]) -> None:
        """Bring these objects, just written by Zarr, onto the disk. Called before a record names them."""
        with ThreadPoolExecutor(_FLUSHERS) as threads:
            list(threads.map(_flush, [self._path / key for key in keys]))

    def create(self, key: str, content: bytes) -> bool:
        """Write an object unless it exists; return whether this call wrote it.

        The object is complete or absent, and durable.
        """
        try:
            self._put(key, content, os.link)  # which only one process can
        except FileExistsError:
            return False
        return True

    def write(self, key: str, content: bytes, durable: bool = True) -> None:
        """Write an object over any former one, complete or not at all; durable unless it can be made again."""
        self._put(key, content, os.replace, durable)

    def _put(
        self, key: str, content: bytes, give_name: Callable[[Path, Path], None], durable: bool = True
    ) -> None:
        """Write a draft in the same folder, flush it to the disk if it is to be durable, and give it its name."""
        path = self._inner(key)
        for tries_left in reversed(range(_TRIES)):
            try:
                with suppress(FileExistsError):  # another process removed it just after it existed
                    path.parent.mkdir(parents=True, exist_ok=True)
                with _draft(path, content, durable) as draft:
                    give_name(draft, path)
                return
            except FileNotFoundError:
                if not tries_left:  # before: another process cleared the drafts here, or removed the folder
                    raise

    def delete(self, key: str) -> None:
        """Remove one object, if it exists."""
        self._inner(key).unlink(missing_ok=True)

    def remove(self, folder: str) -> None:
        """Remove everything below `folder`, if there is anything."""
        shutil.rmtree(self._path / folder, ignore_errors=True)

    def _object(self, key: str) -> Path:
        """Return the path of an object. Raises FileNotFoundError for what is no plain file, or not in the folder.

        Foreign records may name a device, a pipe, which never ends, or a file outside the run.
        """
        path = self._path / key
        if not (is_inside(key) and path.is_file()):
            raise FileNotFoundError(errno.ENOENT, "no file of the run", str(path))
        return path

    def _inner(self, key: str) -> Path:
        """Return the path to write or remove. Raises RunDamagedError for a key that leads out of the folder."""
        check_inside(key, self)
        return self._path / key

    # -- runs ------------------------------------------------------------------------------------------

    @contextmanager
    def locked(self, clear: Callable[[], None]) -> Iterator[None]:
        """Lock the run while the body runs.

        A process that is alone first calls `clear` to remove leftovers. Every process that works holds a shared
        lock, as an apparent leftover may be another process's work. The last one to finish removes what others
        left that were killed meanwhile.
        """
        with (self._path / RUN_FILE).open("rb") as file:
            if _alone(file):
                self._clear_drafts()
                clear()
            fcntl.flock(file, fcntl.LOCK_SH)  # also turns the exclusive lock of `_alone` into a shared one
            yield
            if _alone(file):
                self._clear_drafts()

    def _clear_drafts(self) -> None:
        for pattern in _DRAFTS:
            for draft in self._path.glob(pattern):
                draft.unlink(missing_ok=True)  # a process that begins the run has no lock yet, and removes its own

    @contextmanager
    def take_turns(self, folder: str) -> Iterator[None]:
        """Let processes that work on `folder` take turns; drafts of killed ones in it are removed."""
        path = self._path / folder
        path.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            with suppress(PermissionError):  # a run that may only be read is listed too
                for leftover in path.glob("*.tmp"):
                    leftover.unlink(missing_ok=True)  # or its writer has just removed it
            yield
        finally:
            os.close(handle)


def is_inside(key: str) -> bool:
    """Whether a key stays below the folder it is read in, and names one object in folders and buckets alike."""
    controls = any(ord(character) < ord(" ") for character in key)
    return not controls and not {"", ".", ".."} & {*key.split("/")}


def check_inside(key: str, where: object) -> None:
    """Raise RunDamagedError for a key that leads out of the run `where`, as only foreign records name it."""
    if not is_inside(key):
        raise RunDamagedError(
            f"{where}: a record of this run names {key!r}, which leads out of its folder; probe_kit writes no "
            "such name. Take the run from where it was made"
        )


def _alone(file: IO[bytes]) -> bool:
    """Lock the file exclusively if no other process holds a lock on it, and return whether it is locked so."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _draft(path: Path, content: bytes, durable: bool = True) -> Iterator[Path]:
    """Yield a file of this content in the folder of `path`, already on the disk if durable; gone afterwards."""
    draft = path.with_name(f"{secrets.token_hex(8)}.tmp")
    # Who may read a run is a matter of the umask; tempfile would keep it from the others of a group.
    handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        yield draft
    finally:
        draft.unlink(missing_ok=True)
