"""A LeRobotDataset of format 3.0 on this machine: features, files, their hashes, and its download.

Rows and pictures are read from the very files that are hashed, without a cache that is keyed by path and time. A
file that meta does not name is never read.
"""

import glob
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit._system.parquet_files import read_parquet
from probe_kit.errors import RecordingError, UsageError
from probe_kit.extract.sources.lerobot_meta import (
    HALF,
    IMAGE,
    KEYS,
    NUMERIC,
    EpisodeMeta,
    LeRobotMeta,
)
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.hooks.checkpoints.checkpoint import OFFLINE_WAY_OUT, hub_reason, unreachable, way_out
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.suite.pictures import LARGEST_PICTURE, decode_bytes

STATISTICS = "meta/stats.json"
MOST_FRAMES = 64
"""The most chosen frames that one row holds."""
_COMMIT = re.compile(r"[0-9a-f]{40}")


class LeRobotFolder(LeRobotMeta):
    """A data set on this machine whose meta is read."""

    @property
    def columns(self) -> list[str]:
        """The features of one number each, without those that lead to other tables."""
        return [
            name
            for name, feature in self.features.items()
            if feature["dtype"] in NUMERIC and tuple(feature["shape"]) == (1,) and name not in KEYS
        ]

    def width(self, feature: str) -> int | None:
        """Return how many numbers a feature has; None where the data set lacks it."""
        if feature not in self.features:
            return None
        shape = tuple(self.features[feature]["shape"])
        if len(shape) != 1 or self.features[feature]["dtype"] not in NUMERIC:
            raise RecordingError(
                f"{self.path.name}: {feature} is {self.features[feature]['dtype']} of shape {shape}; expected a "
                "list of numbers"
            )
        return int(shape[0])

    def names(self, feature: str) -> list[str]:
        """Return the names of the numbers of a feature; their positions where the data set names none."""
        return list(self.feature_names(feature) or map(str, range(self.width(feature) or 0)))

    def statistics(self, feature: str) -> FeatureStatistics | None:
        """Return the statistics of a feature that the data set stores of all its frames; None without any.

        They are a summary that a later edit of the frames can leave behind: a file that cannot be read is none.
        """
        path, width = self.path / STATISTICS, self.width(feature)
        if width is None or not path.is_file():
            return None
        try:
            stored = parse_json(read_regular(path))
            return FeatureStatistics.of(stored[feature], width)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def picture_shape(self, feature: str) -> tuple[int, int]:
        """Return height and width of a camera's pictures."""
        shape, names = self.features[feature]["shape"], list(self.features[feature].get("names") or ())
        if names and names[0].startswith("channel"):
            return int(shape[1]), int(shape[2])
        return int(shape[0]), int(shape[1])

    def encoding(self, feature: str) -> str:
        """Return the storage of a camera's pictures: `image`, or the codec of its video."""
        entry = self.features[feature]
        info = entry.get("info") or entry.get("video_info") or {}
        return IMAGE if entry["dtype"] == IMAGE else str(info.get("video.codec", "video"))

    @cached_property
    def lengths(self) -> list[int]:
        """The number of frames of every episode."""
        return [episode.length for episode in self.episodes]

    @cached_property
    def by_file(self) -> Mapping[Path, list[EpisodeMeta]]:
        """The episodes of every data file."""
        by_file: dict[Path, list[EpisodeMeta]] = {}
        for episode in self.episodes:
            by_file.setdefault(self.path / episode.file, []).append(episode)
        return by_file

    # -- files -----------------------------------------------------------------------------------------

    @cached_property
    def meta_blake2b(self) -> str:
        """The hash of names and bytes of all files in `meta`."""
        return self.opened.hash_of(sorted(path for path in (self.path / "meta").rglob("*") if path.is_file()))

    def content_blake2b(self, episode: int, cameras: Sequence[str]) -> str:
        """Return the hash of the files that hold the numbers of an episode, and the pictures of some cameras."""
        return self.opened.hash_of(self.files(episode, cameras))

    def files(self, episode: int, cameras: Sequence[str]) -> list[Path]:
        """Return the files that hold an episode and the videos of some cameras."""
        meta = self.episodes[episode]
        videos = [meta.videos[key].file for key in cameras if self.is_video(key)]
        return [self.path / file for file in (meta.file, *videos)]

    # -- checks ----------------------------------------------------------------------------------------

    def select_episodes(self, episodes: Sequence[int] | None) -> list[int]:
        """Return the episodes that were asked for, all for None. Raises RecordingError for a missing one."""
        count = len(self.lengths)
        if outside := [number for number in episodes or () if number >= count]:
            raise RecordingError(
                f"{self.path.name} has {count} episodes, counted from 0; asked for {outside[0]}. Give episodes "
                f"within 0:{count}"
            )
        return list(range(count)) if episodes is None else list(episodes)

    def check_files(self, episodes: Sequence[int], cameras: Sequence[str]) -> None:
        """Raise RecordingError for a missing file of these episodes, or a file of data that meta does not name."""
        self._check_unnamed()
        for episode in episodes:
            for file in self.files(episode, cameras):
                if not file.is_file():
                    raise RecordingError(
                        f"{file.relative_to(self.path)} of episode {episode} is missing in {self.path.name}. Copy "
                        "the data set again, or leave the episode out"
                    )

    def _check_unnamed(self) -> None:
        """Raise RecordingError for a Parquet file of data that no episode is in; hidden files do not count."""
        listed = set(self.by_file)
        folders = {self.path / episode.file.parts[0] for episode in self.episodes if len(episode.file.parts) > 1}
        present = {path for folder in folders for path in folder.rglob("*.parquet") if path.name[0] != "."}
        if unnamed := sorted(present - listed - set((self.path / "meta").rglob("*.parquet"))):
            raise RecordingError(
                f"{self.path.name} holds {unnamed[0].relative_to(self.path)}, in which meta/episodes names no "
                "episode; expected no other files of data. Move it out of the data set, or copy the data set again"
            )


