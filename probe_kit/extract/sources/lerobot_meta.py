"""The `meta` of a LeRobotDataset of format 3.0, its contradictions, and files read as hashed."""

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b, file_digest
from itertools import count, pairwise
from math import isfinite, prod
from pathlib import Path
from string import Formatter
from typing import Any, BinaryIO, Self

from probe_kit._system.bounded_files import open_regular, read_json_object
from probe_kit._system.counting import ranges_of
from probe_kit._system.escaping import UNSAFE
from probe_kit._system.foreign_files import while_reading
from probe_kit._system.imports import require
from probe_kit._system.parquet_files import open_parquet, read_parquet
from probe_kit.errors import RecordingError
from probe_kit.extract.sources.lerobot_formats import (
    EPISODES,
    INFO,
    TASKS,
    check_complete,
    check_continued,
    check_format,
    check_is_data_set,
    check_recorded,
    unfinished_files,
)
from probe_kit.hooks.families.shared.feature_names import names_misfit, names_of

EXTRA = "datasets"
IMAGE, VIDEO = "image", "video"
NUMERIC = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")
KEYS = ("episode_index", "index", "task_index")
"""The features of one number that lead to other tables."""
HALF = 0.5
"""The frames by which a time range of a video may differ from whole frames."""
RATE_ROUNDING = 1e-3
_NUMBER, _LENGTH, _FROM, _TO = "episode_index", "length", "dataset_from_index", "dataset_to_index"
_CHUNK, _FILE = "data/chunk_index", "data/file_index"
_TASK = "task"
_UNNAMED_INDEX = "__index_level_0__"
_AGAIN = "Copy the data set again, or repair its meta"
_DIGITS = 16
_MOST_BYTES = 1 << 40
"""The most bytes of a file, videos included: no bound but that of a disk."""
_MOST_AXES, _MOST_NUMBERS = 5, 1 << 26
"""The axes and the numbers of a feature in a frame; lerobot writes five axes at most."""
_LARGEST_PICTURE = 8192
_LEAST_FPS, _MOST_FPS = 1e-6, 1e6
_MOST_FRAMES = 1 << 31
"""The most frames of an episode: two years at 30 frames per second."""
_MOST_TEMPLATE = 1000
_WIDE = re.compile(r"\d{3}|[{}]")
"""A width of a format beyond 99, or one that a number of the table decides."""
_Stamp = tuple[int, ...]


