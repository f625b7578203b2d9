"""Export of a run for tools that read another format: a file, or a folder.

Everything is written row by row, so that a run larger than memory can be exported; every row passes its checksum
on the way. The sha256 of a file is written beside it, and those of a folder into it, in the form that
`sha256sum --check` reads.
"""

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.drafts import draft_of, full_disk_in_words, write_whole
from probe_kit.errors import UsageError
from probe_kit.runs.arrays import EpisodeRows
from probe_kit.runs.direction_files import about_direction, check_direction_file, write_directions
from probe_kit.runs.export_vectors import StreamChoice, choose, is_tokens, write_parquet, write_sae
from probe_kit.runs.layout import MEAN_VIEW, ArrayKind, ExportFormat, SaeDtype
from probe_kit.runs.reader import SIDE, check_sides
from probe_kit.runs.run import Run, open_run
from probe_kit.runs.store import Location
from probe_kit.version import __version__

LARGEST_CHUNK = 2**30
"""Bytes of the largest chunk that h5 gets. From 4 GiB on, HDF5 2.0 writes a layout that no HDF5 1.x opens."""
LARGEST_HEADER = 100_000_000
"""Bytes of metadata that readers of safetensors accept (version 0.8)."""
SUMS = "SHA256SUMS"
"""The file with the hashes of all other files of a folder."""


def export_run(
    path: Path | str | Location,
    style: ExportFormat,
    out: Path,
    allow_partial: bool = False,
    *,
    sites: Sequence[str] | None = None,
    view: str | None = None,
    dtype: SaeDtype = "bfloat16",
    seed: int = 0,
    suite: Path | None = None,
    scene_files: Mapping[str, Path] | None = None,
    on_episode: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the run at `path` to `out`, whole or not at all, with sha256 of every file, and return `out`.

    The format `h5` has `<stream>/pooled`, `<stream>/later`, `<stream>/tokens`, and a dataset per column under
    `episodes`. The format `safetensors` has the same names with a dot, the last two arrays as true bfloat16, and
    episodes in the metadata. Axes of both are (episode, call, [iteration,] layer, view or token, feature). The
    format `lerobot` is a LeRobotDataset of what the policy saw, for which every episode is played again.

    Three formats hold the vectors that `sites` and `view` choose, see `choose`. The format `parquet` has a row per
    vector with episode, group, inference, frame, site, view, role and token. The format `directions` has a vector
    per category, view and site, see `write_class_means`, in a .safetensors or .npz. The format `sae` is a folder.
    It has a memory map (N, D) per site in a drawn order, an index, and the scale of every site.

    Args:
        path: The folder or address of the run.
        style: The format.
        out: The file or folder to be written.
        allow_partial: Accept an unfinished run.
        sites: Names, beginnings or patterns of sites for the formats of vectors. None: all sites.
        view: The view for the formats of vectors. None: all pooled views in Parquet and directions, `mean` in
            matrices.
        dtype: The numbers of `sae`, which alone has this option.
        seed: The seed of the order of `sae`, which alone has this option.
        suite: For `lerobot`: the folder of the run's suite. None: where the run had it, or the embedded one.
        scene_files: For `lerobot`: files of the scene that were moved, `arm_urdf` and `background`.
        on_episode: For `lerobot`: called with the number of written episodes and of all.

    Raises:
        UsageError: For another format, an option that a format does not have, or a file that exists.
        UnknownSiteError: For a site or view that is not stored.
        MissingExtraError: Without a library that the format needs.
        RunDamagedError: For damaged bytes.
        DiskSpaceError: If the disk takes no more.
        NoTrajectoryError: For `lerobot`, of a run without trajectories.
        OtherFramesError: For `lerobot`, if an episode that is played again differs from the stored one.
        SuiteError: For `lerobot`, for another suite than the run's or none; and SceneError for its files.
    """
    check_format(style)
    if style not in OF_VECTORS and (sites is not None or view is not None):
        raise UsageError(
            f"--sites or --view with --format {style}, which holds all that was stored; leave them out, or "
            f"use one of {', '.join(OF_VECTORS)}"
        )
    if style != SAE and (dtype != "bfloat16" or seed):
        raise UsageError(f"--dtype or --seed with --format {style}; leave them out, or use --format sae")
    if style != LEROBOT and (suite is not None or scene_files):
        raise UsageError(
            f"--suite or files of the scene with --format {style}, which draws no picture; leave them out"
        )
    if style == DIRECTIONS:
        check_direction_file(out)
    if out.exists():
        raise UsageError(f"{out} exists; choose another --out or remove it")
    run = open_run(path, allow_partial)
    if not run.streams and style != LEROBOT:
        raise UsageError(f"{path} has no activations to export; its episodes are in `open_run(...).episodes`")
    with full_disk_in_words(out), draft_of(out) as draft:
        if style in OF_VECTORS:
            choices = choose(run, sites, view or (MEAN_VIEW if style == SAE else None))
            if style == DIRECTIONS:
                write_class_means(run, choices, draft)
            elif style == SAE:
                write_sae(run, choices, draft, _about(run, choices), dtype, seed)
            else:
                write_parquet(run, choices, draft, _about(run, choices))
        elif style == LEROBOT:
            import_module(_LEROBOT_WRITER).write_lerobot(run, draft, suite, scene_files, on_episode)
        else:
            WHOLE[style](run, draft)
        if draft.is_dir():
            _write_sums(draft)
        else:
            write_whole(out.with_name(f"{out.name}.sha256"), f"{_digest(draft)}  {out.name}\n")
        return draft.rename(out)  # last: the file never lies there without its hash


def check_format(style: str) -> None:
    """Raise UsageError for a format that is not offered."""
    if style not in FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(FORMATS)}")


def _about(run: Run, choices: Sequence[StreamChoice]) -> str:
    """Return as JSON the origin of vectors: sites and views, the run's settings, and what made the run."""
    return json.dumps(
        {
            "probe_kit": __version__,
            "run": run.label,
            "settings": run.settings,
            "settings_sha256": run.settings_sha256,
            "commits": run.stamp,
            "provenances": run.provenances,
            "sites": [str(site) for choice in choices for site in choice.sites],
            "views": {choice.name: choice.views for choice in choices},
        }
    )


def _write_sums(folder: Path) -> None:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{_digest(path)}  {path.relative_to(folder).as_posix()}\n" for path in files]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8", newline="\n")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# -- all that was stored -----------------------------------------------------------------------------------------


