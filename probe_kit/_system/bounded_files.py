"""Reading of foreign files: regular files alone, bounded in bytes, depth and values; YAML, JSON and arrays.

A Git LFS pointer is refused wherever a file is opened: by `open_regular`, and by `check_no_pointer` before a
library opens it by its name.
"""

import errno
import gzip
import json
import math
import os
import re
import stat
import zlib
from codecs import BOM_UTF8
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from io import BufferedReader, BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, BinaryIO
from zipfile import BadZipFile, ZipFile, ZipInfo

from probe_kit.errors import LfsPointerError, ProbeKitError

if TYPE_CHECKING:
    from numpy.lib.npyio import NpzFile


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


_READ: ContextVar[list[Path] | None] = ContextVar("read", default=None)


@contextmanager
def recorded_files() -> Iterator[list[Path]]:
    """A context whose value gets every file that `open_regular` opens inside, in order."""
    files: list[Path] = []
    token = _READ.set(files)
    try:
        yield files
    finally:
        _READ.reset(token)


def open_regular(path: Path, most: int = MOST_BYTES, pointers: bool = False) -> BufferedReader:
    """Open a regular file of at most `most` bytes.

    Args:
        path: The file.
        most: The largest size in bytes.
        pointers: Whether a Git LFS pointer is opened as any other file, for its bytes.

    Raises:
        OSError: For any other file, with `strerror` in words.
        LfsPointerError: For a Git LFS pointer.
    """
    check_regular(path, most)
    # The file may have been exchanged since: opening a pipe would wait for its writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(handle)
        _check(path, status, most)
        if not pointers and status.st_size <= _MOST_POINTER_BYTES:
            _check_beginning(path, os.pread(handle, _MOST_POINTER_BYTES, 0))
        if (files := _READ.get()) is not None:
            files.append(path)
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


# -- Git LFS --------------------------------------------------------------------------------------------------

_POINTER = b"version https://git-lfs.github.com/spec/"
_MOST_POINTER_BYTES = 1024
"""The bytes that its specification allows a pointer."""
_POINTED_SIZE = re.compile(rb"^size (\d{1,18})\r?$", re.MULTILINE)


def is_pointer(path: Path) -> bool:
    """Whether a file is a Git LFS pointer; not for one that is missing or cannot be read."""
    try:
        check_no_pointer(path)
    except LfsPointerError:
        return True
    return False


def check_no_pointer(path: Path) -> None:
    """Raise LfsPointerError for a Git LFS pointer; what else is wrong with a file is said by what opens it."""
    try:
        if not path.is_file() or path.stat().st_size > _MOST_POINTER_BYTES:
            return
        with path.open("rb") as file:
            beginning = file.read(_MOST_POINTER_BYTES)
    except OSError:
        return
    _check_beginning(path, beginning)


def check_no_pointers(folder: Path) -> None:
    """Raise LfsPointerError for a Git LFS pointer in a folder, or in one that lies in it."""
    for pattern in ("*", "*/*") if folder.is_dir() else ():
        for file in sorted(folder.glob(pattern)):
            check_no_pointer(file)


def _check_beginning(path: Path, beginning: bytes) -> None:
    if not beginning.startswith(_POINTER):
        return
    size = _POINTED_SIZE.search(beginning)
    stands = f" of {int(size[1]):,} bytes" if size else ""
    clone = next((folder for folder in path.absolute().parents if (folder / ".git").exists()), None)
    where = f"in {clone}" if clone else "in the clone that it was copied from, and copy it again"
    raise LfsPointerError(
        f"{path} is a Git LFS pointer, which stands for a file{stands} that was not fetched: expected the file "
        f"itself. Run `git lfs pull` {where}"
    )


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


# -- YAML -----------------------------------------------------------------------------------------------------

MOST_NODES = 1_000_000
"""The most values of a YAML file, where an alias counts as all that it stands for."""
_MOST_YAML_BYTES = 16 << 20
"""The largest YAML file, for which yaml takes 3.5 minutes; for `MOST_BYTES` json takes 3 seconds."""


