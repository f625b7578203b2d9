"""Sealing and verification of a run: columns for each site and view; every record, object and reader is checked.

Files can be intact and still be refused by a reader, such as probes in the folder of interventions. So deep
verification also calls the functions that read, and fails wherever one of them would.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import batched
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from probe_kit._system.escaping import as_argument
from probe_kit.errors import MissingExtraError, ProbeKitError, RunDamagedError
from probe_kit.hooks.checkpoints.third_party import import_object
from probe_kit.hooks.contract.sites import PADDING
from probe_kit.runs.array_store import ArrayStore
from probe_kit.runs.arrays import EpisodeRows, create_array, open_array
from probe_kit.runs.columns import Columns, columns_folder, find_columns, seal_key, write_seal
from probe_kit.runs.commits import Commit, numbered_objects, read_commit, read_failures, read_seconds
from probe_kit.runs.contents import StoredObject, sizes_of, stored_objects, stray_keys
from probe_kit.runs.layout import COLUMNS, COMMITS, DATA, SEALED, StoredStream, VectorKind
from probe_kit.runs.plan import count_plans
from probe_kit.runs.provenance import read_processes
from probe_kit.runs.records import RESTORE, digest_of, exact_records, is_hash_name
from probe_kit.runs.results import BUNDLES, bundle_keys, read_bundle
from probe_kit.runs.root import Root, read_label, read_root
from probe_kit.runs.run import Run, read_run
from probe_kit.runs.store import Location, locate

EPISODES_PER_CHUNK = 1024
"""The episodes of one object: a column of no more episodes is one object, which one request reads."""
SLAB_BYTES = 1 << 30
"""The bytes that are held in memory at a time; all rows are read once more for every further slab."""


def seal(path: Path | str | Location, deep: bool = False) -> bool:
    """Write the columns of the run at `path` unless they are there; return whether this call wrote them.

    Equal commits give equal bytes. A crash leaves the old columns or none. Processes that seal one folder at once
    take turns, and all but the first find it done. Damaged columns are written anew.

    Args:
        path: The folder or address of the run.
        deep: Compare every byte of columns that are there, and write again what else of the run follows from its
            other records. By default only missing objects are noticed.
    """
    location = Run(locate(path)).location
    with location.locked(lambda: None), location.take_turns(DATA):  # a folder that is never exchanged
        run = read_run(location)
        if deep and not run.root.left_out:
            run.restore_records()
        return _seal(run, deep)


def _seal(run: Run, deep: bool = False) -> bool:
    if not run.root.left_out:
        run.root.set_lengths()  # once more: of two processes that made it grow, the first may have written last
    if not run.streams or run.episodes.empty:
        return False
    if run.root.left_out:
        run.root.refuse_left_out("there is nothing to seal")
    commits = {commit.episode: commit for commit in run.commits()}
    if _are_whole(run.location, find_columns(run.root, commits, skip_damaged=True), deep):
        _remove_former(run)
        return False
    run.location.remove(SEALED)  # nothing counts that is not whole
    folder = columns_folder(run.stamp)
    store = ArrayStore(run.location, folder, {})  # what a killed process left there does not exist for it
    # With its attributes at once: of processes that seal a bucket together, each finds the bytes that it wrote.
    group = zarr.open_group(store, mode="w", zarr_format=3, attributes={"stamp": run.stamp})
    for name in run.streams:
        for kind in run.root.vector_kinds:
            _write_vectors(run, name, kind, group)
        _write_roles(run, name, group)
    run.location.flush(f"{folder}/{key}" for key in store.written)
    write_seal(run.root, commits, store.written)  # what makes them count, so last
    _remove_former(run)
    return True


def _are_whole(location: Location, columns: Columns | None, deep: bool) -> bool:
    """Whether there are columns with all objects, and with `deep` each of its size and bytes."""
    if columns is None:
        return False
    sizes = location.sizes(columns.folder, columns.sums)
    # Not the sizes, unless the user asks: in a bucket, another process may be writing the same columns just now.
    if not deep:
        return sizes.keys() == columns.sums.keys()
    if any(expected.size_problem(sizes.get(key)) for key, expected in columns.sums.items()):
        return False
    objects = (StoredObject(f"{columns.folder}/{key}", expected, "") for key, expected in columns.sums.items())
    return not any(_content_problems(location, objects))


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
    block, lead = min(episodes, EPISODES_PER_CHUNK), _lead(stored, rows, kind)
    array = create_array(
        group, f"{name}/{kind}", (*lead, episodes, stored.width), (*(1 for _ in lead), block, stored.width),
        rows.array.dtype, rows.array.fill_value, run.settings["codec"],
        ("call" if kind == "pooled" else "later_call", *(["view"] * (kind == "pooled")), *stored.dimensions,
         "episode", "feature"),
        dict(rows.array.attrs),
    )  # fmt: skip
    for index, column in columns_of_rows(run, name, kind):
        array[index] = column


def _lead(stored: StoredStream, rows: EpisodeRows, kind: VectorKind) -> tuple[int, ...]:
    """Return the axes of the columns before episode and feature."""
    views = (len(stored.views),) if kind == "pooled" else ()
    return (rows.array.shape[1], *views, *stored.lead)


def columns_of_rows(
    run: "Run", name: str, kind: VectorKind
) -> Iterator[tuple[tuple[Any, ...], NDArray[np.float32 | np.uint16]]]:
    """Yield every chunk of the columns of a stream as its rows give it: its index, and values (E, D)."""
    stored, rows = run.stored(name), run.rows(name, kind)
    episodes, size = len(rows), rows.array.dtype.itemsize
    cells = list(np.ndindex(_lead(stored, rows, kind)))
    for start in range(0, episodes, EPISODES_PER_CHUNK):
        stop = min(start + EPISODES_PER_CHUNK, episodes)
        for slab in batched(cells, max(1, SLAB_BYTES // ((stop - start) * stored.width * size))):
            values = np.empty((len(slab), stop - start, stored.width), rows.array.dtype)
            for position, stored_row in enumerate(rows.between(start, stop)):
                row = np.moveaxis(stored_row, -2, 1) if kind == "pooled" else stored_row
                values[:, position] = row[tuple(np.transpose(slab))]
            for cell, column in zip(slab, values, strict=True):
                yield (*cell, slice(start, stop)), column


def _write_roles(run: "Run", name: str, group: zarr.Group) -> None:
    spans = [[call[name] for call in commit.roles] for commit in run.commits()]
    names = [PADDING, *sorted({role for calls in spans for call in calls for role, _, _ in call} - {PADDING})]
    codes = np.zeros((run.settings["captured_calls"], len(spans), run.stored(name).stored_tokens), np.uint8)
    for episode, calls in enumerate(spans):
        for number, call in enumerate(calls):
            for role, start, stop in call:
                codes[number, episode, start:stop] = names.index(role)
    chunks = (1, min(len(spans), EPISODES_PER_CHUNK), codes.shape[2])
    array = create_array(
        group, f"{name}/role", codes.shape, chunks, "uint8", 0, run.settings["codec"],
        # Another name where the pooled views are of the first inference alone, and so of another length.
        ("call" if len(run.root.vector_kinds) == 1 else "captured_call", "episode", "token"), {"roles": names},
    )  # fmt: skip
    array[:] = codes


# -- verification ------------------------------------------------------------------------------------------------


_READERS = min(8, max(4, os.cpu_count() or 1))
"""The objects that are read and hashed at once: both let other threads work."""
_BATCH = 256
"""The objects that are handed to the threads at a time."""
_RESULT_READERS = (
    "probe_kit.train.results.inventory:readers_of_results",
    "probe_kit.intervene.inventory:readers_of_results",
)
"""The functions that give a reader per stored result of a run. They lie in folders above."""


@dataclass(frozen=True)
class Audit:
    """The result of a verification.

    Attributes:
        committed: The number of committed episodes.
        planned: The number of planned episodes.
        failed: The number of episodes that were given up.
        sealed: Whether columns belong to these commits.
        deep: Whether every byte was read, not only sizes.
        problems: One sentence each.
        strays: The keys of objects that belong to no part of the run and that nothing reads, such as copies made
            by hand.
        left_out: The arrays that the run, a copy, was made without.
    """

    path: str
    committed: int
    planned: int
    failed: int
    sealed: bool
    deep: bool
    problems: tuple[str, ...]
    strays: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing is damaged; an unfinished run can be whole as far as it goes."""
        return not self.problems

    @property
    def finished(self) -> bool:
        """Whether every planned episode is committed; an older state of a run is whole, but not finished."""
        return self.ok and 0 < self.planned == self.committed


