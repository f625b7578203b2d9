"""A LeRobotDataset of format 3.0 on this machine: features, files, their hashes, and its download.

Rows and pictures are read from the very files that are hashed, without a cache that is keyed by path and time. A
file that meta does not name is never read.
"""

import glob
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit._system.parquet_files import read_parquet
from probe_kit.errors import RecordingError, UsageError
from probe_kit.extract.sources.frame_times import BY_FAR, NONE, Drift, TickTimes, nearest_by_far
from probe_kit.extract.sources.lerobot_formats import EPISODES
from probe_kit.extract.sources.lerobot_meta import (
    HALF,
    IMAGE,
    KEYS,
    NUMERIC,
    EpisodeMeta,
    LeRobotMeta,
)
from probe_kit.extract.sources.recorded_video import RecordedVideo, VideoError
from probe_kit.extract.sources.recording import LeRobotSource, episodes_text
from probe_kit.hooks.checkpoints.checkpoint import OFFLINE_WAY_OUT, hub_reason, unreachable, way_out
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.families.shared.feature_names import read_names
from probe_kit.suite.pictures import decode_bytes

STATISTICS = "meta/stats.json"
MOST_FRAMES = 64
"""The most chosen frames that one row holds."""
_MOST_WIDTH = 1 << 16
"""The most numbers of a state or an action."""
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
        """Return how many numbers a feature has; None where the data set lacks it, or none is in it."""
        if feature not in self.features:
            return None
        shape = tuple(self.features[feature]["shape"])
        if len(shape) != 1 or self.features[feature]["dtype"] not in NUMERIC:
            raise RecordingError(
                f"{self.path.name}: {feature} is {self.features[feature]['dtype']} of shape {shape}; expected a "
                "list of numbers"
            )
        if shape[0] > _MOST_WIDTH:
            raise RecordingError(
                f"{self.path.name}: meta/info.json gives {feature} {shape[0]:,} numbers; expected at most "
                f"{_MOST_WIDTH:,}. Copy the data set again, or repair its meta"
            )
        return int(shape[0]) or None

    def names(self, feature: str) -> list[str]:
        """Return the names of the numbers of a feature; their positions where the data set names none."""
        return list(self.feature_names(feature) or map(str, range(self.width(feature) or 0)))

    def intrinsics(self, feature: str) -> NDArray[np.float32] | None:
        """Return the (3, 3) pinhole matrix of a camera in pixels of its picture; None where meta has none.

        It stands as `intrinsics` in the `info` of the feature, where `run export --format lerobot` writes it.

        Raises:
            RecordingError: For another shape, and numbers that are not finite.
        """
        stored = (self.features[feature].get("info") or {}).get("intrinsics")
        if stored is None:
            return None
        try:
            matrix = np.asarray(stored, np.float32)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0, np.float32)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise RecordingError(
                f"{self.name}: meta/info.json gives {feature} the intrinsics {str(stored)[:80]}; expected "
                "3 × 3 numbers"
            )
        return matrix

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
        shape, names = self.features[feature]["shape"], read_names(self.features[feature].get("names"))
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

    @cached_property
    def frames_before(self) -> Mapping[tuple[str, int], tuple[int, int]]:
        """The frames of earlier episodes, and of all, in the video file of a camera and an episode."""
        totals: dict[tuple[str, Path], int] = {}
        earlier: dict[tuple[str, int], int] = {}
        for camera in filter(self.is_video, self.cameras):
            for episode in sorted(self.episodes, key=lambda episode: episode.videos[camera].begin):
                file = camera, episode.videos[camera].file
                earlier[camera, episode.number] = totals.get(file, 0)
                totals[file] = totals.get(file, 0) + episode.length
        return {
            (camera, number): (before, totals[camera, self.episodes[number].videos[camera].file])
            for (camera, number), before in earlier.items()
        }

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
        root = Path(source.folder).expanduser().resolve()
        return LeRobotFolder.read(root).with_features(source.features)
    repo, _, revision = source.folder.partition("@")
    commit = resolved_commit(repo, revision)
    root = _download(repo, commit, ["meta/*", "meta/**/*"])
    return LeRobotFolder.read(root, repo, commit).with_features(source.features)