def open_lerobot(source: LeRobotSource) -> LeRobotFolder:
    """Open the data set of `source`; one of the hub is downloaded, but only its `meta`.

    Raises:
        RecordingError: For another format or missing files.
        UsageError: For a hub data set without network or at a revision that does not exist.
        MissingExtraError: Without the extra of recordings.
    """
    if source.is_local:
        return LeRobotFolder.read(Path(source.folder).expanduser().resolve())
    repo, _, revision = source.folder.partition("@")
    commit = resolved_commit(repo, revision)
    return LeRobotFolder.read(_download(repo, commit, ["meta/*", "meta/**/*"]), repo, commit)


def resolved_commit(repo: str, revision: str) -> str:
    """Return the 40-digit commit of a hub data set. Raises UsageError without network or such a revision."""
    if _COMMIT.fullmatch(revision):
        return revision
    if reason := unreachable():
        raise UsageError(
            f"{repo}{'@' + revision if revision else ''} names no commit, and the hub cannot be asked for one: "
            f"{reason}. Give {repo}@COMMIT with 40 digits, or a folder that exists"
        )
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    try:
        commit = HfApi().dataset_info(repo, revision=revision or None).sha
    except HfHubHTTPError as error:
        raise UsageError(
            f"the hub gives no data set {repo} at {revision or 'main'} ({hub_reason(error)}). {way_out(error)}"
        ) from error
    if commit is None:
        raise UsageError(f"the hub names no commit of {repo}; give {repo}@COMMIT with 40 digits")
    return str(commit)


def fetched(folder: LeRobotFolder, episodes: Sequence[int], cameras: Sequence[str]) -> None:
    """Download the files of some episodes, if the data set is one of the hub."""
    if folder.repo is not None and folder.revision is not None:
        names = {
            file.relative_to(folder.path).as_posix()
            for episode in episodes
            for file in folder.files(episode, cameras)
        }
        _download(folder.repo, folder.revision, sorted(map(glob.escape, names)))


def _download(repo: str, commit: str, patterns: list[str]) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    offline = bool(unreachable())
    try:
        return Path(
            snapshot_download(
                repo, repo_type="dataset", revision=commit, allow_patterns=patterns, local_files_only=offline
            )
        )
    except (HfHubHTTPError, LocalEntryNotFoundError, OSError) as error:
        raise UsageError(
            f"{repo}@{commit} cannot be fetched ({hub_reason(error)}). "
            f"{OFFLINE_WAY_OUT if offline else way_out(error)}; or give a folder that exists"
        ) from error


