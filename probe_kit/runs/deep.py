"""Deep verification of a run: every byte against its hash, the columns against the rows, and every reader.

Reading refuses more than other bytes, such as probes in the folder of interventions. So verification calls the
functions that read: it says no wherever one of them would.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice

import numpy as np

from probe_kit.errors import MissingExtraError, ProbeKitError, RunDamagedError
from probe_kit.hooks.family import imported
from probe_kit.runs.arrays import open_array
from probe_kit.runs.columns import Columns
from probe_kit.runs.commits import Commit, pictures_of, redo, redo_picture
from probe_kit.runs.layout import DATA
from probe_kit.runs.plans import RESTORE
from probe_kit.runs.records import digest_of
from probe_kit.runs.root import Root
from probe_kit.runs.rows import Rows
from probe_kit.runs.run import Run
from probe_kit.runs.sealing import columns_of_rows
from probe_kit.runs.store import Location

READERS = min(8, max(4, os.cpu_count() or 1))
"""Objects that are read and hashed at once: both let other threads work."""
BATCH = 256
RESULT_READERS = (
    "probe_kit.train.every_result:readers_of_results",
    "probe_kit.intervene.results.inventory:readers_of_results",
)
"""Functions that give a reader per stored result of a run. They lie in folders above."""

Job = tuple[str, int, str, str, str]
"""Key, length, checksum, whose it is, and what to do."""


def content_problems(
    root: Root, commits: Mapping[int, Commit], columns: Columns | None, sound: bool
) -> Iterator[str]:
    """What is wrong with the bytes behind the commits and in the columns.

    sound: whether nothing was found so far, without which rows and columns cannot be compared.
    """
    jobs = [*_committed(commits), *_sealed(columns)]
    found = list(_wrong(root.location, jobs))
    yield from found
    if sound and not found and columns is not None:
        yield from _differences(Run(root.location))


def reading_problems(root: Root) -> Iterator[str]:
    """The complaints of all readers of a run and of the results that are stored with it."""
    run = Run(root.location)
    yield from _complaints(run.check_records)
    yield from _complaints(lambda: (run.episodes, run.items, run.failed))
    if not run.commits():
        return
    for name in root.arrays:
        if name not in root.left_out:
            # Metadata of others may claim what no run has. One row shows that; the others have their hashes.
            yield from _complaints(partial(_read_first, run, name))
    if run.has_trajectories:
        for row in range(len(run.episodes)):
            yield from _complaints(partial(run.trajectory, row))
    for name in RESULT_READERS:
        listing: Callable[[Run], Iterator[Callable[[], object]]] = imported(name)
        try:
            readers = list(listing(run))
        except RunDamagedError as error:
            yield str(error)
            continue
        for reader in readers:
            yield from _complaints(reader)


def _read_first(run: Run, name: str) -> None:
    Rows(open_array(run.data, name), [min(commit["episode"] for commit in run.commits())])[0]


def _complaints(reader: Callable[[], object]) -> Iterator[str]:
    """The error of a reader, if it raises one. A library that is not installed is none of the run's."""
    try:
        reader()
    except MissingExtraError:
        return
    except ProbeKitError as error:
        yield str(error)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OSError) as error:
        yield f"a stored result cannot be read ({type(error).__name__}: {error}). {RESTORE}"


def _committed(commits: Mapping[int, Commit]) -> Iterator[Job]:
    for number, commit in commits.items():
        for key, (length, checksum, *_) in commit["objects"].items():
            yield f"{DATA}/{key}", length, checksum, f" of episode {commit['episode_id']}", redo(number)
        for key, (length, checksum, _) in pictures_of(commit).items():
            yield key, length, checksum, f" of episode {commit['episode_id']}", redo_picture(number)


def _sealed(columns: Columns | None) -> Iterator[Job]:
    if columns is not None:
        for key, (length, checksum, _) in columns.sums.items():
            yield f"{columns.folder}/{key}", length, checksum, "", columns.advice


def _wrong(location: Location, jobs: list[Job]) -> Iterator[str]:
    def look(job: Job) -> str | None:
        key, length, checksum, whose, advice = job
        problem = _problem(location, key, length, checksum)
        return problem and f"{key}{whose} {problem}. {advice}"

    remaining = iter(jobs)
    with ThreadPoolExecutor(READERS) as readers:
        while batch := list(islice(remaining, BATCH)):
            yield from filter(None, readers.map(look, batch))


def _problem(location: Location, key: str, length: int, checksum: str) -> str | None:
    """None also for what has another size or is not there, which was said before."""
    try:
        seen, found = digest_of(location.pieces(key), length)
    except FileNotFoundError:
        return None
    if seen != length or found == checksum:
        return None
    return "has other bytes than were written"


def _differences(run: Run) -> Iterator[str]:
    """Columns that are not what the rows give, and what cannot be read."""
    columns = run.columns
    assert columns is not None
    for stream in run.streams:
        try:
            for kind in run.root.vector_kinds:
                array = columns.array(f"{stream}/{kind}")
                for index, expected in columns_of_rows(run, stream, kind):
                    if not np.array_equal(np.asarray(array[index]), expected, equal_nan=True):
                        place = f"{columns.folder}/{stream}/{kind} at {index}"
                        yield f"{place} is not what the rows give. {columns.advice}"
        except RunDamagedError as error:
            yield str(error)
