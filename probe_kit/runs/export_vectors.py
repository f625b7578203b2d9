"""The vectors of a run that an export holds, episode by episode: rows of Parquet, or a shuffled memory map."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from probe_kit._system.imports import require
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import PADDING, Site, plays, resolve_view
from probe_kit.runs.arrays import EpisodeRows, Spans, decode_bfloat16, encode_bfloat16
from probe_kit.runs.layout import ArrayKind, SaeDtype, StoredStream
from probe_kit.runs.run import Run

TOKENS: Final = "tokens"
"""The view that has a vector per token; `tokens:ROLE` has those of one role."""
POOLED = -1
"""The number in place of a token's position for pooled views."""
_MEAN_OF = "mean:"


@dataclass(frozen=True)
class StreamChoice:
    """The chosen sites of one stream, and their views: pooled ones, or one of tokens."""

    stored: StoredStream
    sites: tuple[Site, ...]
    views: tuple[str, ...]

    @property
    def name(self) -> str:
        """The name of the stream."""
        return self.stored.name


@dataclass(frozen=True)
class VectorBlock:
    """The n vectors of every site of a choice, at one captured inference of one episode.

    Attributes:
        position: The episode's place in `Run.episodes`.
        inference: The number of the captured inference, from 0.
        tokens: (n,) positions, `POOLED` for pooled views.
        roles: (n,) roles of the tokens; empty for `mean` and `last`, whose tokens play several.
        values: (S, n, D) float32.
    """

    choice: StreamChoice
    position: int
    inference: int
    view: str
    tokens: NDArray[np.int32]
    roles: tuple[str, ...]
    values: NDArray[np.float32]


def choose(run: Run, sites: Sequence[str] | None, view: str | None) -> tuple[StreamChoice, ...]:
    """Return the part of a run that is asked for. Streams without the view are left out unless they are named.

    Args:
        run: A run with activations.
        sites: Names, their beginnings (`backbone`, `expert.03`) or patterns (`expert.*@9`); None for all.
        view: A pooled view, `tokens` or `tokens:ROLE`; None for all pooled views.

    Raises:
        UnknownSiteError: For a site or view that is not stored.
        UsageError: If `sites` is empty.
    """
    for pattern in sites or ():
        if not any(_matches(site, [pattern]) for stream in run.streams for site in run.sites(stream)):
            available = ", ".join(f"{run.sites(name)[0]} to {run.sites(name)[-1]}" for name in run.streams)
            raise UnknownSiteError(f"{run.location} has no site {pattern!r}; it has {available}")
    if sites is not None and not sites:
        raise UsageError(
            "no sites are named; expected one or more, such as backbone.07.residual, or all by default"
        )
    choices = []
    for name in run.streams:
        chosen_sites = tuple(site for site in run.sites(name) if sites is None or _matches(site, sites))
        views = _views(run, name, view)
        if chosen_sites and not views and sites is not None:
            available = ", ".join(run.views(name))
            raise UnknownSiteError(
                f"no view {view!r} of {name} in {run.location}; stored: {available}{_tokens(run)}"
            )
        if chosen_sites and views:
            choices.append(StreamChoice(run.stored(name), chosen_sites, views))
    if not choices:
        available = "; ".join(f"{name}: {', '.join(run.views(name))}" for name in run.streams)
        raise UnknownSiteError(
            f"no stream of {run.location} has the view {view!r}; stored are {available}{_tokens(run)}"
        )
    return tuple(choices)


def blocks(run: Run, choices: Sequence[StreamChoice]) -> Iterator[VectorBlock]:
    """Yield all vectors, episode by episode and inference by inference. Raises RunDamagedError."""
    rows: dict[str, dict[ArrayKind, EpisodeRows]] = {}
    for choice in choices:
        kinds: tuple[ArrayKind, ...] = (TOKENS,) if is_tokens(choice.views[0]) else run.root.vector_kinds
        rows[choice.name] = {kind: run.rows(choice.name, kind) for kind in kinds}
    for position, commit in enumerate(run.commits()):
        for choice in choices:
            if is_tokens(choice.views[0]):
                yield from _token_blocks(rows[choice.name][TOKENS], choice, position, commit.roles)
            else:
                yield from _pooled_blocks(run, rows[choice.name], choice, position, len(commit.roles))


def count_vectors(run: Run, choice: StreamChoice) -> int:
    """Count the vectors of each site, over all views. Reads no activations."""
    total = 0
    for commit in run.commits():
        for inference, spans in enumerate(commit.roles):
            for view in choice.views:
                if is_tokens(view):
                    total += chosen_tokens(spans[choice.name], view)[0].size
                else:
                    total += view in run.views(choice.name, inference)
    return total


def is_tokens(view: str) -> bool:
    """Whether a view has a vector per token."""
    return view.partition(":")[0] == TOKENS