def _arrays(run: Run) -> Iterator[tuple[str, str, EpisodeRows]]:
    """Yield stream, kind and rows of every array of the run."""
    tokens: tuple[ArrayKind, ...] = ("tokens",) if run.settings["tokens"] == "all" else ()
    for stream in run.streams:
        for kind in (*run.root.vector_kinds, *tokens):
            yield stream, kind, run.rows(stream, kind)


def _episodes(run: Run) -> dict[str, list[Any]]:
    table = run.episodes
    columns: dict[str, list[Any]] = json.loads(table.to_json(orient="split"))
    return {name: [row[i] for row in columns["data"]] for i, name in enumerate(columns["columns"])}


def write_h5(run: Run, out: Path) -> None:
    """Write a dataset per array, and one per column of the episodes."""
    import h5py  # loads its C library, which only this format needs

    with out.open("w+b", buffering=0) as raw:
        safe = _SafeFile(raw)
        with h5py.File(safe, "w") as file:
            _fill(file, run, safe)
        safe.check()


def _fill(file: Any, run: Run, safe: "_SafeFile") -> None:
    file.attrs["settings"] = json.dumps(run.settings)
    for stream, kind, rows in _arrays(run):
        shape = rows.array.shape[1:]
        chunk = _chunk_below((1, *shape), rows.array.dtype.itemsize, LARGEST_CHUNK)
        dataset = file.create_dataset(
            f"{stream}/{kind}", (len(rows), *shape), rows.array.dtype, chunks=chunk, fletcher32=True
        )
        dataset.attrs["views"] = list(run.views(stream))
        dataset.attrs["dtype"] = "float32" if kind == "pooled" else "bfloat16 bits"
        for position, row in enumerate(rows):
            dataset[position] = row
            if safe.error is not None:  # the library does not know of it and would go through all episodes
                return
    for name, values in _episodes(run).items():
        # HDF5 has no column of mixed types, and no null among numbers: such a column becomes text.
        numeric = all(isinstance(value, bool | int | float) for value in values)
        file[f"episodes/{name}"] = values if numeric else ["" if v is None else str(v) for v in values]


