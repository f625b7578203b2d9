"""Reading of foreign files: regular files alone, no more bytes than expected, and YAML with bounded aliases."""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Any

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
        content = file.read(most + 1)  # it may have grown since
    if len(content) > most:
        raise _too_large(path, len(content), most)
    return content


def read_regular_text(path: Path, most: int = MOST_BYTES) -> str:
    """Return the text of a regular file in UTF-8. Raises OSError for another one, ValueError for other bytes."""
    return read_regular(path, most).decode("utf-8")


def _check(path: Path, status: os.stat_result, most: int) -> None:
    kind = stat.S_IFMT(status.st_mode)
    if kind == stat.S_IFDIR:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"it is {_KINDS.get(kind, 'no file')}; expected a regular file", str(path))
    if status.st_size > most:
        raise _too_large(path, status.st_size, most)


def _too_large(path: Path, size: int, most: int) -> OSError:
    reason = f"it has {size / 1e6:,.0f} MB; expected at most {most / 1e6:,.0f} MB"
    return OSError(errno.EFBIG, reason, str(path))


MOST_NODES = 1_000_000
"""Values of a YAML file, where an alias counts as all that it stands for."""
_MOST_YAML_BYTES = 16 << 20
"""For which yaml takes 3.5 minutes; for `MOST_BYTES` json takes 3 seconds."""


def load_yaml(file: Path) -> Any:
    """Return the value in a file of safe YAML.

    Raises OSError as `read_regular` does, ValueError for other text, for text that nests too deeply, and for
    aliases that stand for more than `MOST_NODES` values: nine lines can stand for a billion.
    """
    import yaml

    try:
        value = yaml.safe_load(read_regular(file, _MOST_YAML_BYTES))
        count = _nodes(value, {})
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
    except RecursionError:
        raise ValueError("it nests too deeply, or refers to itself") from None
    if count > MOST_NODES:
        raise ValueError(f"its aliases stand for {count:.0e} values; expected at most {MOST_NODES:,}")
    return value


def _nodes(value: Any, counted: dict[int, int]) -> int:
    """The number of values below one, where an alias counts as all that it stands for."""
    if not isinstance(value, dict | list | set | tuple):
        return 1
    if id(value) not in counted:
        children = value.values() if isinstance(value, dict) else value
        counted[id(value)] = 1 + sum(_nodes(child, counted) for child in children)
    return counted[id(value)]
