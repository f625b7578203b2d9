"""Reading of foreign `.npz` files: their sizes are read before their arrays are unpacked."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from zipfile import ZipFile

if TYPE_CHECKING:
    from numpy.lib.npyio import NpzFile

MOST_BYTES = 4 << 30
"""Of all arrays of a file, unpacked."""


def open_arrays(source: Path | BinaryIO | bytes) -> "NpzFile":
    """Open an `.npz` file; a context manager that holds arrays by name. Nothing is unpickled.

    Raises ValueError for a file whose arrays have more than `MOST_BYTES` once they are unpacked, and what
    `zipfile` and numpy raise for one that is no such file.
    """
    import numpy as np

    content: Any = BytesIO(source) if isinstance(source, bytes) else source
    with ZipFile(content) as packed:
        size = sum(entry.file_size for entry in packed.infolist())
    if size > MOST_BYTES:
        raise ValueError(
            f"its arrays have {size / 1e6:,.0f} MB unpacked; expected at most {MOST_BYTES / 1e6:,.0f} MB"
        )
    if not isinstance(content, Path):
        content.seek(0)
    found: NpzFile = np.load(content, allow_pickle=False)
    return found