class HashedFiles:
    """The files of one folder. Each is hashed once, and opened only while it is the file that was hashed.

    A time of change alone proves nothing, because copies and version control set it. Size, inode and the time of
    the last change of the inode are compared too, and the content again where one of them differs.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._hashed: dict[Path, tuple[str, _Stamp]] = {}

    def hash_of(self, files: Iterable[Path]) -> str:
        """Return the blake2b hash of names and bytes of several files, in their order. Raises RecordingError."""
        together = blake2b(digest_size=_DIGITS)
        for file in files:
            together.update(f"{file.relative_to(self._root).as_posix()} {self._hash(file)}\n".encode())
        return together.hexdigest()

    def open(self, file: Path) -> BinaryIO:
        """Open a file for reading. Raises RecordingError if it is missing, or was changed after it was hashed."""
        digest = self._hash(file)
        opened = _open_file(file, self._root)
        if _stamp(opened) != self._hashed[file][1]:
            now, stamp = _digest(opened)
            if now != digest:
                opened.close()
                raise RecordingError(
                    f"{file.relative_to(self._root)} of {self._root.name} was changed while it was read: its "
                    f"content had the hash {digest}, now {now}. Leave the data set as it is until the command ends"
                )
            self._hashed[file] = now, stamp
        return opened

    @contextmanager
    def parquet(self, file: Path, remedy: str = "Copy the data set again") -> Iterator[Any]:
        """Yield a Parquet file, opened as the file that was hashed. Raises RecordingError if it is unreadable."""
        pa = require("pyarrow", EXTRA)
        try:
            with self.open(file) as opened, open_parquet(opened, EXTRA) as parquet:
                yield parquet
        except MemoryError:
            raise  # Arrow's is an ArrowException too
        except (pa.ArrowException, OSError) as error:
            where = f"{self._root.name}: {file.relative_to(self._root)}"
            raise RecordingError(f"{where} cannot be read: {str(error)[:300]}. {remedy}") from error

    def check(self, file: Path) -> None:
        """Raise as `open` does, for a file that a library reads by its name."""
        self.open(file).close()

    def _hash(self, file: Path) -> str:
        if file not in self._hashed:
            with _open_file(file, self._root) as opened:
                self._hashed[file] = _digest(opened)
        return self._hashed[file][0]


def _open_file(file: Path, root: Path) -> BinaryIO:
    try:
        return open_regular(file, _MOST_BYTES)
    except OSError as error:
        raise RecordingError(
            f"{file.relative_to(root)} of {root.name} cannot be read: {error.strerror}. Copy the data set again"
        ) from error


def _digest(opened: BinaryIO) -> tuple[str, _Stamp]:
    """Return hash and stamp of an open file, which is then at its beginning."""
    stamp = _stamp(opened)
    digest = file_digest(opened, lambda: blake2b(digest_size=_DIGITS)).hexdigest()  # type: ignore[arg-type]
    opened.seek(0)
    return digest, stamp


def _stamp(opened: BinaryIO) -> _Stamp:
    status = os.fstat(opened.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


# -- the meta ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class VideoRange:
    """The part of a video file that shows an episode.

    Attributes:
        file: The path of the file in the data set.
        begin: The time in the file at which the episode begins, in seconds.
        end: The time in the file at which the episode ends, in seconds.
    """

    file: Path
    begin: float
    end: float


@dataclass(frozen=True)
class EpisodeMeta:
    """The meta of one episode.

    Attributes:
        length: The number of frames.
        start: The index of its first frame in the data set.
        file: The path of the file of its numbers, in the data set.
        videos: The parts of video files, by camera.
    """

    number: int
    length: int
    start: int
    file: Path
    videos: Mapping[str, VideoRange]


@dataclass(frozen=True)
class LeRobotMeta:
    """The content of `meta`.

    Attributes:
        opened: The files of the data set by their hashes.
        tasks: (number, text) of each line.
        repo: The name on the hub, None for a folder.
        revision: The commit on the hub, None for a folder.
        stored_names: The names in the data set of features that are read under another one, by that one.
    """

    path: Path
    opened: HashedFiles
    info: Mapping[str, Any]
    tasks: tuple[tuple[Any, Any], ...]
    episodes: tuple[EpisodeMeta, ...]
    repo: str | None = None
    revision: str | None = None
    stored_names: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, root: Path, repo: str | None = None, revision: str | None = None) -> Self:
        """Return the meta of the data set in `root`.

        Raises:
            RecordingError: For another format, a missing file, a value beyond all bounds, and where two parts
                contradict each other.
            MissingExtraError: Without the libraries that read it.
        """
        check_is_data_set(root)
        with while_reading(root, RecordingError, _AGAIN, ("meta",)):
            return cls._read(root, repo, revision)

    @classmethod
    def _read(cls, root: Path, repo: str | None, revision: str | None) -> Self:
        files = HashedFiles(root)
        info = _read_info(root, files)
        check_recorded(root, info)
        check_format(root, info, repo, revision)
        check_complete(root, info)
        require("pyarrow", EXTRA)
        require("av", EXTRA)
        _check_info(root, info)
        tasks, episodes = _read_tasks(root, files), tuple(_read_episodes(root, files, info))
        meta = cls(root, files, info, tasks, episodes, repo, revision)
        meta._check_totals()
        meta._check_names()
        meta._check_videos()
        return meta

    @property
    def name(self) -> str:
        """The name of the folder, for errors."""
        return self.path.name

    @cached_property
    def fps(self) -> float:
        """The frames per second."""
        return float(self.info["fps"])

    @cached_property
    def features(self) -> Mapping[str, Any]:
        """The type, shape and names of numbers by feature, under the names by which they are read."""
        stored: Mapping[str, Any] = self.info["features"]
        if not self.stored_names:
            return stored
        unmapped = {name: feature for name, feature in stored.items() if name not in self.stored_names.values()}
        return {**unmapped, **{name: stored[stored_name] for name, stored_name in self.stored_names.items()}}

    def with_features(self, pairs: Iterable[tuple[str, str]]) -> Self:
        """Return the same data set, some of whose features are read under another name: pairs of it and their own.

        Raises:
            RecordingError: For a feature that it lacks, or that is no list of numbers.
        """
        names = dict(pairs)
        for name, stored in names.items():
            feature = self.info["features"].get(stored)
            if feature is None or feature["dtype"] not in NUMERIC:
                has = "no such feature" if feature is None else f"it as {feature['dtype']}"
                numeric = [other for other, entry in self.info["features"].items() if entry["dtype"] in NUMERIC]
                raise RecordingError(
                    f"--feature {name}={stored}: {self.name} has {has}; its features of numbers are "
                    f"{', '.join(numeric) or 'none'}. Correct --feature"
                )
        return replace(self, stored_names=names) if names != self.stored_names else self

    @property
    def cameras(self) -> list[str]:
        """The features that are color pictures."""
        return [
            name
            for name, feature in self.features.items()
            if feature["dtype"] in (IMAGE, VIDEO) and not _depth(feature)
        ]

    def is_video(self, feature: str) -> bool:
        """Whether the pictures of a camera lie in video files."""
        return bool(self.features[feature]["dtype"] == VIDEO)

    def feature_names(self, feature: str) -> tuple[str, ...] | None:
        """Return the names of the numbers of a feature; None where the data set names none, or not all."""
        shape = tuple(self.features[feature]["shape"])
        return names_of(self.features[feature].get("names"), shape[0]) if len(shape) == 1 else None

    def names_misfit(self, feature: str) -> str:
        """Return why the names of a feature's numbers are not used; empty where they are, or there are none."""
        shape = tuple(self.features[feature]["shape"])
        return names_misfit(self.features[feature].get("names"), shape[0]) if len(shape) == 1 else ""

    def task(self, number: int, episodes: Sequence[int] = ()) -> str:
        """Return the text of a task.

        Args:
            number: The number of the task.
            episodes: The episodes whose frames name it, for the message; empty if they are unknown.

        Raises:
            RecordingError: For a number that is not named once, or has no text.
        """
        texts = self._texts.get(number, [])
        if len(texts) == 1 and isinstance(texts[0], str) and texts[0].strip():
            return texts[0]
        content = (
            f"{texts[0]!r} as the task {number}"
            if len(texts) == 1
            else f"{len(texts)} tasks of the number {number}"
        )
        expected = "a text" if len(texts) == 1 else "one"
        naming = f"frames of {ranges_of(episodes, 'episode')} name" if episodes else "a frame names"
        leave = ", leave these episodes out (--episodes)" * bool(episodes)
        raise RecordingError(
            f"{self.name}: {TASKS} has {content}, which {naming}; expected "
            f"{expected}. Repair the data set{leave}, or give --instruction TEXT"
        )

    @cached_property
    def _texts(self) -> dict[Any, list[Any]]:
        texts: dict[Any, list[Any]] = {}
        for number, text in self.tasks:
            texts.setdefault(number, []).append(text)
        return texts

    # -- contradictions --------------------------------------------------------------------------------

    def _check_totals(self) -> None:
        """Raise RecordingError unless numbers, ranges and totals of the episodes fit each other."""
        numbers = [episode.number for episode in self.episodes]
        if twice := [number for number, count in Counter(numbers).items() if count > 1]:
            raise RecordingError(
                f"{self.name}: {EPISODES} has {numbers.count(twice[0])} lines of episode {twice[0]}; expected "
                f"one. Remove the file that does not belong to the data set. {_AGAIN}"
            )
        if numbers == list(range(len(numbers))):
            data = [self.path / episode.file for episode in self.episodes]
            check_continued(self.path, self.info, [episode.length for episode in self.episodes], data)
        present = set(numbers)
        total = self.info.get("total_episodes", len(numbers))
        if type(total) is not int:
            raise RecordingError(
                f"{self.name}: {INFO} has total_episodes {_as_text(total)}; expected a number. {_AGAIN}"
            )
        # Counted, not listed: a number of a few digits can name more episodes than memory holds.
        lacking = next(number for number in count() if number not in present)
        if lacking < max((total, *numbers)):
            raise RecordingError(
                f"{self.name}: {EPISODES} has {len(numbers)} episodes, up to number {max(numbers, default=0)}, "
                f"and not episode {lacking}; expected all from 0 on. Give the episodes new numbers, or take "
                "the data set as it was before an episode was removed"
            )
        expected = 0
        for episode in self.episodes:
            if episode.start != expected:
                raise RecordingError(
                    f"{self.name}: {EPISODES} says that episode {episode.number} begins at index {episode.start}; "
                    f"expected {expected}, where the one before it ends. {_AGAIN}"
                )
            expected += episode.length
        for total_name, total in (
            ("total_episodes", len(numbers)),
            ("total_frames", expected),
            ("total_tasks", len(self.tasks)),
        ):
            if self.info.get(total_name, total) != total:
                raise RecordingError(
                    f"{self.name}: {INFO} has {total_name} {_as_text(self.info[total_name])}; its tables have "
                    f"{total}. {_AGAIN}"
                )

    def _check_names(self) -> None:
        """Raise RecordingError for a feature two of whose numbers have one name."""
        for feature in self.features:
            names = self.feature_names(feature) or ()
            if twice := [name for name, count in Counter(names).items() if count > 1]:
                raise RecordingError(
                    f"{self.name}: {INFO} names two numbers of {feature} {twice[0]!r}; expected each name once. "
                    "Correct the names"
                )

    def _check_videos(self) -> None:
        """Raise RecordingError for time ranges that overlap, or do not have as many frames as their episode."""
        for camera in filter(self.is_video, self.cameras):
            rate = (self.features[camera].get("info") or {}).get("video.fps")
            if rate is not None and not _equal_rates(rate, self.fps):
                raise RecordingError(
                    f"{self.name}: {INFO} says that {camera} has {_as_text(rate)} frames per second, and the data "
                    f"set {self.fps:g}; expected the same. {_AGAIN}"
                )
            slack = HALF / self.fps
            by_file: dict[Path, list[tuple[VideoRange, int]]] = {}
            for episode in self.episodes:
                part = episode.videos[camera]
                if not abs(part.end - part.begin - episode.length / self.fps) <= slack or part.begin < -slack:
                    raise RecordingError(
                        f"{self.name}: {EPISODES} says that {part.begin:.4f} to {part.end:.4f} s of {part.file} "
                        f"show episode {episode.number}, of {episode.length} frames; expected "
                        f"{episode.length / self.fps:.4f} s at {self.fps:g} frames per second. {_AGAIN}"
                    )
                by_file.setdefault(part.file, []).append((part, episode.number))
            for file, parts in by_file.items():
                parts.sort(key=lambda pair: pair[0].begin)
                for (before, first), (after, second) in pairwise(parts):
                    if after.begin < before.end - slack:
                        raise RecordingError(
                            f"{self.name}: {EPISODES} says that {file} shows episode {first} until "
                            f"{before.end:.4f} s and episode {second} from {after.begin:.4f} s on; expected "
                            f"ranges that do not overlap. {_AGAIN}"
                        )


