"""A shuffled memory map per site with a vector per row, to train sparse autoencoders on."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from probe_kit._system.imports import require
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.arrays import decode_bfloat16, encode_bfloat16
from probe_kit.runs.export.tables import Origins
from probe_kit.runs.export.vectors import Block, StreamChoice, blocks, count_vectors
from probe_kit.runs.layout import SaeDtype
from probe_kit.runs.run import Run

INDEX = "index.parquet"
SCALES = "scales.json"
_READ_AT_ONCE, _INDEXED_AT_ONCE = 1 << 12, 1 << 18
"""Rows of a matrix, and of its index. They bound memory: 4,096 rows of 4,096 float32 are 64 MB."""


@dataclass(frozen=True)
class RowOrigins:
    """The origins of the N rows of the matrices of a stream, as in `Block`.

    positions, inferences, tokens: (N,) int32. roles: (N,) int32, places in role_names.
    """

    positions: NDArray[np.int32]
    inferences: NDArray[np.int32]
    tokens: NDArray[np.int32]
    roles: NDArray[np.int32]
    role_names: list[str]

    @classmethod
    def of(cls, count: int) -> "RowOrigins":
        """Return origins for so many rows, which `put` fills."""
        positions, inferences, tokens, roles = np.zeros((4, count), np.int32)
        return cls(positions, inferences, tokens, roles, [])

    def put(self, places: Any, block: Block) -> None:
        """The rows at `places` are those of `block`."""
        self.positions[places], self.inferences[places] = block.position, block.inference
        self.tokens[places] = block.tokens
        self.role_names.extend(role for role in dict.fromkeys(block.roles) if role not in self.role_names)
        self.roles[places] = [self.role_names.index(role) for role in block.roles]


def write_sae(
    run: Run, choices: Sequence[StreamChoice], folder: Path, about: str, dtype: SaeDtype, seed: int
) -> None:
    """`<stream>/<site>.npy` (N, D) in one drawn order per stream, `<stream>/index.parquet`, and `scales.json`.

    dtype: the bits of bfloat16 are stored as uint16, because numpy has no such type. `scale` is the factor by
    which the mean squared norm of the rows of a site becomes D; stored rows are not multiplied by it.
    Raises UsageError for a value that float16 cannot hold.
    """
    require("pyarrow.parquet", "export")
    folder.mkdir()
    scales: dict[str, Any] = {}
    for choice in choices:
        stream_folder = folder / choice.name
        stream_folder.mkdir()
        # One order for all sites of a stream, so that row i is one token at every layer, and one index serves all.
        order = np.random.default_rng(derive_seed("export sae", seed)).permutation(count_vectors(run, choice))
        stored = np.dtype(np.float16 if dtype == "float16" else np.uint16)
        rows, files = _write_matrices(run, choice, stream_folder, stored, order)
        for site, file in files.items():
            scales[str(site)] = {"file": file.relative_to(folder).as_posix(), **_scale(file)}
        _write_index(run, rows, stream_folder / INDEX)
    head = {"dtype": dtype, "seed": seed, "sites": scales, "about": json.loads(about)}
    (folder / SCALES).write_text(json.dumps(head, indent=2), encoding="utf-8", newline="\n")


def _write_matrices(
    run: Run, choice: StreamChoice, folder: Path, dtype: np.dtype[Any], order: NDArray[np.intp]
) -> tuple[RowOrigins, dict[Site, Path]]:
    """A file per site, filled in one pass over the run. order: (N,) row of every vector."""
    count = count_vectors(run, choice)
    files = {site: folder / f"{site}.npy" for site in choice.sites}
    shape = count, choice.stored.width
    maps = {
        site: open_memmap(file, "w+", dtype, shape)  # type: ignore[no-untyped-call]
        for site, file in files.items()
    }
    for file in files.values():
        _reserve(file)
    rows, start = RowOrigins.of(count), 0
    for block in blocks(run, [choice]):
        end = start + block.tokens.size
        places = order[start:end]
        rows.put(places, block)
        for site, values in zip(choice.sites, block.values, strict=True):
            maps[site][places] = _as_stored(values, dtype, site, run)
        start = end
    for memory_map in maps.values():
        memory_map.flush()
    return rows, files


def _reserve(file: Path) -> None:
    """Give a file its blocks now: on a full disk, writing into a mapped file would end the process by SIGBUS."""
    reserve = getattr(os, "posix_fallocate", None)
    if reserve is not None:
        with file.open("r+b") as opened:
            reserve(opened.fileno(), 0, file.stat().st_size)


def _as_stored(values: NDArray[np.float32], dtype: np.dtype[Any], site: Site, run: Run) -> NDArray[Any]:
    if dtype == np.uint16:
        return encode_bfloat16(values)
    if dtype == np.float16 and np.abs(values).max() > np.finfo(np.float16).max:
        raise UsageError(
            f"{site} of {run.location} holds {np.abs(values).max():.6g}, and float16 ends at 65504. "
            "Use --dtype bfloat16"
        )
    return values.astype(dtype)


def _scale(file: Path) -> dict[str, float]:
    """The mean squared norm of stored rows, and the factor that makes it D."""
    stored = np.load(file, mmap_mode="r")
    total = 0.0
    for start in range(0, len(stored), _READ_AT_ONCE):
        part = np.asarray(stored[start : start + _READ_AT_ONCE])
        values = decode_bfloat16(part) if part.dtype == np.uint16 else part
        total += float(np.square(values, dtype=np.float64).sum())
    mean = total / len(stored)
    return {"mean_squared_norm": mean, "scale": float(np.sqrt(stored.shape[1] / mean)) if mean else 1.0}


def _write_index(run: Run, rows: RowOrigins, out: Path) -> None:
    """Row i of the index is of row i of every matrix of the stream."""
    pa, pq = require("pyarrow", "export"), require("pyarrow.parquet", "export")
    origins, names = Origins(run), np.array(rows.role_names)
    schema = pa.schema(origins.fields)
    with pq.ParquetWriter(out, schema) as writer:
        for start in range(0, rows.positions.size, _INDEXED_AT_ONCE):
            part = slice(start, start + _INDEXED_AT_ONCE)
            columns = origins.columns(
                rows.positions[part], rows.inferences[part], rows.tokens[part], names[rows.roles[part]]
            )
            writer.write_table(pa.table([columns[name] for name in schema.names], schema=schema))
