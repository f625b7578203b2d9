"""The column store, read: one pooled vector of every episode, as probes ask for it.

A row store answers "everything of one episode". Columns hold the same numbers the other way round; `seal`
writes them. They are derived: safe to delete, and used only while their stamp matches the commits.

    columns.zarr/<stream>/pooled   float32 (step, view, [iteration,] layer, episode, feature)
    columns.zarr/<stream>/role     uint8   (step, episode, token), codes named by the attribute `roles`
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.errors import ChunkNotFoundError

from probe_kit.errors import RunDamagedError
from probe_kit.extract.layout import COLUMNS, StoredStream, open_array
from probe_kit.hooks.sites import Site

if TYPE_CHECKING:
    import xarray as xr


class Columns:
    """The sealed columns of a run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def column(self, stored: StoredStream, site: Site, view: str, call: int) -> NDArray[np.float32]:
        """(E, D) float32: one view of one site at one captured inference. Raises RunDamagedError."""
        array = open_array(self.path, f"{stored.name}/pooled")
        try:
            return np.asarray(array[(call, stored.views.index(view), *stored.at(site))])
        except (ChunkNotFoundError, ValueError, RuntimeError) as error:
            raise RunDamagedError(
                f"the column of {site} in {self.path} cannot be read: {error}. Delete that folder; the rows are "
                f"not concerned, and `probe-kit run seal {self.path.parent}` builds it again"
            ) from error

    def xarray(self, stream: str) -> "xr.DataArray":
        """The pooled columns of one stream, read when they are used."""
        import xarray as xr

        dataset: xr.Dataset = xr.open_zarr(self.path, group=stream, consolidated=False, chunks=None)
        return dataset["pooled"].drop_attrs()


def find_columns(run: Path, stamp: str) -> Columns | None:
    """The columns of `run` if they were sealed from exactly the commits that `stamp` names."""
    path = run / COLUMNS
    if not (path / "zarr.json").is_file() or zarr.open_group(path, mode="r").attrs.get("stamp") != stamp:
        return None
    return Columns(path)