def chosen_tokens(spans: Spans, view: str) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Return positions (n,) and roles of the tokens of a view, `tokens` or `tokens:ROLE`; padding is in none."""
    wanted_role = view.partition(":")[2]
    tokens = [
        (position, role)
        for role, start, stop in sorted(spans, key=lambda span: span[1])
        if (plays(role, wanted_role) if wanted_role else role != PADDING)
        for position in range(start, stop)
    ]
    return np.array([position for position, _ in tokens], np.int32), tuple(role for _, role in tokens)


def _matches(site: Site, patterns: Sequence[str]) -> bool:
    name = str(site)
    return any(
        fnmatchcase(name, pattern) or name.startswith((f"{pattern}.", f"{pattern}@")) for pattern in patterns
    )


def _views(run: Run, stream: str, view: str | None) -> tuple[str, ...]:
    """Return the views of a stream that are asked for; none if it lacks them."""
    pooled = run.views(stream)
    if view is None:
        return pooled
    if is_tokens(view):
        return (view,) if run.settings["tokens"] == "all" and _plays_any(run, stream, view) else ()
    resolved = resolve_view(view, pooled)
    return (resolved,) if resolved in pooled else ()


def _plays_any(run: Run, stream: str, view: str) -> bool:
    return any(chosen_tokens(spans[stream], view)[0].size for commit in run.commits() for spans in commit.roles)


def _tokens(run: Run) -> str:
    if run.settings["tokens"] == "all":
        roles = {
            role
            for commit in run.commits()
            for spans in commit.roles
            for stream_spans in spans.values()
            for role, *_ in stream_spans
        }
        return f", {TOKENS} and {TOKENS}:ROLE of {', '.join(sorted(roles - {PADDING}))}"
    return "; every token only in runs extracted with --tokens all"


def _pooled_blocks(
    run: Run, rows: Mapping[ArrayKind, EpisodeRows], choice: StreamChoice, position: int, inferences: int
) -> Iterator[VectorBlock]:
    full = rows["pooled"][position]
    later = rows["later"][position] if "later" in rows and inferences > 1 else None
    for inference in range(inferences):
        for view in choice.views:
            if view not in run.views(choice.name, inference):
                continue
            if inference and later is not None:
                vectors: Any = [
                    decode_bfloat16(later[(inference - 1, *choice.stored.at(site))]) for site in choice.sites
                ]
            else:
                index = choice.stored.views.index(view)
                vectors = [full[(inference, *choice.stored.at(site), index)] for site in choice.sites]
            role = view.removeprefix(_MEAN_OF) if view.startswith(_MEAN_OF) else ""
            none = np.array([POOLED], np.int32)
            yield VectorBlock(choice, position, inference, view, none, (role,), np.stack(vectors)[:, None])


def _token_blocks(
    rows: EpisodeRows, choice: StreamChoice, position: int, spans: Sequence[Any]
) -> Iterator[VectorBlock]:
    (view,) = choice.views
    for inference, stream_spans in enumerate(spans):
        tokens, roles = chosen_tokens(stream_spans[choice.name], view)
        if not tokens.size:
            continue
        until = slice(int(tokens.max()) + 1)
        values = np.empty((len(choice.sites), tokens.size, choice.stored.width), np.float32)
        for index, site in enumerate(choice.sites):
            bits = rows.read(position, (inference, *choice.stored.at(site), until))
            values[index] = decode_bfloat16(bits)[tokens]
        yield VectorBlock(choice, position, inference, view, tokens, roles, values)


# -- Parquet -----------------------------------------------------------------------------------------------------


KEYS = ("episode_id", "item_id", "group_id", "category", "layout", "side_correct", "outcome", "source_episode")
"""The columns of the episodes that say where a vector is from; a run has some of them."""
NUMBERS = ("source_episode",)
"""The columns among `KEYS` with whole numbers; the others are texts."""
ABOUT = "probe_kit"
"""The key under which a Parquet file holds what it was made of."""


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
        """The names and types of the columns."""
        pa = self.pa
        keys = [(name, pa.int64() if name in NUMBERS else pa.string()) for name in self.keys]
        numbers = [("inference", pa.int32()), (self.step, pa.int32())]
        return [*keys, *numbers, ("role", pa.string()), ("token", pa.int32())]

    def columns(self, positions: Any, inferences: Any, tokens: Any, roles: Any) -> dict[str, Any]:
        """Return the columns of n vectors, by name.

        Args:
            positions: (n,) places of the episodes in `Run.episodes`.
            inferences: (n,) numbers of the captured inferences.
            tokens: (n,) positions of the tokens, `POOLED` for pooled views.
            roles: (n,) roles of the tokens.
        """
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
    """Write one file with a row group per episode, inference and stream; `about` is stored as metadata."""
    pa, pq = require("pyarrow", "export"), require("pyarrow.parquet", "export")
    origins, text = Origins(run), pa.string()
    fields = [*origins.fields, ("site", text), ("view", text), ("vector", pa.list_(pa.float32()))]
    schema = pa.schema(fields).with_metadata({ABOUT: about})
    with pq.ParquetWriter(out, schema) as writer:
        for block in blocks(run, choices):
            writer.write_table(_table(block, origins, schema))


def _table(block: VectorBlock, origins: Origins, schema: Any) -> Any:
    """Return the vectors of a block as rows, site by site."""
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


# -- memory maps -------------------------------------------------------------------------------------------------


INDEX = "index.parquet"
SCALES = "scales.json"
_READ_AT_ONCE, _INDEXED_AT_ONCE = 1 << 12, 1 << 18
"""The rows of a matrix, and of its index, that are read at once.

