"""Folders of lerobot that are no readable data set of format 3.0: what they are, and what makes them one.

Tests run each printed line on such a folder. No line publishes anything: without `--push-to-hub=false`, the
converter of lerobot uploads its result and removes files on the hub.
"""

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from probe_kit._system.imports import python_command
from probe_kit.errors import RecordingError

INFO, TASKS, EPISODES = "meta/info.json", "meta/tasks.parquet", "meta/episodes"
PARQUET = "parquet"
READ = "this version reads v3.0"
_CONVERTER = "-m lerobot.scripts.convert_dataset_v21_to_v30"
_OLD_INFO = "meta_data/info.json"
"""The file of formats 1.x."""
_MAGIC = b"PAR1"
_VERSION = re.compile(r"v?(\d{1,9})\.(\d{1,9})")
_LONGEST = 3


def check_is_data_set(root: Path) -> None:
    """Raise RecordingError for a folder without the file that describes a data set."""
    if (root / INFO).is_file():
        return
    if (root / _OLD_INFO).is_file():
        raise RecordingError(f"{root.name} {_older('v1.x')}")
    problem = f"it has no {INFO}" if root.is_dir() else "there is no such folder"
    raise RecordingError(
        f"{root} is no LeRobotDataset: {problem}. Give the folder that holds meta, data and videos, or the hub's "
        "USER/NAME"
    )


def check_format(root: Path, info: Mapping[str, Any], repo: str | None, revision: str | None) -> None:
    """Raise RecordingError for a format other than 3.0, with the line that converts the data set if there is one.

    Args:
        root: The folder; of a data set of the hub its place in the cache, which no tool may change.
        info: The content of `meta/info.json`.
        repo: The name on the hub, None for a folder.
        revision: The commit on the hub, None for a folder.
    """
    version = str(info.get("codebase_version"))
    numbers = _VERSION.match(version)
    major, minor = map(int, numbers.groups()) if numbers else (0, 0)
    name = root.name if repo is None else repo
    if numbers is None:
        raise RecordingError(
            f"{name}: {INFO} has the codebase_version {version[:80]}; {READ}. Copy the data set again"
        )
    if major > 3:
        raise RecordingError(f"{name} has format {version[:80]}, of a later lerobot; {READ}. Update probe_kit")
    if (major, minor) == (2, 1):
        raise RecordingError(f"{name} has format {version}; {READ}. {_conversion(root, info, repo, revision)}")
    if major < 3:
        raise RecordingError(f"{name} {_older(version)}")
    if (stored := info.get("storage_format", PARQUET)) != PARQUET:
        raise RecordingError(
            f"{name} has the storage_format {stored!r}; this version reads {PARQUET!r}. Write the data set "
            "again as Parquet"
        )


def _older(version: str) -> str:
    """Return what can be done about a format that no tool converts without publishing the result."""
    scripts = ["convert_dataset_v1_to_v2"] * version.startswith("v1") + ["convert_dataset_v20_to_v21"]
    return (
        f"has format {version}; {READ}. Only lerobot up to 0.3.3 raises it to v2.1, by {' and '.join(scripts)}. "
        "They read a repository of the hub, and upload the result to it. So no command is printed: record or "
        "export the data set again, or upgrade a private copy"
    )


def _conversion(root: Path, info: Mapping[str, Any], repo: str | None, revision: str | None) -> str:
    """Return the line that converts a data set of format 2.1 on this machine, and what it does to the folders."""
    if repo is not None:
        root = _free(Path.cwd() / repo.rpartition("/")[2])
    if "'" in str(root):
        return (
            f"The converter of lerobot opens no videos in {root}, because of the apostrophe. Move the data set to "
            "a path without one, and run the same command again"
        )
    steps = []
    if repo is not None:
        download = ["download", repo, "--repo-type=dataset", f"--revision={revision}", f"--local-dir={root}"]
        steps.append(f"{python_command()} -m huggingface_hub.cli.hf {shlex.join(download)}")
    old, new = _with_suffix(root, "_old"), _with_suffix(root, "_v30")
    removed = [path for path in (old, new) if path.exists()]
    steps += [shlex.join(["mv", str(path), str(_free(path))]) for path in removed]
    options = [f"--repo-id={repo or f'local/{root.name}'}", f"--root={root}", "--push-to-hub=false"]
    steps.append(f"{python_command()} {_CONVERTER} {shlex.join(options)}")
    sentences = [f"Convert {'it' if repo is None else 'a copy'}: `{' && '.join(steps)}`"]
    if removed:
        names = " and ".join(path.name for path in removed)
        sentences.append(
            f"It first moves {names}, because the converter removes {new.name} if that exists, and {root.name} "
            f"itself if {old.name} exists"
        )
    sentences.append(f"The converter leaves the data set of format {info['codebase_version']} in {old.name}")
    if isinstance(fps := info.get("fps"), float) and not fps.is_integer():
        sentences.append(
            f"It cuts the fps {fps!r} to {int(fps)}: then write {fps!r} into {root.name}/{INFO} again"
        )
    if repo is not None:
        sentences.append(f"Then give {root} in place of {repo}")
    return ". ".join(sentences)