def verify_run(path: Path | str | Location, deep: bool = False) -> Audit:
    """Compare a run with its records. Problems are collected, not raised.

    Compares records by their values, the sizes of all objects, and their owners. With `deep` it also compares
    every byte, those of records among them, columns against rows, and every reader of the run and of its stored
    results.

    Raises:
        RunNotFoundError: If there is no run at `path`.
    """
    location = locate(path)
    while True:
        before = count_plans(location)
        with exact_records(deep):
            audit = _audit(location, deep)
        if audit.ok or count_plans(location) == before:  # else it grew while it was compared
            return audit


def _audit(location: Location, deep: bool) -> Audit:
    try:
        root = read_root(location)
        planned, _ = len(root.plan), root.streams
    except RunDamagedError as error:  # nothing can be said of the other parts
        return Audit(str(location), 0, 0, 0, False, deep, (str(error),))
    problems: list[str] = []

    def check_part[T](read: Callable[[], T], otherwise: T) -> T:
        """Return the part of the run that `read` reads; its error is kept as a problem."""
        try:
            return read()
        except RunDamagedError as error:
            problems.append(str(error))
            return otherwise

    commits: dict[int, Commit] = {}
    for number, key, raw in numbered_objects(location, COMMITS):
        if commit := check_part(partial(read_commit, root, number, key, raw), None):
            commits[number] = commit
    try:
        left_out = root.left_out
    except RunDamagedError as error:  # whether objects are missing on purpose is not known
        return Audit(str(location), len(commits), planned, 0, False, deep, (*problems, str(error)))
    check_part(lambda: _check_records(root, commits), None)
    check_part(lambda: read_seconds(root, commits), None)
    failures = check_part(lambda: len(read_failures(root)), 0)
    columns = check_part(lambda: find_columns(root, commits), None)
    for home in BUNDLES:
        for key in bundle_keys(location, home):
            check_part(partial(read_bundle, location, home, key), None)
    objects = list(stored_objects(root, commits, columns))
    sizes = sizes_of(location, objects)
    problems += filter(None, (stored.problem(sizes.get(stored.key)) for stored in objects))
    if deep:
        problems += _content_problems(location, objects)
    for key in root.card.objects:
        check_part(partial(root.read_metadata, key), b"")
    if deep and not problems and planned:  # readers of a damaged run would only repeat what is known
        run = Run(location)
        problems += _differences(run) if columns is not None else ()
        problems += _reading_problems(run)
    return Audit(
        path=str(location),
        committed=len(commits),
        planned=planned,
        failed=failures,
        sealed=columns is not None,
        deep=deep,
        problems=tuple(problems),
        strays=() if problems else tuple(stray_keys(root, commits, columns, objects)),
        left_out=tuple(sorted(left_out)),
    )