def resolved_commit(repo: str, revision: str) -> str:
    """Return the 40-digit commit of a hub data set. Raises UsageError without network or such a revision."""
    if _COMMIT.fullmatch(revision):
        return revision
    if reason := unreachable():
        raise UsageError(
            f"there is no folder {repo}, and the commit of this data set cannot be looked up on the hub: "
            f"{reason}. Give the folder of a data set, or {repo}@COMMIT with 40 digits of a cached one"
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
        raise UsageError(
            f"the hub's answer names no commit of {repo}; give {repo}@COMMIT with the 40 digits of the commit"
        )
    return str(commit)


def fetch_episodes(folder: LeRobotFolder, episodes: Sequence[int], cameras: Sequence[str]) -> None:
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


MOST_AT_ONCE = 32_000_000
"""The bytes of columns that are read of a whole file, so that not every episode opens it."""
OTHER_RATE = 0.05
"""The share by which the frame rate of a video may differ from the data set's."""
_MOST_VIDEOS = 16
"""The most open videos, such as one for each camera of a robot."""
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
    """The frames and numbers of chosen episodes, decoded when they are asked for. Opened once per process.

    Attributes:
        largest_drift: The largest distance of a time from its frame, of the episodes that were read; None before.
    """

    def __init__(self, folder: LeRobotFolder) -> None:
        self.folder = folder
        self.largest_drift: Drift | None = None
        self._data_file = lru_cache(maxsize=2)(self._scan)
        self._video = lru_cache(maxsize=_MOST_VIDEOS)(self._opened_video)
        self._video_times = lru_cache(maxsize=_MOST_VIDEOS)(self._named_times)
        self._regular: set[int] = set()

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
        """Raise RecordingError unless the numbers and pictures of these episodes can be shown.

        Each time must name a frame of each video, which is read without decoding. The first and the last picture
        of each episode are decoded. The error names the first episode with a fault, and the episodes without any.
        """
        faults: dict[int, str] = {}
        for episode in episodes:
            try:
                self._check_episode(episode, cameras)
            except RecordingError as error:
                faults[episode] = str(error)
        if faults:
            raise RecordingError(_first_fault(faults, episodes))

    def _check_episode(self, episode: int, cameras: Sequence[str]) -> None:
        self.numbers(episode, ())
        for camera in filter(self.folder.is_video, cameras):
            self._check_video(self.folder.episodes[episode], camera)
            self._video_times(episode, camera)
        for frame in sorted({0, self.folder.lengths[episode] - 1}):
            self.pictures(episode, frame, cameras)

    # -- rows ------------------------------------------------------------------------------------------

    def _rows(self, episode: int, columns: Sequence[str], frame: int | None = None) -> Any:
        """Return the table (T rows) of an episode, or (1 row) of a frame.

        Row groups are kept until others of these columns are read.
        """
        meta, key = self.folder.episodes[episode], tuple(columns)
        data = self._data_file(self.folder.path / meta.file)
        first, count = data.first[episode] + (frame or 0), meta.length if frame is None else 1
        latest, begin = data.latest.get(key, (None, 0))
        if latest is None or not begin <= first <= first + count <= begin + latest.num_rows:
            latest, begin = data.latest[key] = self._read(data.path, key, first, first + count)
        return latest.slice(first - begin, count)

    def _read(self, path: Path, columns: Sequence[str], first: int, end: int) -> tuple[Any, int]:
        """Return row groups with rows `first` to `end`, or all if small, and the number of their first row."""
        names, columns = columns, [self.folder.stored_names.get(name, name) for name in columns]
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
            table = read_parquet(parquet, columns, groups.tolist()).select(columns)
            return table.rename_columns(list(names)), int((ends - sizes)[groups[0]])

    def _scan(self, path: Path) -> _DataFile:
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
                f"in this file; expected {_listing(sorted(expected))}. Copy the data set again, or repair its meta"
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
        """Raise RecordingError unless every line is the next frame, and its timestamp names that frame."""
        if episode in self._regular:
            return
        due, fps = np.arange(len(frames)), Fraction(self.folder.fps)
        finite = np.where(np.isfinite(timestamps), timestamps, -1.0)
        match = nearest_by_far(TickTimes.of(finite.tolist(), 0.0, 1 / fps), range(len(frames)), Fraction(1))
        off = np.flatnonzero((frames != due) | (match.positions != due))
        if off.size:
            line = int(off[0])
            raise RecordingError(
                f"{self.folder.path.name}, episode {episode}: line {line} is frame {frames[line]:g} at "
                f"{timestamps[line]:.4f} s; expected frame {line} at {line / self.folder.fps:.4f} s "
                f"({self.folder.fps:g} frames per second), {BY_FAR}"
                + (f"; {off.size - 1} lines behind it are no better" if off.size > 1 else "")
                + ". Repair the timestamps, or leave the episode out"
            )
        self._note_drift(match.drifts, episode, None)
        self._regular.add(episode)

    def _note_drift(self, drifts: NDArray[np.float64], episode: int, camera: str | None) -> None:
        frame = int(drifts.argmax())
        steps = float(drifts[frame])
        if self.largest_drift is None or steps > self.largest_drift.steps:
            self.largest_drift = Drift(steps, steps / self.folder.fps, episode, frame, camera)

    # -- pictures --------------------------------------------------------------------------------------

    def _of_image(self, episode: int, frame: int, camera: str) -> NDArray[np.uint8]:
        cell = self._rows(episode, [camera], frame).column(camera)[0].as_py()
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
        part = self.folder.episodes[episode].videos[camera]
        path = self.folder.path / part.file
        self.folder.opened.check(path)
        time, video = int(self._video_times(episode, camera)[frame]), self._video(path)
        try:
            return video.picture(time)
        except VideoError as error:
            moment = float(time * video.base)
            raise RecordingError(
                f"{self._where(path)} shows no picture of {camera} at {moment:.4f} s, frame {frame} of episode "
                f"{episode} ({error}). Copy the data set again, or leave the episode out"
            ) from error

    def _named_times(self, episode: int, camera: str) -> NDArray[np.int64]:
        """Return the times (T,) in ticks of the video's frames that show an episode. Raises RecordingError."""
        meta, fps = self.folder.episodes[episode], Fraction(self.folder.fps)
        part = meta.videos[camera]
        path = self.folder.path / part.file
        video, timestamps = self._video(path), self.numbers(episode, ())["timestamp"][:, 0]
        times = TickTimes.of(timestamps.tolist(), part.begin, video.base)
        match = nearest_by_far(times, video.times, 1 / (fps * video.base))
        repeated = np.r_[False, np.diff(match.positions) < 1]
        if (off := np.flatnonzero((match.positions == NONE) | repeated)).size:
            frame = int(off[0])
            raise RecordingError(
                f"{self._where(path)} shows no picture of {camera} for frames {_listing(off)} of episode "
                f"{episode}: frame {frame} is at {part.begin + timestamps[frame]:.4f} s, "
                + (
                    "where the video shows the picture of the frame before it"
                    if match.positions[frame] != NONE
                    else f"{match.drifts[frame]:.2f} of a frame step from the nearest frame of the video"
                )
                + f"; expected a frame {BY_FAR}. Repair from_timestamp in {EPISODES} or the timestamps, or leave "
                "the episode out"
            )
        self._check_place(meta, camera, int(match.positions[0]), len(video.times))
        self._note_drift(match.drifts, episode, camera)
        return np.asarray(video.times, np.int64)[match.positions]

    def _check_place(self, episode: EpisodeMeta, camera: str, first: int, count: int) -> None:
        """Raise RecordingError for an episode that begins at a wrong frame of a video that shows episodes only.

        Args:
            episode: The episode.
            camera: Its camera.
            first: The position in the video of its first frame.
            count: The number of frames of the video.
        """
        part = episode.videos[camera]
        due, total = self.folder.frames_before[camera, episode.number]
        if count == total and first != due:
            raise RecordingError(
                f"{self._where(self.folder.path / part.file)}: {EPISODES} says that episode {episode.number} "
                f"begins at {part.begin:.4f} s, where the video shows its frame {first}; expected frame {due}, "
                f"because its {count} frames are those of its episodes one after another. Repair from_timestamp"
            )

    def _check_video(self, episode: EpisodeMeta, camera: str) -> None:
        """Raise RecordingError for a video that ends before an episode, or has another rate than the data set."""
        part, fps = episode.videos[camera], self.folder.fps
        path = self.folder.path / part.file
        video = self._video(path)
        ends = float(video.times[-1] * video.base) + 1 / fps
        if ends < part.end - HALF / fps or (video.rate and abs(video.rate - fps) > OTHER_RATE * fps):
            raise RecordingError(
                f"{self._where(path)} ends at {ends:.4f} s and has {video.rate:g} frames per second; meta says "
                f"{fps:g} frames per second, and that it shows episode {episode.number} until {part.end:.4f} s. "
                "Copy the data set again, or repair its meta"
            )

    def _opened_video(self, path: Path) -> RecordedVideo:
        self.folder.opened.check(path)
        try:
            return RecordedVideo(path)
        except VideoError as error:
            raise RecordingError(f"{self._where(path)} {error}") from error

    def _where(self, path: Path) -> str:
        return f"{self.folder.path.name}: {path.relative_to(self.folder.path)}"


def _size_of(metadata: Any, columns: Sequence[str]) -> int:
    """Return the bytes of some columns of a Parquet file, uncompressed."""
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    chunks = (group.column(number) for group in groups for number in range(group.num_columns))
    return sum(
        chunk.total_uncompressed_size
        for chunk in chunks
        if any(chunk.path_in_schema == name or chunk.path_in_schema.startswith(f"{name}.") for name in columns)
    )


def _first_fault(faults: Mapping[int, str], episodes: Sequence[int]) -> str:
    """Return the fault of the first episode, with the option that chooses the episodes without one."""
    text = next(iter(faults.values()))
    sound = [episode for episode in episodes if episode not in faults]
    if len(faults) > 1:
        text += f". Of {len(episodes)} episodes, {len(faults)} are refused: {_listing(list(faults))}"
    if sound:
        text += f". Without {'it' if len(faults) == 1 else 'them'}: --episodes {episodes_text(sound)}"
    return text


def _listing(numbers: Sequence[int] | NDArray[np.int64]) -> str:
    return ", ".join(map(str, numbers[:5])) + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")
