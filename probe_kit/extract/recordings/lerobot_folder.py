"""Reading of a LeRobotDataset of format 3.0 through lerobot: what it holds, its hashes, and its frames.

lerobot asks the hub for whatever it does not find, warns where an episode is out of range, and gives pictures as
floats. Files and episodes are therefore checked before it is called, and it is called without a network.
"""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import blake2b, file_digest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_json import read_json_object
from probe_kit._system.optional_dependencies import require
from probe_kit.errors import RecordingError, UsageError
from probe_kit.extract.recordings.lerobot_source import LeRobotSource
from probe_kit.hooks.checkpoints.hub import unreachable

EXTRA = "datasets"
CONVERTER = "python -m lerobot.scripts.convert_dataset_v21_to_v30"
IMAGE = "image"
"""Pictures of a camera that are stored one by one."""
MOST_FRAMES = 64
"""Chosen frames that one row holds."""
OFF_GRID_S = 1e-4
"""Seconds by which a timestamp may differ from frame / fps."""
_COMMIT = re.compile(r"[0-9a-f]{40}")
_KEYS = ("episode_index", "index", "task_index")
_NUMERIC = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")
_DIGITS = 16


@dataclass(frozen=True)
class LeRobotFolder:
    """A data set that lies here. repo, revision: of the hub, None for a folder. meta: lerobot's metadata of it."""

    path: Path
    meta: Any
    repo: str | None = None
    revision: str | None = None
    _hashes: dict[Path, str] = field(default_factory=dict, repr=False, compare=False)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.meta.fps)

    @property
    def features(self) -> Mapping[str, Any]:
        """Type, shape and names by feature."""
        found: Mapping[str, Any] = self.meta.features
        return found

    @property
    def cameras(self) -> list[str]:
        """Features that are colour pictures."""
        return [key for key in self.meta.camera_keys if key not in self.meta.depth_keys]

    @property
    def columns(self) -> list[str]:
        """Features of one number each, without those that lead to other tables."""
        return [
            name
            for name, own in self.features.items()
            if own["dtype"] in _NUMERIC and tuple(own["shape"]) == (1,) and name not in _KEYS
        ]

    def width(self, feature: str) -> int | None:
        """Numbers of a feature; None where the data set lacks it."""
        if feature not in self.features:
            return None
        shape = tuple(self.features[feature]["shape"])
        if len(shape) != 1 or self.features[feature]["dtype"] not in _NUMERIC:
            raise RecordingError(
                f"{self.path.name}: {feature} is {self.features[feature]['dtype']} of shape {shape}; expected a "
                "list of numbers"
            )
        return int(shape[0])

    def names(self, feature: str) -> list[str]:
        """What the numbers of a feature are called; their positions where the data set names none."""
        named = self.features[feature].get("names")
        if isinstance(named, Mapping):
            named = next(iter(named.values()), None)
        count = self.width(feature) or 0
        if isinstance(named, Sequence) and not isinstance(named, str) and len(named) == count:
            return [str(one) for one in named]
        return [str(place) for place in range(count)]

    def picture_shape(self, feature: str) -> tuple[int, int]:
        """(height, width) of a camera."""
        shape, names = self.features[feature]["shape"], list(self.features[feature].get("names") or ())
        if names and names[0].startswith("channel"):
            return int(shape[1]), int(shape[2])
        return int(shape[0]), int(shape[1])

    def encoding(self, feature: str) -> str:
        """How pictures of a camera are stored: `image`, or the codec of its video."""
        own = self.features[feature]
        info = own.get("info") or own.get("video_info") or {}
        return IMAGE if own["dtype"] == IMAGE else str(info.get("video.codec", "video"))

    @cached_property
    def lengths(self) -> list[int]:
        """Frames of every episode."""
        return [int(length) for length in self.meta.episodes["length"]]

    @cached_property
    def starts(self) -> list[int]:
        """Index of the first frame of every episode in the whole data set."""
        return [int(start) for start in self.meta.episodes["dataset_from_index"]]

    def task(self, number: int) -> str:
        """The text of a task. Raises RecordingError for a number that `meta` does not name once."""
        texts = self.meta.tasks.index[self.meta.tasks["task_index"] == number]
        if len(texts) != 1:
            raise RecordingError(
                f"{self.path.name}: meta/tasks.parquet has {len(texts)} tasks of the number {number}, which a "
                "frame names; expected one. Repair the data set, or give --instruction TEXT"
            )
        return str(texts[0])

    # -- hashes ----------------------------------------------------------------------------------------

    @cached_property
    def meta_blake2b(self) -> str:
        """Of names and bytes of all files in `meta`."""
        return self._hash_of(sorted(path for path in (self.path / "meta").rglob("*") if path.is_file()))

    def content_blake2b(self, episode: int, cameras: Sequence[str]) -> str:
        """Of the files that hold the numbers of an episode, and the pictures of some cameras."""
        return self._hash_of(self.files(episode, cameras))

    def files(self, episode: int, cameras: Sequence[str]) -> list[Path]:
        """The files that hold an episode and the videos of some cameras. Raises RecordingError for others."""
        videos = [self.meta.get_video_file_path(episode, key) for key in cameras if key in self.meta.video_keys]
        found = [self.meta.get_data_file_path(episode), *videos]
        if outside := [one for one in found if Path(one).is_absolute() or ".." in Path(one).parts]:
            raise RecordingError(
                f"{self.path.name}: meta/info.json names {outside[0]} for episode {episode}; expected a file in "
                "the data set's folder. Correct data_path and video_path"
            )
        return [self.path / one for one in found]

    def _hash_of(self, files: Sequence[Path]) -> str:
        together = blake2b(digest_size=_DIGITS)
        for file in files:
            if file not in self._hashes:
                with file.open("rb") as opened:
                    self._hashes[file] = file_digest(opened, lambda: blake2b(digest_size=_DIGITS)).hexdigest()
            together.update(f"{file.relative_to(self.path).as_posix()} {self._hashes[file]}\n".encode())
        return together.hexdigest()

    # -- checks ----------------------------------------------------------------------------------------

    def chosen(self, episodes: Sequence[int] | None) -> list[int]:
        """The episodes that were asked for, all for None. Raises RecordingError for one that is not there."""
        count = len(self.lengths)
        if outside := [one for one in episodes or () if one >= count]:
            raise RecordingError(
                f"{self.path.name} has {count} episodes, counted from 0; asked for {outside[0]}. Give episodes "
                f"within 0:{count}"
            )
        return list(range(count)) if episodes is None else list(episodes)

    def check_files(self, episodes: Sequence[int], cameras: Sequence[str]) -> None:
        """Raise RecordingError if a file of these episodes is missing: lerobot would ask the hub for it."""
        for episode in episodes:
            for file in self.files(episode, cameras):
                if not file.is_file():
                    raise RecordingError(
                        f"{file.relative_to(self.path)} of episode {episode} is missing in {self.path.name}. Copy "
                        "the data set again, or leave the episode out"
                    )


