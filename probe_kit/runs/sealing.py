"""Sealing: turns pooled rows into one block per site and view, and roles into a column."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import PADDING
from probe_kit.runs.arrays import codecs
from probe_kit.runs.checking import BlankStore
from probe_kit.runs.columns import columns_folder, seal_key, write_seal
from probe_kit.runs.layout import COLUMNS, DATA, SEALED, StoredStream, VectorKind
from probe_kit.runs.records import is_hash_name
from probe_kit.runs.rows import Rows
from probe_kit.runs.run import Run, read_run
from probe_kit.runs.store import Location, locate

EPISODES_PER_CHUNK = 1024
"""A column of no more episodes is one object, which one request reads."""
SLAB_BYTES = 1 << 30
"""Bytes that are held in memory at a time; all rows are read once more for every further slab."""


def seal(path: Path | str | Location) -> bool:
    """Write the columns of the run at `path` unless they are up to date; True if this call wrote them.

    Same commits give the same bytes. A crash leaves the old columns or none. Processes that seal one folder at
    once take turns, and all but the first find it done.
    """
    location = Run(locate(path)).location
    with location.locked(lambda: None), location.tended(DATA):  # a folder that is never exchanged
        return _seal(read_run(location))


def _seal(run: Run) -> bool:
    if not run.streams or run.episodes.empty:
        return False
    if run.root.left_out:
        run.root.refuse_left_out("there is nothing to seal")
    if run.sealed:
        _remove_former(run)
        return False
    run.location.remove(SEALED)  # nothing counts that is not whole
    folder = columns_folder(run.stamp)
    store = BlankStore(run.location.store(folder))
    group = zarr.open_group(store, mode="w", zarr_format=3)
    for name in run.streams:
        for kind in run.root.vector_kinds:
            _write_vectors(run, name, kind, group)
        _write_roles(run, name, group)
    group.attrs["stamp"] = run.stamp
    run.location.flush(f"{folder}/{key}" for key in store.sums)
    commits = {commit.episode: commit for commit in run.commits()}
    write_seal(run.root, commits, store.sums)  # what makes them count, so last
    _remove_former(run)
    return True


def _remove_former(run: Run) -> None:
    """Remove columns and seals of other commits; a process that saw fewer may have written some late."""
    folder = columns_folder(run.stamp)
    former = {key.split("/")[1] for key in run.location.keys(COLUMNS) if not key.startswith(f"{folder}/")}
    for name in former:
        run.location.remove(f"{COLUMNS}/{name}")
    for key in run.location.keys(SEALED):
        if is_hash_name(key.removeprefix(f"{SEALED}/")) and key != seal_key(run.stamp):
            run.location.delete(key)


def _write_vectors(run: "Run", name: str, kind: VectorKind, group: zarr.Group) -> None:
    stored, rows = run.stored(name), run.rows(name, kind)
    episodes = len(rows)
    block, lead = _block(episodes), _lead(stored, rows, kind)
    array = group.create_array(
        f"{name}/{kind}",
        shape=(*lead, episodes, stored.width),
        chunks=(*(1 for _ in lead), block, stored.width),
        dtype=rows.array.dtype,
        fill_value=rows.array.fill_value,
        compressors=codecs(run.settings["codec"], typesize=rows.array.dtype.itemsize),
        dimension_names=("call", *(["view"] * (kind == "pooled")), *stored.dimensions, "episode", "feature"),
        attributes=dict(rows.array.attrs),
        config={"write_empty_chunks": True},
    )
    for index, column in columns_of_rows(run, name, kind):
        array[index] = column


def _lead(stored: StoredStream, rows: Rows, kind: VectorKind) -> tuple[int, ...]:
    """Axes of the columns before episode and feature."""
    views = (len(stored.views),) if kind == "pooled" else ()
    return (rows.array.shape[1], *views, *stored.lead)


def columns_of_rows(
    run: "Run", name: str, kind: VectorKind
) -> Iterator[tuple[tuple[Any, ...], NDArray[np.float32 | np.uint16]]]:
    """Every chunk of the columns of a stream as its rows have it: where it belongs, and (E, D) values."""
    stored, rows = run.stored(name), run.rows(name, kind)
    episodes, size = len(rows), rows.array.dtype.itemsize
    cells = list(np.ndindex(_lead(stored, rows, kind)))
    for start in range(0, episodes, _block(episodes)):
        stop = min(start + _block(episodes), episodes)
        for slab in _slabs(cells, (stop - start) * stored.width * size):
            values = np.empty((len(slab), stop - start, stored.width), rows.array.dtype)
            for position, stored_row in enumerate(rows.between(start, stop)):
                row = np.moveaxis(stored_row, -2, 1) if kind == "pooled" else stored_row
                values[:, position] = row[tuple(np.transpose(slab))]
            for cell, column in zip(slab, values, strict=True):
                yield (*cell, slice(start, stop)), column


def _block(episodes: int) -> int:
    """Episodes per chunk."""
    return min(episodes, EPISODES_PER_CHUNK)


def _slabs(cells: list[tuple[int, ...]], bytes_per_cell: int) -> Iterator[list[tuple[int, ...]]]:
    count = max(1, SLAB_BYTES // bytes_per_cell)
    for start in range(0, len(cells), count):
        yield cells[start : start + count]


def _write_roles(run: "Run", name: str, group: zarr.Group) -> None:
    spans = [[call[name] for call in commit.roles] for commit in run.commits()]
    names = [PADDING, *sorted({role for calls in spans for call in calls for role, _, _ in call} - {PADDING})]
    codes = np.zeros((run.settings["captured_calls"], len(spans), run.stored(name).stored_tokens), np.uint8)
    for episode, calls in enumerate(spans):
        for number, call in enumerate(calls):
            for role, start, stop in call:
                codes[number, episode, start:stop] = names.index(role)
    array: zarr.Array[Any] = group.create_array(
        f"{name}/role",
        shape=codes.shape,
        chunks=(1, min(len(spans), EPISODES_PER_CHUNK), codes.shape[2]),
        dtype="uint8",
        fill_value=0,
        compressors=codecs(run.settings["codec"], typesize=1),
        dimension_names=("call", "episode", "token"),
        attributes={"roles": names},
        config={"write_empty_chunks": True},
    )
    array[:] = codes
