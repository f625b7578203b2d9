"""A row per vector in a Parquet file, and where vectors are from."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.imports import require
from probe_kit.runs.export.vectors import POOLED, Block, StreamChoice, blocks
from probe_kit.runs.run import Run

KEYS = ("episode_id", "item_id", "group_id", "category", "layout", "side_correct", "outcome", "source_episode")
"""Columns of the episodes that say where a vector is from; a run has some of them."""
NUMBERS = ("source_episode",)
"""Of these, whole numbers; the others are texts."""
ABOUT = "probe_kit"
"""Key under which a Parquet file holds what it was made of."""


class Origins:
    """The origins of vectors: columns by episode, inference and token, as Arrow arrays."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.keys = [name for name in KEYS if name in run.episodes]
        self.step = "frame" if run.recorded else "control_step"
        self.steps = run.control_steps

    @cached_property
    def pa(self) -> Any:
        """The module pyarrow."""
        return require("pyarrow", "export")

    @property
    def fields(self) -> list[tuple[str, Any]]:
        """Names and types of the columns."""
        pa = self.pa
        keys = [(name, pa.int64() if name in NUMBERS else pa.string()) for name in self.keys]
        numbers = [("inference", pa.int32()), (self.step, pa.int32())]
        return [*keys, *numbers, ("role", pa.string()), ("token", pa.int32())]

    def columns(self, positions: Any, inferences: Any, tokens: Any, roles: Any) -> dict[str, Any]:
        """The columns of n vectors. positions, inferences, tokens: (n,) as in `Block`. roles: (n,)."""
        pa = self.pa
        columns = {name: self._cells[name].take(pa.array(positions)) for name in self.keys}
        columns["inference"] = pa.array(inferences, pa.int32())
        columns[self.step] = pa.array(self.steps[positions, inferences], pa.int32())
        columns["role"] = pa.array(roles, pa.string())
        columns["token"] = pa.array(tokens, pa.int32(), mask=np.asarray(tokens) == POOLED)
        return columns

    @cached_property
    def _cells(self) -> dict[str, Any]:
        episodes, types = self.run.episodes, dict(self.fields)
        return {
            name: self.pa.array(
                episodes[name].to_numpy(np.int64 if name in NUMBERS else np.str_).tolist(), types[name]
            )
            for name in self.keys
        }


def write_parquet(run: Run, choices: Sequence[StreamChoice], out: Path, about: str) -> None:
    """One file; a row group per episode, inference and stream. about: stored as metadata."""
    pq = require("pyarrow.parquet", "export")
    origins = Origins(run)
    schema = _schema(origins).with_metadata({ABOUT: about})
    with pq.ParquetWriter(out, schema) as writer:
        for table in _tables(run, choices, origins, schema):
            writer.write_table(table)


def _schema(origins: Origins) -> Any:
    pa = origins.pa
    text = pa.string()
    return pa.schema([*origins.fields, ("site", text), ("view", text), ("vector", pa.list_(pa.float32()))])


def _tables(run: Run, choices: Sequence[StreamChoice], origins: Origins, schema: Any) -> Iterator[Any]:
    for block in blocks(run, choices):
        yield _table(block, origins, schema)


def _table(block: Block, origins: Origins, schema: Any) -> Any:
    """The vectors of a block as rows, site by site."""
    pa = origins.pa
    sites, count, width = block.values.shape
    rows = np.full(count, block.position), np.full(count, block.inference)
    positions, inferences, tokens = (np.tile(cells, sites) for cells in (*rows, block.tokens))
    columns = origins.columns(positions, inferences, tokens, block.roles * sites)
    columns["site"] = pa.array(np.repeat([str(site) for site in block.choice.sites], count), pa.string())
    columns["view"] = pa.array([block.view] * (sites * count), pa.string())
    # Arrow's offsets of lists are int32, enough for the vectors of one inference.
    ends = np.arange(0, (sites * count + 1) * width, width, dtype=np.int32)
    columns["vector"] = pa.ListArray.from_arrays(pa.array(ends), pa.array(block.values.ravel()))
    return pa.table([columns[name] for name in schema.names], schema=schema)
