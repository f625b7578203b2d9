"""Files of a folder by their hashes: what is read of a file is what was hashed of it."""

import os
from collections.abc import Iterable
from hashlib import blake2b, file_digest
from pathlib import Path
from typing import BinaryIO

from probe_kit._system.bounded_files import open_regular
from probe_kit.errors import RecordingError

_DIGITS = 16
_MOST_BYTES = 1 << 40
"""Of a file, videos included: no bound but that of a disk."""
_Stamp = tuple[int, ...]


class HashedFiles:
    """The files of one folder. Each is hashed once, and opened only while it is the file that was hashed.

    A time of change alone proves nothing, because copies and version control set it; size, inode and the time of
    the last change of the inode are compared too, and the content again where one of them differs.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._hashed: dict[Path, tuple[str, _Stamp]] = {}

    def hash_of(self, files: Iterable[Path]) -> str:
        """The blake2b hash of names and bytes of several files, in their order. Raises RecordingError."""
        together = blake2b(digest_size=_DIGITS)
        for file in files:
            together.update(f"{file.relative_to(self._root).as_posix()} {self._hash(file)}\n".encode())
        return together.hexdigest()

    def open(self, file: Path) -> BinaryIO:
        """A file for reading. Raises RecordingError if it is missing, or was changed after it was hashed."""
        digest = self._hash(file)
        opened = _opened(file, self._root)
        if _stamp(opened) != self._hashed[file][1]:
            now, stamp = _digest(opened)
            if now != digest:
                opened.close()
                raise RecordingError(
                    f"{file.relative_to(self._root)} of {self._root.name} was changed while it was read: its "
                    f"content had the hash {digest}, now {now}. Leave the data set as it is until the command ends"
                )
            self._hashed[file] = now, stamp
        return opened

    def check(self, file: Path) -> None:
        """Raise as `open`, for a file that a library reads by its name."""
        self.open(file).close()

    def _hash(self, file: Path) -> str:
        if file not in self._hashed:
            with _opened(file, self._root) as opened:
                self._hashed[file] = _digest(opened)
        return self._hashed[file][0]


def _opened(file: Path, root: Path) -> BinaryIO:
    try:
        return open_regular(file, _MOST_BYTES)
    except OSError as error:
        raise RecordingError(
            f"{file.relative_to(root)} of {root.name} cannot be read: {error.strerror}. Copy the data set again"
        ) from error


def _digest(opened: BinaryIO) -> tuple[str, _Stamp]:
    """Hash and stamp of an open file, which is then at its beginning."""
    stamp = _stamp(opened)
    digest = file_digest(opened, lambda: blake2b(digest_size=_DIGITS)).hexdigest()  # type: ignore[arg-type]
    opened.seek(0)
    return digest, stamp


def _stamp(opened: BinaryIO) -> _Stamp:
    status = os.fstat(opened.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