def open_lerobot(source: LeRobotSource) -> LeRobotFolder:
    """The data set of `source`, which is downloaded if it is one of the hub; only its `meta` then.

    Raises RecordingError for another format or missing files, UsageError for a hub data set without network or at
    a revision that is none, MissingExtraError without lerobot's extra.
    """
    if source.is_local:
        path = Path(source.folder).expanduser().resolve()
        _check_format(path)
        return LeRobotFolder(path, _metadata(path))
    repo, _, revision = source.folder.partition("@")
    commit = resolved_commit(repo, revision)
    path = _download(repo, commit, ["meta/*", "meta/**/*"])
    _check_format(path)
    return LeRobotFolder(path, _metadata(path), repo, commit)


def resolved_commit(repo: str, revision: str) -> str:
    """The 40-digit commit of a hub data set. Raises UsageError without network or for no such revision."""
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
        found = HfApi().dataset_info(repo, revision=revision or None).sha
    except HfHubHTTPError as error:
        raise UsageError(f"the hub has no data set {repo} at {revision or 'main'}: {error}") from error
    if found is None:
        raise UsageError(f"the hub names no commit of {repo}; give {repo}@COMMIT with 40 digits")
    return str(found)


def fetched(folder: LeRobotFolder, episodes: Sequence[int], cameras: Sequence[str]) -> None:
    """Download the files of some episodes, if the data set is one of the hub."""
    if folder.repo is not None and folder.revision is not None:
        wanted = {
            file.relative_to(folder.path).as_posix() for one in episodes for file in folder.files(one, cameras)
        }
        _download(folder.repo, folder.revision, sorted(wanted))


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
        raise UsageError(f"{repo}@{commit} cannot be fetched: {error}. Give a folder that exists") from error


def _check_format(path: Path) -> None:
    info = path / "meta" / "info.json"
    if not info.is_file():
        raise RecordingError(
            f"{path} is no LeRobotDataset: it has no meta/info.json. Give the folder that holds meta, data and "
            "videos"
        )
    version = str(read_json_object(info, RecordingError, "Copy the data set again").get("codebase_version"))
    if not version.startswith("v3."):
        raise RecordingError(
            f"{path.name} has format {version}; this version reads v3.0. Convert it with `{CONVERTER} --repo-id=…`"
        )
    if missing := [name for name in ("tasks.parquet", "episodes") if not (path / "meta" / name).exists()]:
        raise RecordingError(f"{path.name} has no meta/{missing[0]}. Copy the data set again")