They bound memory: 4,096 rows of 4,096 float32 are 64 MB.
"""


def write_sae(
    run: Run, choices: Sequence[StreamChoice], folder: Path, about: str, dtype: SaeDtype, seed: int
) -> None:
    """Write `<stream>/<site>.npy` (N, D) in one drawn order per stream, `<stream>/index.parquet`, `scales.json`.

    In `scales.json`, `scale` is a factor of the rows of a site: times it, their mean squared norm is D. The stored
    rows are not multiplied by it.

    Args:
        run: The run that holds the vectors.
        choices: The sites, and one view per stream.
        folder: A folder that does not exist yet.
        about: The origin of the vectors as a JSON object, which becomes an entry of `scales.json`.
        dtype: The numbers of the matrices. The bits of bfloat16 are stored as uint16, because numpy has no such
            type.
        seed: The seed of the drawn orders.

    Raises:
        UsageError: For a value that float16 cannot hold.
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
        rows, roles, files = _write_matrices(run, choice, stream_folder, stored, order)
        for site, file in files.items():
            scales[str(site)] = {"file": file.relative_to(folder).as_posix(), **_scale(file)}
        _write_index(run, rows, roles, stream_folder / INDEX)
    head = {"dtype": dtype, "seed": seed, "sites": scales, "about": json.loads(about)}
    (folder / SCALES).write_text(json.dumps(head, indent=2), encoding="utf-8", newline="\n")


def _write_matrices(
    run: Run, choice: StreamChoice, folder: Path, dtype: np.dtype[Any], order: NDArray[np.intp]
) -> tuple[NDArray[np.int32], list[str], dict[Site, Path]]:
    """Fill a file per site in one pass over the run.

    Args:
        run: The run that holds the vectors.
        choice: The sites and views of one stream.
        folder: The folder of the stream.
        dtype: The stored type, float16 or uint16.
        order: (N,) row of every vector.

    Returns:
        Rows (4, N) of position, inference, token and role, as in `VectorBlock`; the roles; the files by
        site.
    """
    count = count_vectors(run, choice)
    files = {site: folder / f"{site}.npy" for site in choice.sites}
    shape = count, choice.stored.width
    maps = {
        site: open_memmap(file, "w+", dtype, shape)  # type: ignore[no-untyped-call]
        for site, file in files.items()
    }
    for file in files.values():
        _reserve(file)
    rows, roles, start = np.zeros((4, count), np.int32), dict[str, int](), 0
    for block in blocks(run, [choice]):
        end = start + block.tokens.size
        places = order[start:end]
        codes = [roles.setdefault(role, len(roles)) for role in block.roles]
        origins: tuple[Any, ...] = (block.position, block.inference, block.tokens, codes)
        for row, cells in zip(rows, origins, strict=True):
            row[places] = cells
        for site, vectors in zip(choice.sites, block.values, strict=True):
            maps[site][places] = _as_stored(vectors, dtype, site, run)
        start = end
    for memory_map in maps.values():
        memory_map.flush()
    return rows, list(roles), files


def _reserve(file: Path) -> None:
    """Allocate the blocks of a file: on a full disk, writing into a mapped one would end the process by SIGBUS."""
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
    """Return the mean squared norm of stored rows, and the factor of rows with which it becomes D."""
    stored = np.load(file, mmap_mode="r")
    total = 0.0
    for start in range(0, len(stored), _READ_AT_ONCE):
        part = np.asarray(stored[start : start + _READ_AT_ONCE])
        values = decode_bfloat16(part) if part.dtype == np.uint16 else part
        total += float(np.square(values, dtype=np.float64).sum())
    mean = total / len(stored)
    return {"mean_squared_norm": mean, "scale": float(np.sqrt(stored.shape[1] / mean)) if mean else 1.0}


def _write_index(run: Run, rows: NDArray[np.int32], roles: list[str], out: Path) -> None:
    """Write the index, whose row i describes row i of every matrix of the stream."""
    pa, pq = require("pyarrow", "export"), require("pyarrow.parquet", "export")
    origins, names = Origins(run), np.array(roles)
    schema = pa.schema(origins.fields)
    with pq.ParquetWriter(out, schema) as writer:
        for start in range(0, rows.shape[1], _INDEXED_AT_ONCE):
            positions, inferences, tokens, codes = rows[:, start : start + _INDEXED_AT_ONCE]
            columns = origins.columns(positions, inferences, tokens, names[codes])
            writer.write_table(pa.table([columns[name] for name in schema.names], schema=schema))