def _chunk_below(shape: tuple[int, ...], item: int, limit: int) -> tuple[int, ...]:
    """Return the shape of a chunk of at most `limit` bytes: an episode, or equal parts of it along its first axes.

    Args:
        shape: Shape of an episode's array, with a 1 in front.
        item: Bytes of a number.
        limit: Largest chunk in bytes.
    """
    chunk = list(shape)
    for axis, length in enumerate(shape):
        size_of_part = item * prod(chunk) // length
        chunk[axis] = max(1, min(length, limit // size_of_part))
        if item * prod(chunk) <= limit:
            break
    return tuple(chunk)


class _SafeFile(io.RawIOBase):
    """A file that hides failed writes from the HDF5 library and keeps the error.

    The library crashes the process when it closes a file that it could not write, as on a full disk.
    """

    def __init__(self, raw: io.FileIO) -> None:
        self._raw = raw
        self.error: OSError | None = None

    def check(self) -> None:
        """Raise the first error of the file."""
        if self.error is not None:
            raise self.error

    def write(self, content: Any) -> int:
        """Write all of `content`; after an error nothing is written."""
        unwritten = memoryview(content).cast("B")
        length = len(unwritten)
        try:
            while unwritten and self.error is None:
                unwritten = unwritten[self._raw.write(unwritten) or 0 :]
        except OSError as error:
            self.error = error
        return length

    def readinto(self, buffer: Any) -> int:
        """Read as far as the file goes."""
        return self._raw.readinto(buffer) or 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place of the file."""
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        """Return the place in the file."""
        return self._raw.tell()

    def truncate(self, size: int | None = None) -> int:
        """Change the length of the file."""
        try:
            return self._raw.truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def flush(self) -> None:
        """Do nothing: the file has no buffer."""


def write_safetensors(run: Run, out: Path) -> None:
    """Write a tensor per array; settings, episodes and names of views are in the metadata."""
    header: dict[str, Any] = {
        "__metadata__": {
            "settings": json.dumps(run.settings),
            "episodes": json.dumps(_episodes(run)),
            **{f"{stream}.views": json.dumps(run.views(stream)) for stream in run.streams},
        }
    }
    end = 0
    for stream, kind, rows in _arrays(run):
        shape = [len(rows), *rows.array.shape[1:]]
        start, end = end, end + int(np.prod(shape)) * rows.array.dtype.itemsize
        dtype = "F32" if kind == "pooled" else "BF16"
        header[f"{stream}.{kind}"] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
    with out.open("wb") as file:
        _write_header(file, header)
        for _, _, rows in _arrays(run):
            for row in rows:
                file.write(np.ascontiguousarray(row).tobytes())


def _write_header(file: BinaryIO, header: dict[str, Any]) -> None:
    """Write the length, then JSON padded to eight bytes, as the format requires.

    Raises:
        UsageError: For more JSON than readers of the format accept.
    """
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > LARGEST_HEADER:
        raise UsageError(
            f"settings and episodes take {len(text):,} bytes; readers of safetensors accept {LARGEST_HEADER:,}. "
            "Export with --format h5"
        )
    file.write(len(text).to_bytes(8, "little") + text)


# -- directions --------------------------------------------------------------------------------------------------


def write_class_means(run: Run, choices: Sequence[StreamChoice], file: Path) -> None:
    """Write half the difference of the means of left and right, per category, view and site, of all episodes.

    The vectors are in raw features, so that a coefficient of 2 goes from one mean to the other. Equal means are
    left out.

    Raises:
        UsageError: For a run without sides, for views of tokens, and where no means differ.
    """
    check_sides(run, "an export of directions")
    episodes = run.episodes
    is_left = (episodes[SIDE] == "left").to_numpy()
    vectors: dict[str, NDArray[np.float32]] = {}
    about = {}
    for choice in choices:
        for view in choice.views:
            if is_tokens(view):
                raise UsageError(f"--view {view} with --format directions; take a pooled view, such as mean:image")
            for site in choice.sites:
                features = run.column(site, view).astype(np.float64)
                for category in dict.fromkeys(episodes["category"].astype(str)):
                    rows = (episodes["category"] == category).to_numpy()
                    left_rows, right_rows = features[rows & is_left], features[rows & ~is_left]
                    if not len(left_rows) or not len(right_rows):
                        continue
                    difference = left_rows.mean(axis=0) - right_rows.mean(axis=0)
                    if difference.any():
                        name, about[name] = about_direction(category, view, site, run.weights_sha256)
                        vectors[name] = (difference / 2).astype(np.float32)
    if not vectors:
        raise UsageError(f"{run.location}: the means of left and right are equal at all of these sites")
    write_directions(file, vectors, about)


# -- the formats -------------------------------------------------------------------------------------------------


LEROBOT: ExportFormat = "lerobot"
"""The format that holds pictures and actions, and no activations; its writer plays episodes again."""
_LEROBOT_WRITER = "probe_kit.extract.lerobot_export"
"""The module of its writer, which knows the scene as a source; by name, because sources know runs."""
WHOLE: dict[ExportFormat, Callable[[Run, Path], None]] = {"h5": write_h5, "safetensors": write_safetensors}
"""The formats that hold all that was stored."""
SAE: ExportFormat = "sae"
DIRECTIONS: ExportFormat = "directions"
OF_VECTORS: tuple[ExportFormat, ...] = ("parquet", SAE, DIRECTIONS)
"""The formats that hold chosen vectors."""
FORMATS: tuple[ExportFormat, ...] = (*WHOLE, LEROBOT, *OF_VECTORS)