def _equal_rates(rate: Any, other: float) -> bool:
    """Whether two rates are equal up to the rounding of one such as 30000 / 1001."""
    return isinstance(rate, int | float) and rate <= _MOST_FPS and abs(rate - other) <= RATE_ROUNDING * other


def _as_text(value: Any) -> str:
    """Return a foreign value for a message."""
    return repr(value)[:80]


def _depth(feature: Mapping[str, Any]) -> bool:
    info, video = feature.get("info") or {}, feature.get("video_info") or {}
    flags = info.get("is_depth_map"), info.get("video.is_depth_map"), video.get("video.is_depth_map")
    return any(flags)


def _read_info(root: Path, files: HashedFiles) -> Mapping[str, Any]:
    path = root / INFO
    files.check(path)
    return read_json_object(path, RecordingError, "Copy the data set again")


def _check_info(root: Path, info: Mapping[str, Any]) -> None:
    """Raise RecordingError unless rate and features are such that frames can be read."""
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < float("inf"):
        raise RecordingError(f"{root.name}: {INFO} has fps {_as_text(fps)}; expected a number above 0. {_AGAIN}")
    if not _LEAST_FPS <= fps <= _MOST_FPS:
        raise RecordingError(
            f"{root.name}: {INFO} has fps {_as_text(fps)}; expected {_LEAST_FPS:g} to {_MOST_FPS:g}. {_AGAIN}"
        )
    features = info.get("features")
    if not isinstance(features, Mapping) or not all(map(_is_feature, features.values())):
        raise RecordingError(f"{root.name}: {INFO} has no features with dtype and shape each. {_AGAIN}")
    for name, feature in features.items():
        if problem := _feature_problem(feature):
            raise RecordingError(f"{root.name}: {INFO} gives {str(name)[:80]} {problem}. {_AGAIN}")


