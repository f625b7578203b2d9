"""Reading of foreign files: regular files alone, and no more bytes than expected."""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

MOST_BYTES = 256 << 20
"""The largest configuration or picture that is read; the vocabularies of tokenizers are a tenth of it."""
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_regular(path: Path, most: int = MOST_BYTES) -> None:
    """Raise OSError unless `path` is, or links to, a regular file of at most `most` bytes.

    Reading a pipe waits for ever, and reading a device may never end.
    """
    _check(path, path.stat(), most)


def open_regular(path: Path, most: int = MOST_BYTES) -> BufferedReader:
    """Open a regular file of at most `most` bytes. Raises OSError, with `strerror` in words, for another one."""
    check_regular(path, most)
    # The file may have been exchanged since: opening a pipe would wait for its writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _check(path, os.fstat(handle), most)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_regular(path: Path, most: int = MOST_BYTES) -> bytes:
    """Return the bytes of a regular file of at most `most` bytes. Raises OSError for another one."""
    with open_regular(path, most) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise _too_large(path, len(content), most)
    return content


def read_regular_text(path: Path, most: int = MOST_BYTES) -> str:
    """Return the text of a regular file in UTF-8. Raises OSError for another one, ValueError for other bytes."""
    return read_regular(path, most).decode("utf-8")


def _check(path: Path, found: os.stat_result, most: int) -> None:
    kind = stat.S_IFMT(found.st_mode)
    if kind == stat.S_IFDIR:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"it is {_KINDS.get(kind, 'no file')}; expected a regular file", str(path))
    if found.st_size > most:
        raise _too_large(path, found.st_size, most)


def _too_large(path: Path, size: int, most: int) -> OSError:
    reason = f"it has {size / 1e6:,.0f} MB; expected at most {most / 1e6:,.0f} MB"
    return OSError(errno.EFBIG, reason, str(path))