# -- frames ------------------------------------------------------------------------------------------------------


OFF_GRID_S = 1e-4
"""The seconds by which a timestamp may differ from frame / fps, and a picture of a video from its timestamp."""
MOST_AT_ONCE = 32_000_000
"""The bytes of columns that are read of a whole file, so that not every episode opens it."""
OTHER_RATE = 0.05
"""The share by which the frame rate of a video may differ from the data set's."""
_EPISODE, _INDEX = "episode_index", "index"


@dataclass(frozen=True)
class _DataFile:
    """A Parquet file of data.

    Attributes:
        first: For each of its episodes, the row of the first frame.
        latest: The rows that were read last, by their columns: whole row groups, and the number of their first
            row.
    """

    path: Path
    first: Mapping[int, int]
    latest: dict[tuple[str, ...], tuple[Any, int]] = field(default_factory=dict)


class LeRobotFrames:
    """The frames and numbers of chosen episodes, decoded when they are asked for. Opened once per process."""

    def __init__(self, folder: LeRobotFolder) -> None:
        self.folder = folder
        self._data_file = lru_cache(maxsize=2)(self._scanned)
        self._lengths: dict[Path, tuple[float, float]] = {}

    def pictures(self, episode: int, frame: int, cameras: Sequence[str]) -> dict[str, NDArray[np.uint8]]:
        """Return pictures (H, W, 3) uint8 by camera; of stored images the very bytes. Raises RecordingError."""
        return {
            camera: self._of_video(episode, frame, camera)
            if self.folder.is_video(camera)
            else self._of_image(episode, frame, camera)
            for camera in cameras
        }

    def numbers(self, episode: int, features: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return the numbers (T, D) of every feature, of one number (T, 1); an empty cell is NaN.

        Raises:
            RecordingError: If the frames are not a grid, or a feature has other numbers than meta says.
        """
        columns = list(dict.fromkeys((*features, "frame_index", "timestamp")))
        table = self._rows(episode, columns)
        values = {name: self._values(episode, name, table.column(name)) for name in columns}
        self._check_grid(episode, values["frame_index"][:, 0], values["timestamp"][:, 0])
        return values

    def check(self, episodes: Sequence[int], cameras: Sequence[str]) -> None:
        """Raise RecordingError unless the numbers and files of these episodes can be shown.

        Every video must be as long as its episodes say. Two pictures of the first episode are decoded.
        """
        for episode in episodes:
            self.numbers(episode, ())
            for camera in filter(self.folder.is_video, cameras):
                self._check_video(self.folder.episodes[episode], camera)
        for episode in episodes[:1]:
            for frame in {0, self.folder.lengths[episode] - 1}:
                self.pictures(episode, frame, cameras)

    # -- rows ------------------------------------------------------------------------------------------

    def _rows(self, episode: int, columns: Sequence[str]) -> Any:
        """Return the table (T rows) of an episode. Row groups are kept until others of these columns are read."""
        meta, key = self.folder.episodes[episode], tuple(columns)
        data = self._data_file(self.folder.path / meta.file)
        first = data.first[episode]
        latest, begin = data.latest.get(key, (None, 0))
        if latest is None or not begin <= first <= first + meta.length <= begin + latest.num_rows:
            latest, begin = data.latest[key] = self._read(data.path, key, first, first + meta.length)
        return latest.slice(first - begin, meta.length)

    def _read(self, path: Path, columns: Sequence[str], first: int, end: int) -> tuple[Any, int]:
        """Return row groups with rows `first` to `end`, or all if small, and the number of their first row."""
        with self.folder.opened.parquet(path) as parquet:
            if missing := [name for name in columns if name not in parquet.schema_arrow.names]:
                raise RecordingError(
                    f"{self._where(path)} has no column {missing[0]!r}, which meta/info.json names; it has "
                    f"{', '.join(parquet.schema_arrow.names)}. Copy the data set again, or repair its meta"
                )
            sizes = [parquet.metadata.row_group(number).num_rows for number in range(parquet.num_row_groups)]
            ends = np.cumsum(sizes)
            groups = np.flatnonzero((ends > first) & (ends - sizes < end))
            if _size_of(parquet.metadata, columns) <= MOST_AT_ONCE:
                groups = np.flatnonzero(sizes)
            return read_parquet(parquet, columns, groups.tolist()), int((ends - sizes)[groups[0]])

    def _scanned(self, path: Path) -> _DataFile:
        """Return a data file whose rows are those that meta says. Raises RecordingError for others."""
        with self.folder.opened.parquet(path) as parquet:
            if missing := [name for name in (_EPISODE, _INDEX) if name not in parquet.schema_arrow.names]:
                raise RecordingError(
                    f"{self._where(path)} has no column {missing[0]!r}; expected the columns of format 3.0. Copy "
                    "the data set again"
                )
            table = read_parquet(parquet, [_EPISODE, _INDEX])
        episodes, indices = (np.asarray(table.column(name).to_pylist(), np.float64) for name in (_EPISODE, _INDEX))
        expected = {episode.number: episode for episode in self.folder.by_file[path]}
        begins = dict(zip(*(part.tolist() for part in np.unique(episodes, return_index=True)), strict=True))
        counts = dict(zip(*(part.tolist() for part in np.unique(episodes, return_counts=True)), strict=True))
        if strange := [number for number in begins if number not in expected]:
            raise RecordingError(
                f"{self._where(path)} holds frames of episode {strange[0]:g}, which meta/episodes does not name "
                f"in this file; expected {_listed(sorted(expected))}. Copy the data set again, or repair its meta"
            )
        first = {}
        for number, episode in expected.items():
            if (count := counts.get(number, 0)) != episode.length:
                raise RecordingError(
                    f"{self._where(path)} holds {count} frames of episode {number}; meta/episodes says "
                    f"{episode.length}. Copy the data set again, or repair its meta"
                )
            begin = begins[number]
            rows, due = slice(begin, begin + episode.length), episode.start + np.arange(episode.length)
            if off := np.flatnonzero((episodes[rows] != number) | (indices[rows] != due)).tolist():
                raise RecordingError(
                    f"{self._where(path)}: row {begin + off[0]} has the index {indices[rows][off[0]]:g} and is of "
                    f"episode {episodes[rows][off[0]]:g}; expected the index {due[off[0]]} of episode {number}. "
                    "Copy the data set again, or repair its indices"
                )
            first[number] = begin
        return _DataFile(path, first)

    def _values(self, episode: int, name: str, column: Any) -> NDArray[np.float64]:
        """Return one column (T, D), in the type that meta says."""
        feature, length = self.folder.features.get(name), self.folder.lengths[episode]
        width = 1 if feature is None else int(np.prod(feature["shape"]))
        where = f"{self.folder.path.name}, episode {episode}: {name}"
        cells = column.to_pylist()
        if sizes := {len(cell) for cell in cells if isinstance(cell, list)} - {width}:
            raise RecordingError(
                f"{where} has {sizes.pop()} numbers in the data and {width} in meta/info.json; expected the "
                "same. Copy the data set again, or repair its meta"
            )
        try:
            values = np.asarray(cells, np.float64).reshape(length, width)
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"{where} holds no numbers ({str(error)[:200]}); meta/info.json says "
                f"{feature and feature['dtype']}. Copy the data set again, or repair its meta"
            ) from error
        return (
            values.astype(np.float32).astype(np.float64) if feature and feature["dtype"] == "float32" else values
        )

    def _check_grid(self, episode: int, frames: NDArray[np.float64], timestamps: NDArray[np.float64]) -> None:
        due = np.arange(len(frames))
        off = np.flatnonzero(
            ~((frames == due) & (np.abs(timestamps - due / self.folder.fps) <= OFF_GRID_S * (1 + due / 1e4)))
        )
        if off.size:
            line = int(off[0])
            raise RecordingError(
                f"{self.folder.path.name}, episode {episode}: line {line} is frame {frames[line]:g} at "
                f"{timestamps[line]:.4f} s; expected frame {line} at {line / self.folder.fps:.4f} s "
                f"({self.folder.fps:g} frames per second). Repair the timestamps, or leave the episode out"
            )

    # -- pictures --------------------------------------------------------------------------------------

    def _of_image(self, episode: int, frame: int, camera: str) -> NDArray[np.uint8]:
        cell = self._rows(episode, [camera]).column(camera)[frame].as_py()
        content = cell.get("bytes") if isinstance(cell, dict) else cell
        where = f"{self.folder.path.name}: the picture of {camera} at frame {frame} of episode {episode}"
        if not isinstance(content, bytes):
            path = cell.get("path") if isinstance(cell, dict) else None
            raise RecordingError(
                f"{where} is not in the data file"
                + (f", which names {path}" if path else "")
                + "; expected the bytes "
                "of a picture, because only they are hashed. Write the data set again with its pictures in it"
            )
        return np.asarray(decode_bytes(content, f"{where}:", RecordingError, "Copy the data set again.")).copy()

    def _of_video(self, episode: int, frame: int, camera: str) -> NDArray[np.uint8]:
        meta = self.folder.episodes[episode]
        part = meta.videos[camera]
        path = self.folder.path / part.file
        self.folder.opened.check(path)
        moment = part.begin + float(self.numbers(episode, ())["timestamp"][frame, 0])
        try:
            with _quiet():
                from lerobot.datasets.video_utils import decode_video_frames

                decoded = decode_video_frames(path, [moment], OFF_GRID_S, "pyav", return_uint8=True)
        except Exception as error:
            raise RecordingError(
                f"{self.folder.path.name}: {part.file} shows no picture of {camera} at {moment:.4f} s, frame "
                f"{frame} of episode {episode} ({type(error).__name__}: {str(error)[:300]}). Copy the data set "
                "again"
            ) from error
        return np.ascontiguousarray(decoded[0].numpy().transpose(1, 2, 0))

    def _check_video(self, episode: EpisodeMeta, camera: str) -> None:
        """Raise RecordingError for a video that ends before an episode, or has another rate than the data set."""
        part, fps = episode.videos[camera], self.folder.fps
        duration, rate = self._length_of(self.folder.path / part.file)
        if duration < part.end - HALF / fps or (rate and abs(rate - fps) > OTHER_RATE * fps):
            raise RecordingError(
                f"{self.folder.path.name}: {part.file} lasts {duration:.4f} s at {rate:g} frames per second; "
                f"meta says {fps:g} frames per second, and that it shows episode {episode.number} until "
                f"{part.end:.4f} s. Copy the data set again, or repair its meta"
            )

    def _length_of(self, path: Path) -> tuple[float, float]:
        """Return seconds and frames per second of a video, by its header."""
        import av

        if path not in self._lengths:
            self.folder.opened.check(path)
            try:
                with av.open(str(path)) as container:
                    stream = container.streams.video[0]
                    base = float(stream.time_base or 0)
                    lasts = stream.duration * base if stream.duration else (container.duration or 0) / 1e6
                    if max(stream.width, stream.height) > LARGEST_PICTURE:
                        raise RecordingError(
                            f"{self._where(path)} claims to be {stream.width}×{stream.height} pixels; at most "
                            f"{LARGEST_PICTURE} are read. Make it smaller"
                        )
                    self._lengths[path] = lasts, float(stream.average_rate or 0)
            except (av.error.FFmpegError, IndexError, OSError) as error:
                raise RecordingError(
                    f"{self._where(path)} is no video that PyAV opens ({str(error)[:200]}). Copy the data set "
                    "again"
                ) from error
        return self._lengths[path]

    def _where(self, path: Path) -> str:
        return f"{self.folder.path.name}: {path.relative_to(self.folder.path)}"


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the log of lerobot, which warns about its other decoder once in each process."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)


def _size_of(metadata: Any, columns: Sequence[str]) -> int:
    """Return the bytes of some columns of a Parquet file, uncompressed."""
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    chunks = (group.column(number) for group in groups for number in range(group.num_columns))
    return sum(
        chunk.total_uncompressed_size
        for chunk in chunks
        if any(chunk.path_in_schema == name or chunk.path_in_schema.startswith(f"{name}.") for name in columns)
    )


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")