def _is_feature(feature: Any) -> bool:
    return (
        isinstance(feature, Mapping)
        and isinstance(feature.get("dtype"), str)
        and isinstance(feature.get("shape"), Sequence)
        and all(type(size) is int for size in feature["shape"])
    )


def _feature_problem(feature: Mapping[str, Any]) -> str:
    """Return why no frame can have such a feature, before room for one is made; empty where it can."""
    shape, is_picture = feature["shape"], feature["dtype"] in (IMAGE, VIDEO)
    axes = (2, 3) if is_picture else range(1, _MOST_AXES + 1)
    least, most = (1, _LARGEST_PICTURE) if is_picture else (0, _MOST_NUMBERS)
    written = str(shape[:_MOST_AXES])[:80]
    if len(shape) not in axes:
        return f"a shape of {len(shape)} axes, {written}; expected {min(axes)} to {max(axes)}"
    if not all(least <= size <= most for size in shape) or prod(shape) > _MOST_NUMBERS:
        return f"the shape {written}; expected {least} to {most:,} per axis, {_MOST_NUMBERS:,} numbers in all"
    for part in ("info", "video_info"):
        if not isinstance(feature.get(part) or {}, Mapping):
            return f"{part} as a {type(feature[part]).__name__}; expected an object"
    return ""