def load_yaml(file: Path) -> Any:
    """Return the value in a file of safe YAML.

    Raises:
        OSError: For a file that `read_regular` refuses.
        ValueError: For other text, and for text that nests too deeply. Also for aliases that stand for more than
            `MOST_NODES` values: nine lines can stand for a billion.
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
    """Return the number of values below one, where an alias counts as all that it stands for."""
    if not isinstance(value, dict | list | set | tuple):
        return 1
    if id(value) not in counted:
        children = value.values() if isinstance(value, dict) else value
        counted[id(value)] = 1 + sum(_nodes(child, counted) for child in children)
    return counted[id(value)]


# -- JSON -----------------------------------------------------------------------------------------------------

MOST_VALUES = 1 << 25
"""The most values of one text; in Python each takes 8 to 80 bytes, however short it is written."""
_HALF = re.compile(r"\\u[dD][89a-fA-F]")
"""An escape of half a surrogate pair, whose other half may be missing."""


def parse_json(content: bytes | str, **options: Any) -> Any:
    """Return the value of a JSON text; `options` are hooks of `json.loads`.

    Raises:
        ValueError: For text that is not UTF-8 or JSON, nests too deeply, has half characters, repeats a key, or
            may hold more than `MOST_VALUES` values.
    """
    try:
        text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
        # Every value but the first comes after one of these signs, which texts may hold as well.
        if len(text) > MOST_VALUES and (most := sum(map(text.count, ",[{"))) > MOST_VALUES:
            raise ValueError(f"it may hold {most:,} values; expected at most {MOST_VALUES:,}")
        value = json.loads(text, object_pairs_hook=_distinct, **options)
        # Half a pair cannot be encoded; of a text without such escapes that is known without writing it again.
        (json.dumps(value, ensure_ascii=False) if _HALF.search(text) else text).encode()
    except RecursionError:
        raise ValueError("it nests too deeply") from None
    except UnicodeEncodeError:
        raise ValueError("it holds half a surrogate pair, which is not a character") from None
    return value


def parse_strict_json(content: bytes) -> Any:
    """Return the value of JSON that probe_kit wrote itself.

    Raises:
        ValueError: For what `parse_json` refuses, for a byte order mark, and for a number that is not finite.
    """
    if content.startswith(BOM_UTF8):
        raise ValueError("it begins with a byte order mark")
    return parse_json(content, parse_constant=_finite, parse_float=_finite)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it names the key {next(name for name in names if names.count(name) > 1)!r} twice")
    return content


def _finite(number: str) -> float:
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"it holds {number[:20]}, which is not a finite number")
    return value


def load_json(file: Path, most: int = MOST_BYTES) -> Any:
    """Return the value in a file of at most `most` bytes.

    Raises:
        OSError: For a file that `read_regular` refuses.
        ValueError: For a text that `parse_json` refuses.
    """
    return parse_json(read_regular(file, most))


def load_gzipped_json(file: Path) -> Any:
    """Return the value in a gzipped file of at most `MOST_BYTES` unpacked bytes. Raises as `load_json`."""
    with open_regular(file) as packed, gzip.open(packed) as unpacked:
        content = unpacked.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"it unpacks to more than {MOST_BYTES / 1e6:,.0f} MB")
    return parse_json(content)


_JSON_KINDS: dict[type, str] = {dict: "an object", list: "a list"}


def read_json(
    file: Path, raises: type[ProbeKitError], advice: str, most: int = MOST_BYTES, kind: type = object
) -> Any:
    """Return the value in a JSON file.

    Args:
        file: The file, which errors name.
        raises: The class of the error if the file is missing, too large, unreadable, no JSON, or of another kind.
        advice: The end of every message: a sentence without a period that says what to do.
        most: The largest size in bytes.
        kind: `dict` or `list` if the value must be one; `object` accepts every value.

    Raises:
        ProbeKitError: For any file that cannot be used, of class `raises`, with `advice`.
    """
    try:
        value = load_json(file, most)
    except FileNotFoundError:
        raise raises(f"{file} is missing. {advice}") from None
    except OSError as error:
        raise raises(f"{file} cannot be read ({error.strerror}). {advice}") from error
    except ValueError as error:
        raise raises(f"{file} is not JSON ({error}). {advice}") from error
    if not isinstance(value, kind):
        raise raises(f"{file} holds a JSON {type(value).__name__}; expected {_JSON_KINDS[kind]}. {advice}")
    return value


def read_json_object(file: Path, raises: type[ProbeKitError], advice: str) -> dict[str, Any]:
    """Return the object in a JSON file; errors are those of `read_json`."""
    value: dict[str, Any] = read_json(file, raises, advice, kind=dict)
    return value


# -- arrays ---------------------------------------------------------------------------------------------------

MOST_ARRAY_BYTES = 4 << 30
"""The most bytes of all arrays of a file, unpacked."""
UNREADABLE = (OSError, ValueError, EOFError, KeyError, AttributeError, RuntimeError, BadZipFile, zlib.error)
"""The errors of `open_arrays`, and of reading an array, if a file is none, damaged or asks for a password."""


def open_arrays(source: Path | BinaryIO | bytes) -> "NpzFile":
    """Open an `.npz` file; the result is a context manager that holds arrays by name. Nothing is unpickled.

    Raises:
        ValueError: For a file whose arrays have more than `MOST_ARRAY_BYTES` once they are unpacked.
        LfsPointerError: For a Git LFS pointer.
        Exception: One of `UNREADABLE` for a file that is no such file.
    """
    import numpy as np

    content: Any = BytesIO(source) if isinstance(source, bytes) else source
    if isinstance(content, Path):
        check_no_pointer(content)
    with ZipFile(content) as packed:
        size = sum(entry.file_size for entry in packed.infolist())
        if size > MOST_ARRAY_BYTES:
            raise ValueError(
                f"its arrays have {size / 1e6:,.0f} MB unpacked; expected at most {MOST_ARRAY_BYTES / 1e6:,.0f} MB"
            )
        for entry in packed.infolist():
            _check_header(packed, entry)
    if not isinstance(content, Path):
        content.seek(0)
    archive: NpzFile = np.load(content, allow_pickle=False)
    return archive


def _check_header(packed: ZipFile, entry: ZipInfo) -> None:
    """Raise ValueError for an array whose header claims other bytes than it has: numpy allocates room for all."""
    from numpy.lib import format as npy

    with packed.open(entry) as file:
        if file.read(len(npy.MAGIC_PREFIX)) != npy.MAGIC_PREFIX:
            return  # no array: numpy gives its bytes as they are
        headers: dict[bytes, Any] = {b"\1\0": npy.read_array_header_1_0, b"\2\0": npy.read_array_header_2_0}
        read = headers.get(file.read(2))
        if read is None:
            raise ValueError(f"its array {entry.filename!r} has a format that probe_kit never wrote")
        try:
            shape, _, dtype = read(file)
        except (MemoryError, RecursionError, TokenError, TypeError, SyntaxError) as error:
            # numpy parses a header as Python, whose parser gives up in many ways.
            raise ValueError(f"its array {entry.filename!r} has no readable header ({error!r})") from None
        start = file.tell()
    size = math.prod(shape) * dtype.itemsize
    if (
        any(isinstance(axis, bool) or axis < 0 for axis in shape)
        or (not dtype.itemsize and math.prod(shape))  # of values without bytes there can be any number
        or start + size != entry.file_size
    ):
        raise ValueError(
            f"its array {entry.filename!r} claims shape {shape} of {dtype}, {size:,} bytes, and "
            f"{entry.file_size - start:,} are there"
        )
