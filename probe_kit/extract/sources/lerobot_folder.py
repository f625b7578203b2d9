"""A LeRobotDataset of format 3.0 that lies here: features, files, their hashes, and its download.

Rows and pictures are read from the very files that are hashed, without a cache that is keyed by path and time. A
file that meta does not name is never read.
"""

import glob
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from probe_kit.errors import RecordingError, UsageError
from probe_kit.extract.sources.hashed_files import HashedFiles
from probe_kit.extract.sources.lerobot_meta import IMAGE, KEYS, NUMERIC, EpisodeMeta, LeRobotMeta
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.hooks.checkpoints.checkpoint import OFFLINE_WAY_OUT, hub_reason, unreachable, way_out

MOST_FRAMES = 64
"""Chosen frames that one row holds."""
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class LeRobotFolder:
    """A data set that lies here. opened: its files by their hashes. repo, revision: of the hub, or None."""

    path: Path
    meta: LeRobotMeta
    opened: HashedFiles
    repo: str | None = None
    revision: str | None = None

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.meta.fps

    @property
    def features(self) -> Mapping[str, Any]:
        """Type, shape and names by feature."""
        return self.meta.features

    @property
    def cameras(self) -> list[str]:
        """Features that are colour pictures."""
        return self.meta.cameras

    @property
    def columns(self) -> list[str]:
        """Features of one number each, without those that lead to other tables."""
        return [
            name
            for name, feature in self.features.items()
            if feature["dtype"] in NUMERIC and tuple(feature["shape"]) == (1,) and name not in KEYS
        ]

    def width(self, feature: str) -> int | None:
        """Numbers of a feature; None where the data set lacks it."""
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
        """The names of the numbers of a feature; their positions where the data set names none."""
        return list(self.meta.names(feature) or map(str, range(self.width(feature) or 0)))

    def picture_shape(self, feature: str) -> tuple[int, int]:
        """(height, width) of a camera."""
        shape, names = self.features[feature]["shape"], list(self.features[feature].get("names") or ())
        if names and names[0].startswith("channel"):
            return int(shape[1]), int(shape[2])
        return int(shape[0]), int(shape[1])

    def encoding(self, feature: str) -> str:
        """The storage of a camera's pictures: `image`, or the codec of its video."""
        entry = self.features[feature]
        info = entry.get("info") or entry.get("video_info") or {}
        return IMAGE if entry["dtype"] == IMAGE else str(info.get("video.codec", "video"))

    @cached_property
    def lengths(self) -> list[int]:
        """Frames of every episode."""
        return [episode.length for episode in self.meta.episodes]

    @cached_property
    def by_file(self) -> Mapping[Path, list[EpisodeMeta]]:
        """The episodes of every data file."""
        by_file: dict[Path, list[EpisodeMeta]] = {}
        for episode in self.meta.episodes:
            by_file.setdefault(self.path / episode.file, []).append(episode)
        return by_file

    def episode(self, number: int) -> EpisodeMeta:
        """The meta of an episode."""
        return self.meta.episodes[number]

    def task(self, number: int) -> str:
        """The text of a task. Raises RecordingError for a number that `meta` does not name once."""
        return self.meta.task(number)

    # -- files -----------------------------------------------------------------------------------------

    @cached_property
    def meta_blake2b(self) -> str:
        """The hash of names and bytes of all files in `meta`."""
        return self.opened.hash_of(sorted(path for path in (self.path / "meta").rglob("*") if path.is_file()))

    def content_blake2b(self, episode: int, cameras: Sequence[str]) -> str:
        """The hash of the files that hold the numbers of an episode, and the pictures of some cameras."""
        return self.opened.hash_of(self.files(episode, cameras))

    def files(self, episode: int, cameras: Sequence[str]) -> list[Path]:
        """The files that hold an episode and the videos of some cameras."""
        meta = self.episode(episode)
        videos = [meta.videos[key].file for key in cameras if self.meta.is_video(key)]
        return [self.path / file for file in (meta.file, *videos)]

    # -- checks ----------------------------------------------------------------------------------------

    def select_episodes(self, episodes: Sequence[int] | None) -> list[int]:
        """The episodes that were asked for, all for None. Raises RecordingError for one that is not there."""
        count = len(self.lengths)
        if outside := [number for number in episodes or () if number >= count]:
            raise RecordingError(
                f"{self.path.name} has {count} episodes, counted from 0; asked for {outside[0]}. Give episodes "
                f"within 0:{count}"
            )
        return list(range(count)) if episodes is None else list(episodes)

    def check_files(self, episodes: Sequence[int], cameras: Sequence[str]) -> None:
        """Raise RecordingError for a missing file of these episodes, or one of data that meta does not name."""
        self._check_unnamed()
        for episode in episodes:
            for file in self.files(episode, cameras):
                if not file.is_file():
                    raise RecordingError(
                        f"{file.relative_to(self.path)} of episode {episode} is missing in {self.path.name}. Copy "
                        "the data set again, or leave the episode out"
                    )

    def _check_unnamed(self) -> None:
        """Raise RecordingError for a Parquet file of data that no episode is in; hidden files are none."""
        listed = set(self.by_file)
        folders = {
            self.path / episode.file.parts[0] for episode in self.meta.episodes if len(episode.file.parts) > 1
        }
        present = {path for folder in folders for path in folder.rglob("*.parquet") if path.name[0] != "."}
        if unnamed := sorted(present - listed - set((self.path / "meta").rglob("*.parquet"))):
            raise RecordingError(
                f"{self.path.name} holds {unnamed[0].relative_to(self.path)}, in which meta/episodes names no "
                "episode; expected no other files of data. Move it out of the data set, or copy the data set again"
            )


def open_lerobot(source: LeRobotSource) -> LeRobotFolder:
    """The data set of `source`, which is downloaded if it is one of the hub; only its `meta` then.

    Raises RecordingError for another format or missing files, UsageError for a hub data set without network or at
    a revision that is none, MissingExtraError without the extra of recordings.
    """
    if source.is_local:
        return _folder_at(Path(source.folder).expanduser().resolve())
    repo, _, revision = source.folder.partition("@")
    commit = resolved_commit(repo, revision)
    return _folder_at(_download(repo, commit, ["meta/*", "meta/**/*"]), repo, commit)


def _folder_at(path: Path, repo: str | None = None, revision: str | None = None) -> LeRobotFolder:
    opened = HashedFiles(path)
    return LeRobotFolder(path, LeRobotMeta.read(path, opened), opened, repo, revision)


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