def _read_table(root: Path, files: HashedFiles, path: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the table of a Parquet file of meta. Raises RecordingError if it is unreadable or lacks a column."""
    with files.parquet(path, _AGAIN) as parquet:
        if missing := [column for column in columns or () if column not in parquet.schema_arrow.names]:
            raise RecordingError(f"{root.name}: {path.relative_to(root)} has no column {missing[0]!r}. {_AGAIN}")
        return read_parquet(parquet, columns)


def _read_tasks(root: Path, files: HashedFiles) -> tuple[tuple[Any, Any], ...]:
    """Return number and text of every task.

    The package lerobot stores the texts in the index of pandas; others store them in a column `task`.
    """
    table = _read_table(root, files, root / TASKS)
    index = (table.schema.pandas_metadata or {}).get("index_columns", [])
    candidates = dict.fromkeys([_TASK, *(name for name in index if isinstance(name, str)), _UNNAMED_INDEX])
    columns = [tuple(table.column(name).to_pylist()) for name in candidates if name in table.column_names]
    texts = dict.fromkeys(cells for cells in columns if any(isinstance(cell, str) for cell in cells))
    if "task_index" not in table.column_names or len(texts) != 1:
        raise RecordingError(
            f"{root.name}: {TASKS} has the columns {', '.join(table.column_names) or 'none'}; expected "
            f"task_index, and the texts of the tasks in one column {_TASK!r} or in the index of pandas. {_AGAIN}"
        )
    return tuple(zip(table.column("task_index").to_pylist(), next(iter(texts)), strict=True))


def _read_episodes(root: Path, files: HashedFiles, info: Mapping[str, Any]) -> Iterator[EpisodeMeta]:
    """Yield every line of `meta/episodes`, by number."""
    cameras = [name for name, feature in info["features"].items() if feature["dtype"] == VIDEO]
    parts = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    columns = [_NUMBER, _LENGTH, _FROM, _TO, _CHUNK, _FILE]
    columns += [f"videos/{camera}/{part}" for camera in cameras for part in parts]
    unfinished = unfinished_files(root)
    paths = sorted(path for path in (root / EPISODES).rglob("*.parquet") if path.name[0] != ".")
    paths = [path for path in paths if path not in unfinished]
    lines = [
        (path, line) for path in paths for line in _read_table(root, files, path, columns).to_pylist()
    ]  # fmt: skip
    if not lines:
        raise RecordingError(f"{root.name}: {EPISODES} has no episode. Copy the data set again")
    for path, line in lines:
        _check_line(line, f"{root.name}: {path.relative_to(root)}")
    for _, line in sorted(lines, key=lambda pair: pair[1][_NUMBER]):
        number = line[_NUMBER]
        videos = {
            camera: VideoRange(
                _path_of(root, info, "video_path", number, video_key=camera,
                         chunk_index=line[f"videos/{camera}/chunk_index"],
                         file_index=line[f"videos/{camera}/file_index"]),
                float(line[f"videos/{camera}/from_timestamp"]),
                float(line[f"videos/{camera}/to_timestamp"]),
            )
            for camera in cameras
        }  # fmt: skip
        file = _path_of(
            root, info, "data_path", number, chunk_index=line[_CHUNK], file_index=line[_FILE]
        )  # fmt: skip
        yield EpisodeMeta(number, line[_LENGTH], line[_FROM], file, videos)


def _check_line(line: Mapping[str, Any], where: str) -> None:
    """Raise RecordingError for an episode with an empty cell, a negative number, or a length unlike its range."""
    for name, cell in line.items():
        is_time = name.endswith("_timestamp")
        if (
            not isinstance(cell, float | int if is_time else int)
            or not isfinite(cell)
            or (cell < 0 and not is_time)
        ):
            raise RecordingError(
                f"{where} has {name} {cell!r} for episode {line[_NUMBER]!r}; expected "
                f"{'seconds' if is_time else 'a whole number from 0 on'}. {_AGAIN}"
            )
    if line[_LENGTH] > _MOST_FRAMES:
        raise RecordingError(
            f"{where} says that episode {line[_NUMBER]} has {line[_LENGTH]} frames; expected at most "
            f"{_MOST_FRAMES:,}. {_AGAIN}"
        )
    if line[_LENGTH] < 1 or line[_TO] - line[_FROM] != line[_LENGTH]:
        raise RecordingError(
            f"{where} says that episode {line[_NUMBER]} has {line[_LENGTH]} frames, and the indices "
            f"{line[_FROM]} to {line[_TO]}; expected at least one frame, and as many indices as frames. {_AGAIN}"
        )


def _path_of(root: Path, info: Mapping[str, Any], template: str, episode: int, **parts: Any) -> Path:
    """Return a file that `info` names, in the data set's folder. Raises RecordingError for one outside it."""
    try:
        path = Path(_fill_path(info[template], parts))
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise RecordingError(
            f"{root.name}: {INFO} has {template} {str(info.get(template))[:200]!r}, which names no file of "
            f"chunk_index and file_index ({error}). {_AGAIN}"
        ) from error
    if path.is_absolute() or ".." in path.parts:
        raise RecordingError(
            f"{root.name}: {INFO} names {path} for episode {episode}; expected a file in the data set's folder. "
            "Correct data_path and video_path"
        )
    return path


def _fill_path(template: Any, parts: Mapping[str, Any]) -> str:
    """Return a path with its fields filled in. Raises ValueError or KeyError for one that names no file.

    A format can ask for any width: the fields are those of `parts` alone, and their widths have two digits.
    """
    if not isinstance(template, str) or len(template) > _MOST_TEMPLATE:
        raise ValueError(f"expected a text of at most {_MOST_TEMPLATE:,} characters")
    for _, name, width, _ in Formatter().parse(template):
        if name is not None and name not in parts:
            raise KeyError(name)
        if width and _WIDE.search(width):
            raise ValueError(f"expected a format of at most 99 characters, not {width[:20]!r}")
    path = template.format(**parts)
    if UNSAFE.search(path):
        raise ValueError("expected no control characters")
    return path
