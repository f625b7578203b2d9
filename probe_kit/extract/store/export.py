"""Export of a run as one file, for tools that need one, or as a folder of films.

Everything is written row by row, so that a run larger than memory can be exported; every row passes its checksum
on the way, and the sha256 of the file is written beside it in the form `sha256sum --check` reads.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from probe_kit._system.drafts import draft_of, write_whole
from probe_kit._system.optional_dependencies import require
from probe_kit.errors import UsageError
from probe_kit.extract.run_layout import LATER, MEAN_VIEW, ArrayKind, ExportFormat, StoredStream
from probe_kit.extract.store.films.lerobot_dataset import write_lerobot
from probe_kit.extract.store.films.videos import write_films
from probe_kit.extract.store.format.arrays import decode_bfloat16
from probe_kit.extract.store.format.rows import Rows
from probe_kit.extract.store.locations.location import Location
from probe_kit.extract.store.run import Run, open_run


def export_run(path: Path | str | Location, style: ExportFormat, out: Path, allow_partial: bool = False) -> Path:
    """Write the run at `path` to `out`, whole or not at all, and the sha256 of a file beside it; returns `out`.

    h5: `<stream>/pooled`, `<stream>/later`, `<stream>/tokens`, and a dataset per column under `episodes`.
    safetensors: the same with a dot, the last two true bfloat16; episodes in the metadata.
    parquet: a row per episode, inference, site and view with its vector; no tokens.
    mp4: a folder with a film per episode. lerobot: a LeRobotDataset. Both need a run with `--frames all`.
    Array axes are (episode, call, [iteration,] layer, view or token, feature).
    Raises UsageError for another format or a file that exists, MissingExtraError, RunDamagedError.
    """
    check_format(style)
    if out.exists():
        raise UsageError(f"{out} exists; choose another --out or remove it")
    run = open_run(path, allow_partial)
    if style in FOLDER_WRITERS:
        with draft_of(out) as draft:
            FOLDER_WRITERS[style](run, draft)
            return draft.rename(out)
    if not run.streams:
        raise UsageError(f"{path} has no activations to export; its episodes are in `open_run(...).episodes`")
    with draft_of(out) as draft:
        WRITERS[style](run, draft)
        with draft.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        write_whole(out.with_name(f"{out.name}.sha256"), f"{digest}  {out.name}\n")
        return draft.rename(out)  # last: the file never lies there without its hash


def check_format(style: str) -> None:
    """Raise UsageError for a format that is not offered."""
    if style not in (known := {**WRITERS, **FOLDER_WRITERS}):
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(known)}")


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


def _write_h5(run: Run, out: Path) -> None:
    import h5py  # loads its C library, which only this format needs

    with h5py.File(out, "w") as file:
        file.attrs["settings"] = json.dumps(run.settings)
        for stream, kind, rows in _arrays(run):
            shape = rows.array.shape[1:]
            dataset = file.create_dataset(
                f"{stream}/{kind}", (len(rows), *shape), rows.array.dtype, chunks=(1, *shape), fletcher32=True
            )
            dataset.attrs["views"] = list(run.views(stream))
            dataset.attrs["dtype"] = "float32" if kind == "pooled" else "bfloat16 bits"
            for position in range(len(rows)):
                dataset[position] = rows[position]
        for name, values in _episodes(run).items():
            numeric = all(isinstance(value, bool | int | float) for value in values)
            file[f"episodes/{name}"] = values if numeric else ["" if v is None else str(v) for v in values]


def _write_safetensors(run: Run, out: Path) -> None:
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
            for position in range(len(rows)):
                file.write(np.ascontiguousarray(rows[position]).tobytes())


def _write_header(file: BinaryIO, header: dict[str, Any]) -> None:
    """Length, then JSON padded to eight bytes, as the format wants it."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    file.write(len(text).to_bytes(8, "little") + text)


def _write_parquet(run: Run, out: Path) -> None:
    pa, pq = require("pyarrow", "export"), require("pyarrow.parquet", "export")
    keys = ["episode_id", "item_id", "category", "layout", "side_correct", "outcome"]
    keys = [key for key in keys if key in run.episodes]
    fields = [*((key, pa.string()) for key in keys), ("call", pa.int32()), ("site", pa.string())]
    schema = pa.schema([*fields, ("view", pa.string()), ("vector", pa.list_(pa.float32()))])
    arrays = [(run.stored(stream), kind, rows) for stream, kind, rows in _arrays(run) if kind != "tokens"]
    with pq.ParquetWriter(out, schema) as writer:
        for position, episode in enumerate(run.episodes[keys].to_dict("records")):
            vectors = [one for stored, kind, rows in arrays for one in _vectors(stored, kind, rows[position])]
            writer.write_table(pa.Table.from_pylist([{**episode, **vector} for vector in vectors], schema))


def _vectors(stored: StoredStream, kind: str, row: Any) -> Iterator[dict[str, Any]]:
    later = kind == LATER
    views = (MEAN_VIEW,) if later else stored.views
    for call, captured in enumerate(decode_bfloat16(row)[..., None, :] if later else row, start=int(later)):
        for site in stored.stream.sites():
            for view, vector in zip(views, captured[stored.at(site)], strict=True):
                yield {"call": call, "site": str(site), "view": view, "vector": vector}


FOLDER_WRITERS: dict[ExportFormat, Callable[[Run, Path], None]] = {"mp4": write_films, "lerobot": write_lerobot}
WRITERS: dict[ExportFormat, Callable[[Run, Path], None]] = {
    "h5": _write_h5,
    "safetensors": _write_safetensors,
    "parquet": _write_parquet,
}
