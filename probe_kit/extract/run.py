"""Reading a run: episodes, pooled columns, tokens. Needs neither a simulator nor a model."""

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe_kit.errors import RunDamagedError, RunIncompleteError, RunNotFoundError, UnknownSiteError
from probe_kit.extract.commits import read_commits
from probe_kit.extract.layout import (
    CERTIFICATE_FILE,
    PLAN_FILE,
    RUN_FILE,
    SCHEMA_VERSION,
    StoredStream,
    decode_bfloat16,
    open_array,
)
from probe_kit.hooks.sites import Site, Stream

if TYPE_CHECKING:
    import xarray as xr


def open_run(path: Path | str, allow_partial: bool = False) -> "Run":
    """Open the run in folder `path`.

    allow_partial: open it also if episodes of the plan are still missing; `episodes` then lists fewer.
    Raises RunNotFoundError if it is none, RunIncompleteError if it is unfinished, RunDamagedError if its schema
    is another one or a committed object is missing.
    """
    run = Run(Path(path))
    done = len(run.episodes)
    if done < run.planned and not allow_partial:
        raise RunIncompleteError(
            f"{path} has {done} of {run.planned} episodes. Finish it with the same `probe-kit extract`, or accept "
            "what is there (--partial, allow_partial=True)"
        )
    return run


class Run:
    """A run on disk. Rows of every array follow `episodes`, which lists the committed ones in plan order."""

    def __init__(self, path: Path) -> None:
        self.path = path
        file = path / RUN_FILE
        if not file.is_file():
            raise RunNotFoundError(f"{path} is not a run: it has no {RUN_FILE}. Make one with `probe-kit extract`")
        card = json.loads(file.read_text())
        if card["schema_version"] != SCHEMA_VERSION:
            raise RunDamagedError(
                f"{path} has schema {card['schema_version']}; this version reads {SCHEMA_VERSION}; update it"
            )
        self.settings: dict[str, Any] = card["settings"]
        self.settings_sha256: str = card["settings_sha256"]
        self._stored = {s["name"]: StoredStream.from_json(s) for s in card["streams"]}

    @property
    def model(self) -> str:
        """The model's name, as given to `probe-kit extract`."""
        return str(self.settings["model"])

    @property
    def random_weights(self) -> bool:
        """Whether nobody trained the weights this run was made with."""
        return bool(self.settings["random_weights"])

    @property
    def suite(self) -> str:
        """Identity of the suite that was run, `name@version#hash`."""
        return str(self.settings["suite"]["identity"])

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """What was loaded and checked."""
        certificate: dict[str, Any] = json.loads((self.path / CERTIFICATE_FILE).read_text())
        return certificate

    @cached_property
    def _commits(self) -> dict[int, dict[str, Any]]:
        return read_commits(self.path)

    @cached_property
    def planned(self) -> int:
        """Episodes the plan has, committed or not."""
        return len(self._plan)

    @cached_property
    def _plan(self) -> list[dict[str, Any]]:
        episodes: list[dict[str, Any]] = json.loads((self.path / PLAN_FILE).read_text())["episodes"]
        return episodes

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """One row per committed episode: the plan's columns, then the outcome's."""
        rows = [
            {**planned, **self._commits[planned["episode"]]["outcome"]}
            for planned in self._plan
            if planned["episode"] in self._commits
        ]
        return pd.DataFrame(rows)

    @property
    def streams(self) -> dict[str, Stream]:
        """The captured streams; empty for a scripted run."""
        return {name: stored.stream for name, stored in self._stored.items()}

    def views(self, stream: str) -> tuple[str, ...]:
        """Pooled views of one stream."""
        return self._stream(stream).views

    def sites(self, stream: str) -> list[Site]:
        """All sites of one stream."""
        return self._stream(stream).stream.sites()

    def column(self, site: Site, view: str = "mean", call: int = 0) -> NDArray[np.float32]:
        """(E, D) float32: one pooled view of one site at one captured inference, a row per episode.

        Raises UnknownSiteError, or RunDamagedError if stored bytes are missing or fail their checksum.
        """
        stored = self._check(site)
        if view not in stored.views:
            raise UnknownSiteError(f"no view {view!r} of {site.stream}; stored: {', '.join(stored.views)}")
        index: tuple[Any, ...] = (slice(None), call, *stored.at(site), stored.views.index(view))
        return np.asarray(self._pooled(site.stream)[index])

    def tokens(
        self, site: Site, role: str | None = None, call: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(E, T, D) float32 values and (E, T) bool mask of one site; the mask chooses `role`, or all but padding.

        Raises UnknownSiteError if the run was extracted without `--tokens all`.
        """
        from probe_kit.hooks.roles import Roles, Span

        stored = self._check(site)
        if self.settings["tokens"] != "all":
            raise UnknownSiteError(f"{self.path} stores pooled views only; extract with --tokens all")
        array = open_array(self.path, f"{site.stream}/tokens")
        rows = self.episodes["episode"].to_numpy()
        values = np.stack([_read(array, (row, call, *stored.at(site))) for row in rows])
        mask = np.zeros(values.shape[:2], bool)
        for position, row in enumerate(rows):
            spans = self._commits[row]["roles"][call][site.stream]
            roles = Roles(tuple(Span(*span) for span in spans))
            mask[position, : len(roles)] = roles.valid if role is None else roles.mask(role)
        return decode_bfloat16(values), mask

    def xarray(self) -> "xr.Dataset":
        """The pooled arrays with labelled views and episodes; dimensions of a stream carry its name."""
        import xarray as xr

        episodes = self.episodes
        arrays = {}
        for name, stored in self._stored.items():
            own = [f"{name}_{dimension}" for dimension in (*stored.dimensions, "view", "feature")]
            arrays[f"{name}_pooled"] = xr.DataArray(
                self._pooled(name), dims=["episode", "call", *own], coords={f"{name}_view": list(stored.views)}
            )
        labels = ("episode_id", "category", "layout", "side_correct", "outcome")
        return xr.Dataset(arrays, coords={label: ("episode", episodes[label]) for label in labels})

    def _pooled(self, stream: str) -> NDArray[np.float32]:
        """(E, S, [I,] L, V, D) rows of the committed episodes, read once per stream."""
        if stream not in self._rows:
            array = open_array(self.path, f"{stream}/pooled")
            self._rows[stream] = np.stack([_read(array, (row,)) for row in self.episodes["episode"]])
        return self._rows[stream]

    @cached_property
    def _rows(self) -> dict[str, NDArray[np.float32]]:
        return {}

    def _stream(self, name: str) -> StoredStream:
        if name not in self._stored:
            stored = ", ".join(self._stored) or "none (a scripted run has no activations)"
            raise UnknownSiteError(f"{self.path} has no stream {name!r}; stored: {stored}")
        return self._stored[name]

    def _check(self, site: Site) -> StoredStream:
        stored = self._stream(site.stream)
        if site not in stored.stream.sites():
            raise UnknownSiteError(
                f"{self.path} has no site {site}; {site.stream} has {stored.layers} layers"
                + (f" and {stored.iterations} iterations" if stored.iterations else "")
            )
        return stored


def _read(array: Any, index: tuple[int, ...]) -> NDArray[Any]:
    from zarr.errors import ChunkNotFoundError

    try:
        return np.asarray(array[index])
    except (ChunkNotFoundError, ValueError, RuntimeError) as error:
        raise RunDamagedError(
            f"{array.path} at {index} cannot be read: {error}. Delete commits/{index[0]:08d}.json and run the "
            "same `probe-kit extract` again to redo the episode"
        ) from error
