"""The column store, read: one pooled vector of every episode, as probes ask for it.

A row store answers "everything of one episode". Columns hold the same numbers the other way round; `seal`
writes them. They are derived: safe to delete, and used only while their stamp matches the commits.

    columns.zarr/<stream>/pooled   float32 (call, view, [iteration,] layer, episode, feature)
    columns.zarr/<stream>/role     uint8   (call, episode, token), codes named by the attribute `roles`
    sealed/<stamp>.json            the hash of every object in columns.zarr, and of which run and commits they are
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.errors import ChunkNotFoundError

from probe_kit.errors import RunDamagedError
from probe_kit.extract.run_layout import COLUMNS, SEALED, StoredStream
from probe_kit.extract.store.format.arrays import open_array
from probe_kit.extract.store.format.checking import CheckedStore
from probe_kit.extract.store.format.hashes import Sum, as_record, read_record, read_sums
from probe_kit.extract.store.format.root import Root
from probe_kit.extract.store.locations.location import Location
from probe_kit.hooks.contract.sites import Site

if TYPE_CHECKING:
    import xarray as xr


STAMP_DIGITS = 16


class Columns:
    """The sealed columns of a run.

    sums: of every object in their folder; None in a run that nothing protects. advice: what to do if they are
    damaged.
    """

    def __init__(self, location: Location, folder: str, sums: Mapping[str, Sum] | None) -> None:
        self.folder, self.sums = folder, sums
        self._location = location
        self.advice = (
            f"Delete {folder}; the rows are not concerned, and `probe-kit run seal {location}` builds it again"
        )

    @property
    def store(self) -> Store:
        """The objects, each checked as it is read."""
        store = self._location.store(self.folder, read_only=True)
        if self.sums is None:
            return store
        return CheckedStore(store, self.sums, self._where, lambda _key: self.advice)

    def _where(self, key: str) -> str:
        return f"{self._location}/{self.folder}/{key}"

    def array(self, name: str) -> "zarr.Array[Any]":
        """One array, such as `backbone/pooled`."""
        return open_array(self.store, name)

    def column(self, stored: StoredStream, site: Site, view: str, call: int) -> NDArray[np.float32]:
        """(E, D) float32: one view of one site at one captured inference. Raises RunDamagedError."""
        array = self.array(f"{stored.name}/pooled")
        try:
            return np.asarray(array[(call, stored.views.index(view), *stored.at(site))])
        except (ChunkNotFoundError, ValueError, RuntimeError) as error:
            raise RunDamagedError(
                f"the column of {site} in {self._location}/{self.folder} cannot be read: {error}. {self.advice}"
            ) from error

    def xarray(self, stream: str) -> "xr.DataArray":
        """The pooled columns of one stream, read when they are used."""
        import xarray as xr

        dataset: xr.Dataset = xr.open_zarr(self.store, group=stream, consolidated=False, chunks=None)
        return dataset["pooled"].drop_attrs()

    def problems(self) -> Iterator[str]:
        """What is missing or has another size, without reading it; nothing where there are no sums."""
        sizes = self._location.sizes(self.folder, self.sums or {})
        for key, known in (self.sums or {}).items():
            if sizes.get(key) != known.length:
                seen = f"has {sizes[key]} bytes; {known.length} were written" if key in sizes else "is missing"
                yield f"{self.folder}/{key} {seen}. {self.advice}"


def find_columns(root: Root, stamp: str) -> Columns | None:
    """The columns of a run if they were sealed from exactly the commits that `stamp` names.

    Raises RunDamagedError if what was noted of them when they were sealed was changed.
    """
    location = root.location
    folder = location.derived(COLUMNS, stamp)
    if not location.exists(f"{folder}/zarr.json"):
        return None
    if root.protected:
        sums = _read_seal(root, stamp)
        return None if sums is None else Columns(location, folder, sums)
    group = zarr.open_group(location.store(folder, read_only=True), mode="r")
    return Columns(location, folder, None) if group.attrs.get("stamp") == stamp else None


def seal_key(stamp: str) -> str:
    """Where the hashes of the columns lie that were made from the commits that `stamp` names."""
    return f"{SEALED}/{stamp[:STAMP_DIGITS]}.json"


def write_seal(root: Root, stamp: str, sums: Mapping[str, Sum]) -> None:
    """Note the hashes of the columns, which makes them count."""
    objects = {key: one.to_json() for key, one in sums.items()}
    root.location.write_record(
        seal_key(stamp), as_record({"run": root.identity, "stamp": stamp, "objects": objects})
    )


def _read_seal(root: Root, stamp: str) -> dict[str, Sum] | None:
    key = seal_key(stamp)
    name = f"{root.location}/{key}"
    advice = f"Delete it; `probe-kit run seal {root.location}` builds the columns again"
    try:
        seal = read_record(root.location.read(key), name, advice)
    except FileNotFoundError:
        return None
    if (seal["run"], seal["stamp"]) != (root.identity, stamp):
        raise RunDamagedError(f"{name} belongs to another run or to other episodes. {advice}")
    return read_sums(seal["objects"])
