"""The inputs of recorded frames: one array per kind beside the streams, one chunk per row of the plan.

    data.zarr/inputs/state        float32 (episode, call, number), as recorded
    data.zarr/inputs/action       float32 (episode, call, step, number): the recorded actions from the frame on
    data.zarr/inputs/prediction   float32 (episode, call, step, number), in the checkpoint's own units
    data.zarr/inputs/columns      float64 (episode, call, column): timestamp, reward … as the data set has them
    data.zarr/inputs/pixels       uint8 (episode, call, camera, y, x, colour): 32 × 32

Rows behind the last frame of a stretch are not numbers; of pixels they are zero.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.core.array_spec import ArrayConfigLike

from probe_kit._system.table_cells import Cell
from probe_kit.runs.arrays import ROOM, codecs, open_array
from probe_kit.runs.layout import CLASSES, INPUTS, TRUTHS
from probe_kit.runs.rows import Rows

_TYPES = {"columns": "float64", "pixels": "uint8"}
"""All others are float32. Columns hold timestamps and indices, of which float32 has too few digits."""


def create_inputs(store: Store, calls: int, shapes: Mapping[str, list[int]], codec: str) -> None:
    """Create the arrays. shapes: by kind, of one inference."""
    root = zarr.open_group(store, mode="a", zarr_format=3)
    group = root.create_group(INPUTS)
    for name, shape in shapes.items():
        dtype = np.dtype(_TYPES.get(name, "float32"))
        group.create_array(
            name,
            shape=(ROOM, calls, *shape),
            chunks=(1, calls, *shape),
            dtype=dtype,
            fill_value=0 if dtype.kind == "u" else np.nan,
            compressors=codecs(codec, typesize=dtype.itemsize),
            config={"write_empty_chunks": True},
        )


def write_inputs(store: Store, number: int, inputs: Mapping[str, NDArray[Any]], config: ArrayConfigLike) -> None:
    """Store the inputs (n, …) by kind of the row `number`, n at most its calls."""
    for name, values in inputs.items():
        array: zarr.Array[Any] = zarr.open_array(
            store, path=f"{INPUTS}/{name}", mode="r+", zarr_format=3, config=config
        )
        row = np.full(array.shape[1:], array.fill_value, array.dtype)
        row[: len(values)] = values
        array[number] = row


class StoredInputs:
    """The inputs of the committed rows of a run, in their order.

    kinds: that are stored. columns: names of the numbers of `columns`. names: of those of `state` and `action`.
    truths: columns that are truth values, stored as 0 and 1. classes: by column of texts, the texts of which it
    stores the position.
    """

    def __init__(self, store: Store, numbers: list[int], dataset: Mapping[str, Any]) -> None:
        self._store, self._numbers = store, numbers
        self.kinds: tuple[str, ...] = tuple(dataset["inputs"])
        self.columns: tuple[str, ...] = tuple(dataset["columns"])
        self.names: dict[str, tuple[str, ...]] = {name: tuple(names) for name, names in dataset["names"].items()}
        self.truths: tuple[str, ...] = self.names.pop(TRUTHS, ())
        self.classes: dict[str, tuple[str, ...]] = {
            name: self.names.pop(CLASSES + name) for name in self.columns if CLASSES + name in self.names
        }

    def read(self, kind: str) -> NDArray[Any]:
        """(E, C, …) of one kind. Raises KeyError for one that is not stored, RunDamagedError."""
        if kind not in self.kinds:
            raise KeyError(kind)
        rows = Rows(open_array(self._store, f"{INPUTS}/{kind}"), self._numbers)
        return np.stack(list(rows))

    def row(self, kind: str, position: int) -> NDArray[Any]:
        """Return (C, …) of one kind of the row at a position. Raises KeyError as `read` does, RunDamagedError."""
        if kind not in self.kinds:
            raise KeyError(kind)
        return Rows(open_array(self._store, f"{INPUTS}/{kind}"), self._numbers)[position]

    def column(self, name: str) -> NDArray[np.float64]:
        """(E, C) one column of the data set. Raises KeyError."""
        if name not in self.columns:
            raise KeyError(name)
        values: NDArray[np.float64] = self.read("columns")[..., self.columns.index(name)]
        return values

    def cell(self, name: str, value: float) -> Cell:
        """Return a number of a column as its source had it: a number, truth value or text; None if not finite."""
        if not np.isfinite(value):
            return None
        if texts := self.classes.get(name):
            return texts[int(value)]
        return bool(value) if name in self.truths and value in (0, 1) else value
