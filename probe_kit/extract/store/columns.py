"""The column store, read: one pooled vector of every episode, as probes ask for it.

A row store answers "everything of one episode". Columns hold the same numbers the other way round; `seal`
writes them. They are derived: safe to delete, and used only while their stamp matches the commits.

    columns.zarr/<stream>/pooled   float32 (call, view, [iteration,] layer, episode, feature)
    columns.zarr/<stream>/role     uint8   (call, episode, token), codes named by the attribute `roles`
"""

from typing import TYPE_CHECKING

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.errors import ChunkNotFoundError

from probe_kit.errors import RunDamagedError
from probe_kit.extract.store.arrays import open_array
from probe_kit.extract.store.layout import COLUMNS, StoredStream
from probe_kit.extract.store.location import Location
from probe_kit.hooks.sites import Site

if TYPE_CHECKING:
    import xarray as xr


class Columns:
    """The sealed columns of a run."""

    def __init__(self, location: Location, folder: str) -> None:
        self._location, self._folder = location, folder

    def column(self, stored: StoredStream, site: Site, view: str, call: int) -> NDArray[np.float32]:
        """(E, D) float32: one view of one site at one captured inference. Raises RunDamagedError."""
        array = open_array(self._location, self._folder, f"{stored.name}/pooled")
        try:
            return np.asarray(array[(call, stored.views.index(view), *stored.at(site))])
        except (ChunkNotFoundError, ValueError, RuntimeError) as error:
            raise RunDamagedError(
                f"the column of {site} in {self._location}/{self._folder} cannot be read: {error}. Delete that "
                f"folder; the rows are not concerned, and `probe-kit run seal {self._location}` builds it again"
            ) from error

    def xarray(self, stream: str) -> "xr.DataArray":
        """The pooled columns of one stream, read when they are used."""
        import xarray as xr

        dataset: xr.Dataset = xr.open_zarr(
            self._location.store(self._folder, read_only=True), group=stream, consolidated=False, chunks=None
        )
        return dataset["pooled"].drop_attrs()


def find_columns(location: Location, stamp: str) -> Columns | None:
    """The columns of a run if they were sealed from exactly the commits that `stamp` names."""
    folder = location.derived(COLUMNS, stamp)
    if not location.exists(f"{folder}/zarr.json"):
        return None
    group = zarr.open_group(location.store(folder, read_only=True), mode="r")
    return Columns(location, folder) if group.attrs.get("stamp") == stamp else None
