"""Reading of the column store: one pooled vector per episode, as probes need it.

A run stores rows: everything of one episode together. Columns hold the same numbers ordered the other way: one
site and view of all episodes together. `seal` writes them. They can be made again, so they are safe to delete.
They are used only while their stamp matches the commits.

    columns.zarr/<stamp>/<stream>/
        pooled            float32 (call, view, [iteration,] layer, episode, feature)
        later             uint16 (call - 1, [iteration,] layer, episode, feature), with --later-views mean
        role              uint8 (call, episode, token), codes named by the attribute `roles`
    sealed/<stamp>.json   the hash of every object there, and of which run and commits they are

The stamp is part of their path, so that processes which saw different commits never mix columns. A seal names the
episodes of which it was made. If the run has more episodes, the seal is older. If the seal names an episode that
is no longer committed, the run lost it.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from zarr.errors import ChunkNotFoundError

from probe_kit._system.escaping import as_argument
from probe_kit.errors import RunDamagedError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.array_store import ArrayStore
from probe_kit.runs.arrays import bounded_codecs, open_array
from probe_kit.runs.commits import Commit, commit_key, stamp_of
from probe_kit.runs.layout import COLUMNS, LATER, METADATA, SEALED
from probe_kit.runs.records import NAME_DIGITS, Checksum, Record, Sums, named_by_hash
from probe_kit.runs.root import Root
from probe_kit.runs.store import Location

if TYPE_CHECKING:
    import xarray as xr
    import zarr


class Seal(Record):
    """The commits that the columns were made of, and the hashes of all objects by key in their folder."""

    kind: ClassVar[str] = "seal"
    run: str
    stamp: str
    episodes: list[int]
    objects: Sums


class Columns:
    """The sealed columns of a run.

    Attributes:
        advice: The remedy if the columns are damaged.

    Args:
        location: The run that holds them.
        folder: The folder of the columns in the run, from `columns_folder`.
        sums: The sums of every object in the folder, by key.
    """

    def __init__(self, location: Location, folder: str, sums: Mapping[str, Checksum]) -> None:
        self.folder, self.sums = folder, sums
        self._location = location
        self.advice = f"The rows are not concerned: {_sealing(location)}"

    @property
    def store(self) -> ArrayStore:
        """The objects, each checked as it is read."""
        return ArrayStore(self._location, self.folder, self.sums, lambda _key: self.advice, read_only=True)

    def array(self, name: str) -> "zarr.Array[Any]":
        """Open one array, such as `backbone/pooled`."""
        return open_array(self.store, name)

    def read(self, name: str, index: tuple[int, ...], site: Site) -> NDArray[Any]:
        """Return one column (E, D) of the array `name` as stored; errors name `site`. Raises RunDamagedError."""
        array = self.array(name)
        try:
            return np.asarray(array[index])
        except (ChunkNotFoundError, ValueError, RuntimeError) as error:
            raise RunDamagedError(
                f"the column of {site} in {self._location}/{self.folder} cannot be read: {error}. {self.advice}"
            ) from error

    def xarray(self, stream: str) -> "xr.DataArray":
        """Return the pooled columns of one stream, which are read when they are used."""
        import xarray as xr

        other_arrays = ("role", LATER)  # which may have other numbers of calls
        self.array(f"{stream}/pooled")  # checks its metadata
        with bounded_codecs():
            dataset: xr.Dataset = xr.open_zarr(
                self.store, group=stream, consolidated=False, chunks=None, drop_variables=other_arrays
            )
        return dataset["pooled"].drop_attrs()


def _sealing(location: Location) -> str:
    return f"`probe-kit run verify {as_argument(location)} --seal` builds the columns again"


def find_columns(root: Root, commits: Mapping[int, Commit], skip_damaged: bool = False) -> Columns | None:
    """Return the columns of a run if they were sealed from exactly these commits, None otherwise.

    Args:
        root: The root of the run.
        commits: The commits of the run.
        skip_damaged: Take damaged seals for none, and do not look whether the columns are there: for who writes
            them again.

    Raises:
        RunDamagedError: If the seal was changed, or names commits that are gone or others, or if a part of the
            columns is gone.
    """
    location, stamp = root.location, stamp_of(commits)
    seals = _read_seals(root, commits, skip_damaged)
    seal = next((seal for seal in seals if seal.stamp == stamp), None)
    if seal is None:
        return None
    columns = Columns(location, columns_folder(stamp), seal.objects)
    if not (skip_damaged or location.exists(f"{columns.folder}/{METADATA}")):
        if not (location.keys(columns.folder) and location.exists(seal_key(stamp))):
            return None  # all of them were removed, as is allowed, or are being built again
        raise RunDamagedError(f"{location}/{columns.folder}/{METADATA} is missing. {columns.advice}")
    return columns


def columns_folder(stamp: str) -> str:
    """Return the folder of the columns that were made from the commits that `stamp` names."""
    return f"{COLUMNS}/{stamp[:NAME_DIGITS]}"


def seal_key(stamp: str) -> str:
    """Return the key of the hashes of the columns that were made from the commits that `stamp` names."""
    return f"{SEALED}/{stamp[:NAME_DIGITS]}.json"


def write_seal(root: Root, commits: Mapping[int, Commit], sums: Mapping[str, Checksum]) -> None:
    """Store the hashes of the columns, and the episodes they are made of, from which on the columns count."""
    seal = Seal(run=root.identity, stamp=stamp_of(commits), episodes=sorted(commits), objects=dict(sums))
    # `write`: the same commits are sealed once more after their columns were deleted.
    root.location.write(seal_key(seal.stamp), seal.to_bytes())


def _read_seals(root: Root, commits: Mapping[int, Commit], skip_damaged: bool) -> list[Seal]:
    """Return all seals, each checked; a seal that names commits which are gone is damage of the run."""
    seals = []
    for _, key, raw in named_by_hash(root.location, SEALED):
        try:
            seal = _read_seal(root, key, raw)
        except RunDamagedError:
            if skip_damaged:
                continue
            raise
        _check_lost(root, commits, seal, f"{root.location}/{key}")
        if (problem := _stale_problem(root, commits, seal, key)) and not skip_damaged:
            raise RunDamagedError(problem)
        if not problem:
            seals.append(seal)
    return seals


def _read_seal(root: Root, key: str, raw: bytes) -> Seal:
    name, advice = f"{root.location}/{key}", _sealing(root.location)
    seal = Seal.parse(raw, name, advice, run=root.identity)
    if seal_key(seal.stamp) != key:
        raise RunDamagedError(f"{name} belongs to other episodes. {advice}")
    # What a seal does not name does not exist for `ArrayStore`: the array would seem never written.
    if lost := _metadata(root) - {*seal.objects}:
        raise RunDamagedError(f"{name} names no hash of {min(lost)}. {advice}")
    return seal


def _metadata(root: Root) -> set[str]:
    """Return the keys of the metadata that columns always have."""
    arrays = [f"{stream}/{kind}" for stream in root.streams for kind in root.vector_kinds]
    return {METADATA, *(f"{array}/{METADATA}" for array in arrays)}


def _check_lost(root: Root, commits: Mapping[int, Commit], seal: Seal, name: str) -> None:
    """Raise RunDamagedError if a seal was made of commits that are gone."""
    absent = [number for number in seal.episodes if number not in commits]
    if lost := [number for number in absent if not root.location.exists(commit_key(number))]:
        raise RunDamagedError(
            f"{root.location}/{commit_key(lost[0])} is missing: {name} was made of {len(seal.episodes)} episodes, "
            f"of which {len(lost)} are gone. Restore the commits, or run the same `probe-kit extract` again to "
            f"redo them; to continue without them, delete {SEALED} and {COLUMNS}"
        )


def _stale_problem(root: Root, commits: Mapping[int, Commit], seal: Seal, key: str) -> str | None:
    """Return the fault in a seal whose commits are others by now; None where some are only not read yet."""
    if not {*seal.episodes} <= {*commits}:
        return None
    if stamp_of({number: commits[number] for number in seal.episodes}) == seal.stamp:
        return None
    return f"{root.location}/{key} was made of other commits than the run has. {_sealing(root.location)}"
