"""Reading of foreign `.npz` files: their sizes are read before their arrays are unpacked."""

import math
import zlib
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, BinaryIO
from zipfile import BadZipFile, ZipFile, ZipInfo

if TYPE_CHECKING:
    from numpy.lib.npyio import NpzFile

MOST_BYTES = 4 << 30
"""Of all arrays of a file, unpacked."""
UNREADABLE = (OSError, ValueError, EOFError, KeyError, AttributeError, RuntimeError, BadZipFile, zlib.error)
"""What `open_arrays`, and reading of an array, raise for a file that is none, damaged or asks for a password."""


def open_arrays(source: Path | BinaryIO | bytes) -> "NpzFile":
    """Open an `.npz` file; a context manager that holds arrays by name. Nothing is unpickled.

    Raises ValueError for a file whose arrays have more than `MOST_BYTES` once they are unpacked, and one of
    `UNREADABLE` for one that is no such file.
    """
    import numpy as np

    content: Any = BytesIO(source) if isinstance(source, bytes) else source
    with ZipFile(content) as packed:
        size = sum(entry.file_size for entry in packed.infolist())
        if size > MOST_BYTES:
            raise ValueError(
                f"its arrays have {size / 1e6:,.0f} MB unpacked; expected at most {MOST_BYTES / 1e6:,.0f} MB"
            )
        for entry in packed.infolist():
            _check_header(packed, entry)
    if not isinstance(content, Path):
        content.seek(0)
    archive: NpzFile = np.load(content, allow_pickle=False)
    return archive


def _check_header(packed: ZipFile, entry: ZipInfo) -> None:
    """Raise ValueError for an array whose header claims other bytes than are there: numpy makes room for all."""
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