def _with_suffix(folder: Path, suffix: str) -> Path:
    return folder.with_name(folder.name + suffix)


def _free(path: Path) -> Path:
    """Return the path, or one beside it at which nothing is."""
    free, number = path, 1
    while free.exists():
        free, number = _with_suffix(path, f"_{number}"), number + 1
    return free


# -- recordings that were cut off --------------------------------------------------------------------------------


_ENDED = "The recording ended before lerobot's finalize() wrote the ends of its files, or a copy is not complete"


def check_recorded(root: Path, info: Mapping[str, Any]) -> None:
    """Raise RecordingError for a recording without an episode, or one that ended before its episodes were written.

    lerobot writes the Parquet files of many episodes at once, and their ends in `LeRobotDataset.finalize`.
    """
    total = info.get("total_episodes")
    if total == 0 and not any((root / EPISODES).rglob("*.parquet")):
        unsaved = any((root / "images").rglob("*.png"))
        pictures = "Pictures of an unfinished episode lie in images. " if unsaved else ""
        raise RecordingError(
            f"{root.name} has no episode: {INFO} has total_episodes 0, because the recording ended before an "
            f"episode was saved. {pictures}Record it again"
        )


def check_complete(root: Path, info: Mapping[str, Any]) -> None:
    """Raise RecordingError for a data set without tasks, or without any episode that can be read."""
    unfinished = unfinished_files(root)
    if unfinished and set(_parquet_files(root, EPISODES)) <= set(unfinished):
        total = info.get("total_episodes")
        raise RecordingError(
            f"{root.name}: {INFO} has total_episodes {total}, and {EPISODES} none that can be read. "
            f"{_ENDED}. {_remains(root, unfinished)}Record these episodes again, or copy the data set again"
        )
    if missing := [name for name in (TASKS, EPISODES) if not (root / name).exists()]:
        raise RecordingError(f"{root.name} has no {missing[0]}. Copy the data set again")


def check_continued(root: Path, info: Mapping[str, Any], lengths: Sequence[int], files: Sequence[Path]) -> None:
    """Raise RecordingError for a data set of whole episodes whose last recording ended too early.

    Args:
        root: The folder.
        info: The content of `meta/info.json`.
        lengths: The frames of each episode in the readable files of `meta/episodes`, which count from 0.
        files: The files of their numbers.
    """
    total = info.get("total_episodes")
    unfinished = [path for path in unfinished_files(root) if path not in files]
    if not (unfinished and isinstance(total, int) and total > len(lengths)):
        return
    count = len(lengths)
    names = ", ".join(str(path.relative_to(root)) for path in unfinished)
    raise RecordingError(
        f"{root.name}: {INFO} has total_episodes {total}, and {EPISODES} {count} that can be read. {_ENDED}. "
        f"{_remains(root, unfinished)}To keep the first {count} episodes, which are whole, move {names} out of "
        f"the data set, and write total_episodes {count} and total_frames {sum(lengths)} into {INFO}. Or copy the "
        "data set again"
    )


def _remains(root: Path, unfinished: Sequence[Path]) -> str:
    """Return what can be saved of episodes without meta, as sentences."""
    names = ", ".join(str(path.relative_to(root)) for path in unfinished[:_LONGEST])
    more = f" and {len(unfinished) - _LONGEST} more files" if len(unfinished) > _LONGEST else ""
    videos = "Their videos lie in videos. " if (root / "videos").is_dir() else ""
    return f"Without an end, nothing reads {names}{more}. {videos}"


def unfinished_files(root: Path) -> list[Path]:
    """Return the Parquet files of data and episodes that a recording left without an end, in order.

    It leaves at least one of data. Without such a one, a file of episodes without an end is a damaged file.
    """
    data, episodes = (
        [path for path in _parquet_files(root, folder) if _lacks_end(path)] for folder in ("data", EPISODES)
    )
    return [*data, *episodes] if data else []


def _parquet_files(root: Path, folder: str) -> list[Path]:
    """Return the files of a folder of the data set in order, without hidden ones."""
    return [path for path in sorted((root / folder).rglob("*.parquet")) if path.name[0] != "."]


def _lacks_end(path: Path) -> bool:
    """Whether a file begins as Parquet and does not end as such."""
    if not path.is_file():
        return False
    with path.open("rb") as opened:
        begin = opened.read(len(_MAGIC))
        opened.seek(max(path.stat().st_size - len(_MAGIC), len(begin)))
        return begin == _MAGIC and opened.read() != _MAGIC
