"""Every array of a run as it is stored: HDF5 and safetensors."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from probe_kit.runs.layout import ArrayKind
from probe_kit.runs.rows import Rows
from probe_kit.runs.run import Run


def _arrays(run: Run) -> Iterator[tuple[str, str, Rows]]:
    """Stream, kind and rows of every array of the run."""
    tokens: tuple[ArrayKind, ...] = ("tokens",) if run.settings["tokens"] == "all" else ()
    for stream in run.streams:
        for kind in (*run.root.vector_kinds, *tokens):
            yield stream, kind, run.rows(stream, kind)


def _episodes(run: Run) -> dict[str, list[Any]]:
    table = run.episodes
    columns: dict[str, list[Any]] = json.loads(table.to_json(orient="split"))
    return {name: [row[i] for row in columns["data"]] for i, name in enumerate(columns["columns"])}


def write_h5(run: Run, out: Path) -> None:
    """A dataset per array, and one per column of the episodes."""
    import h5py  # loads its C library, which only this format needs

    with out.open("w+b", buffering=0) as raw:
        safe = _SafeFile(raw)
        with h5py.File(safe, "w") as file:
            _fill(file, run, safe)
        safe.check()


def _fill(file: Any, run: Run, safe: "_SafeFile") -> None:
    file.attrs["settings"] = json.dumps(run.settings)
    for stream, kind, rows in _arrays(run):
        shape = rows.array.shape[1:]
        dataset = file.create_dataset(
            f"{stream}/{kind}", (len(rows), *shape), rows.array.dtype, chunks=(1, *shape), fletcher32=True
        )
        dataset.attrs["views"] = list(run.views(stream))
        dataset.attrs["dtype"] = "float32" if kind == "pooled" else "bfloat16 bits"
        for position, row in enumerate(rows):
            dataset[position] = row
            if safe.error is not None:  # the library does not know of it and would go through all episodes
                return
    for name, values in _episodes(run).items():
        # HDF5 has no column of mixed types, and no null among numbers: such a column becomes text.
        numeric = all(isinstance(value, bool | int | float) for value in values)
        file[f"episodes/{name}"] = values if numeric else ["" if v is None else str(v) for v in values]


class _SafeFile(io.RawIOBase):
    """A file that tells the HDF5 library of no failed write and keeps the error.

    The library crashes the process when it closes a file that it could not write, as on a full disk.
    """

    def __init__(self, raw: io.FileIO) -> None:
        self._raw = raw
        self.error: OSError | None = None

    def check(self) -> None:
        """Raise the first error of the file."""
        if self.error is not None:
            raise self.error

    def write(self, content: Any) -> int:
        """Write all of it; after an error nothing is written."""
        unwritten = memoryview(content).cast("B")
        length = len(unwritten)
        try:
            while unwritten and self.error is None:
                unwritten = unwritten[self._raw.write(unwritten) or 0 :]
        except OSError as error:
            self.error = error
        return length

    def readinto(self, buffer: Any) -> int:
        """Read as far as the file goes."""
        return self._raw.readinto(buffer) or 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place of the file."""
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        """Return the place in the file."""
        return self._raw.tell()

    def truncate(self, size: int | None = None) -> int:
        """Change the length of the file."""
        try:
            return self._raw.truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def flush(self) -> None:
        """Do nothing: the file has no buffer."""


def write_safetensors(run: Run, out: Path) -> None:
    """A tensor per array; settings, episodes and names of views in the metadata."""
    header: dict[str, Any] = {
        "__metadata__": {
            "settings": json.dumps(run.settings),
            "episodes": json.dumps(_episodes(run)),
            **{f"{stream}.views": json.dumps(run.views(stream)) for stream in run.streams},
        }
    }
    end = 0
    for stream, kind, rows in _arrays(run):
        shape = [len(rows), *rows.array.shape[1:]]
        start, end = end, end + int(np.prod(shape)) * rows.array.dtype.itemsize
        dtype = "F32" if kind == "pooled" else "BF16"
        header[f"{stream}.{kind}"] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
    with out.open("wb") as file:
        _write_header(file, header)
        for _, _, rows in _arrays(run):
            for row in rows:
                file.write(np.ascontiguousarray(row).tobytes())


def _write_header(file: BinaryIO, header: dict[str, Any]) -> None:
    """Length, then JSON padded to eight bytes, as the format wants it."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    file.write(len(text).to_bytes(8, "little") + text)