def _check_records(root: Root, commits: Mapping[int, Commit]) -> None:
    """Raise RunDamagedError if label, provenances or certificates were changed or are lost."""
    read_label(root)
    processes = read_processes(root, {commit.provenance for commit in commits.values()})
    if remade := sorted(processes.remade):
        raise RunDamagedError(
            f"{root.location}/{remade[0]} is missing. Other records say the same: `probe-kit run verify "
            f"{as_argument(root.location)} --seal` writes it again"
        )


def _content_problems(location: Location, objects: Iterable[StoredObject]) -> Iterator[str]:
    """Yield objects with other bytes than were written, in the order of `objects`; sizes were checked before."""

    def problem(stored: StoredObject) -> str | None:
        try:
            length, digest = digest_of(location.pieces(stored.key), stored.stored_sum.length)
        except FileNotFoundError:
            return None
        if length != stored.stored_sum.length or digest == stored.stored_sum.digest:
            return None
        return f"{stored.key}{stored.owner} has other bytes than were written. {stored.advice}"

    with ThreadPoolExecutor(_READERS) as readers:
        for batch in batched(objects, _BATCH):
            yield from filter(None, readers.map(problem, batch))


def _differences(run: Run) -> Iterator[str]:
    """Yield columns that differ from what the rows give, and what cannot be read."""
    columns = run.columns
    assert columns is not None
    for stream in run.streams:
        try:
            for kind in run.root.vector_kinds:
                array = columns.array(f"{stream}/{kind}")
                for index, expected in columns_of_rows(run, stream, kind):
                    if not np.array_equal(np.asarray(array[index]), expected, equal_nan=True):
                        chunk = f"{columns.folder}/{stream}/{kind} at {index}"
                        yield f"{chunk} is not what the rows give. {columns.advice}"
        except RunDamagedError as error:
            yield str(error)


def _reading_problems(run: Run) -> Iterator[str]:
    """Yield the complaints of all readers of a run and of the results that are stored with it."""
    yield from _complaints(run.check_records)
    yield from _complaints(lambda: (run.episodes, run.items, run.failed))
    if not run.commits():
        return
    for name in run.root.arrays:
        if name not in run.root.left_out:
            # Metadata of others may claim what no run has. One row shows that; the others have their hashes.
            yield from _complaints(partial(_read_first, run, name))
    if run.has_trajectories:
        for row in range(len(run.episodes)):
            yield from _complaints(partial(run.trajectory, row))
    for name in _RESULT_READERS:
        listing: Callable[[Run], Iterator[Callable[[], object]]] = import_object(name)
        try:
            readers = list(listing(run))
        except RunDamagedError as error:
            yield str(error)
            continue
        for reader in readers:
            yield from _complaints(reader)


def _read_first(run: Run, name: str) -> None:
    EpisodeRows(open_array(run.data, name), [min(commit.episode for commit in run.commits())])[0]


def _complaints(reader: Callable[[], object]) -> Iterator[str]:
    """Yield the error of a reader, if it raises one; a library that is not installed is no error of the run."""
    try:
        reader()
    except MissingExtraError:
        return
    except ProbeKitError as error:
        yield str(error)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OSError) as error:
        yield f"a stored result cannot be read ({type(error).__name__}: {error}). {RESTORE}"