def _metadata(path: Path) -> Any:
    require("datasets", EXTRA).utils.logging.disable_progress_bar()
    require("av", EXTRA)
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    with quiet_and_offline(path):
        return LeRobotDatasetMetadata("local/recording", root=path)


@contextmanager
def quiet_and_offline(path: Path) -> Iterator[None]:
    """No request and no log while lerobot reads; whatever it raises of its own becomes a RecordingError."""
    from huggingface_hub import constants

    before, level = constants.HF_HUB_OFFLINE, logging.root.manager.disable
    constants.HF_HUB_OFFLINE = True
    logging.disable(logging.WARNING)
    try:
        yield
    except (RecordingError, UsageError, MemoryError):
        raise
    except Exception as error:
        raise RecordingError(
            f"lerobot cannot read {path.name}: {type(error).__name__}: {str(error)[:500]}. Check that the data "
            "set is whole, with all files that its meta names"
        ) from error
    finally:
        constants.HF_HUB_OFFLINE = before
        logging.disable(level)


class LeRobotFrames:
    """Frames and numbers of chosen episodes, decoded when they are asked for. Opened once per process."""

    def __init__(self, folder: LeRobotFolder, episodes: Sequence[int]) -> None:
        self.folder, self._episodes = folder, sorted(set(episodes))

    @cached_property
    def _dataset(self) -> Any:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        with quiet_and_offline(self.folder.path):
            return LeRobotDataset(
                "local/recording", root=self.folder.path, episodes=self._episodes, video_backend="pyav"
            )

    @cached_property
    def _places(self) -> Mapping[int, int]:
        found: Mapping[int, int] = self._dataset.absolute_to_relative_idx
        return found

    def pictures(self, episode: int, frame: int, cameras: Sequence[str]) -> dict[str, NDArray[np.uint8]]:
        """(H, W, 3) uint8 by camera; of stored images the very bytes. Raises RecordingError."""
        with quiet_and_offline(self.folder.path):
            item = self._dataset[self._places[self.folder.starts[episode] + frame]]
            seen = int(item["episode_index"]), int(item["frame_index"])
        if seen != (episode, frame):
            raise RecordingError(
                f"{self.folder.path.name}: frame {frame} of episode {episode} says that it is frame {seen[1]} of "
                f"episode {seen[0]}. Check the data set's meta"
            )
        return {camera: as_bytes(np.asarray(item[camera]), camera) for camera in cameras}

    def numbers(self, episode: int, features: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """(T, D) of every feature, of one number (T, 1). Raises RecordingError if its frames are not a grid."""
        start, length = self.folder.starts[episode], self.folder.lengths[episode]
        wanted = list(dict.fromkeys((*features, "frame_index", "timestamp")))
        with quiet_and_offline(self.folder.path):
            rows = [self._places[start + frame] for frame in range(length)]
            table = self._dataset.hf_dataset.select_columns(wanted).with_format("arrow")[rows]
            found: dict[str, NDArray[np.float64]] = {
                name: np.asarray(table.column(name).to_pylist(), np.float64).reshape(length, -1) for name in wanted
            }
        self._check_grid(episode, found["frame_index"][:, 0], found["timestamp"][:, 0])
        return found

    def _check_grid(self, episode: int, frames: NDArray[np.float64], timestamps: NDArray[np.float64]) -> None:
        due = np.arange(len(frames))
        off = np.flatnonzero(
            (frames != due) | (np.abs(timestamps - due / self.folder.fps) > OFF_GRID_S * (1 + due / 1e4))
        )
        if off.size:
            place = int(off[0])
            raise RecordingError(
                f"{self.folder.path.name}, episode {episode}: line {place} is frame {frames[place]:g} at "
                f"{timestamps[place]:.4f} s; expected frame {place} at {place / self.folder.fps:.4f} s "
                f"({self.folder.fps:g} frames per second). Repair the timestamps, or leave the episode out"
            )


def as_bytes(picture: NDArray[Any], camera: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of lerobot's (3, H, W) floats in [0, 1]. Raises RecordingError for others."""
    if picture.ndim != 3 or picture.shape[0] != 3 or not np.issubdtype(picture.dtype, np.floating):
        raise RecordingError(f"{camera} is {picture.dtype} {picture.shape}; expected floats (3, H, W)")
    if not (np.isfinite(picture).all() and picture.min() >= 0 and picture.max() <= 1):
        raise RecordingError(
            f"pictures of {camera} have values from {picture.min():.3g} to {picture.max():.3g}; expected 0 to 1"
        )
    return np.ascontiguousarray(np.rint(255 * picture).astype(np.uint8).transpose(1, 2, 0))
