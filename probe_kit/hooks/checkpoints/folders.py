"""The folder of a checkpoint as loaders read it: a LoRA adapter alone is joined with its base's small files.

A loader is given one folder with all files of a checkpoint but the base's weights, which `adapter_files` finds.
Imports no torch.
"""

import atexit
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.adapter_files import (
    ADAPTER_WEIGHTS,
    adapter_settings,
    base_folder_of,
    remember_joined,
)
from probe_kit.hooks.checkpoints.checkpoint import (
    ADAPTER_FILE,
    CONFIG_FILE,
    PATTERNS,
    SMALL_FILES,
    is_weights,
    plain_folder,
)

CONFIGURATIONS = (CONFIG_FILE, "config.yaml")
"""Either holds the configuration of a network."""
_READ_TOGETHER = (
    (("policy_preprocessor.json",), ("policy_preprocessor",)),
    (("policy_postprocessor.json",), ("policy_postprocessor",)),
    (
        ("tokenizer.json", "tokenizer.model", "vocab.json", "spiece.model"),
        ("tokenizer", "special_tokens_map", "added_tokens", "vocab", "merges", "spiece"),
    ),
)
"""Files that decide, with the beginnings of names that are read with them: of the adapter alone or its base."""
_BESIDE = ("dims.json", "tokenizer")
"""What some layouts keep beside the folder of a checkpoint."""
_RUNS = "checkpoints"
_DONE: dict[tuple[object, ...], Path] = {}


def checkpoint_folder(checkpoint: str, patterns: Sequence[str] = PATTERNS) -> Path:
    """The folder of a checkpoint, by path or hub id; that of an adapter alone is joined with its base's files.

    patterns: see `plain_folder`; also of a base on the hub. A file of the adapter replaces the base's, so its
    statistics win. The joined folder holds links and is removed at the end of the process.
    Raises CheckpointError as `plain_folder` does, and for a base that is not there or has no configuration either.
    """
    folder = plain_folder(checkpoint, patterns)
    file = folder / ADAPTER_FILE
    if not file.is_file() or has_configuration(folder):
        return folder
    base = base_folder_of(folder, adapter_settings(file), patterns)
    if not has_configuration(base):
        raise CheckpointError(
            f"{folder} is a LoRA adapter without config.json, and its base {base} has none either. Correct "
            f"base_model_name_or_path in {file}, or copy the config.json, processor and tokenizer files of the "
            "base into the adapter's folder"
        )
    key = (file_state(folder), file_state(base))
    if key not in _DONE:
        _DONE[key] = _join(folder, base)
    return _DONE[key]


def inside_or_hub(folder: Path, name: str, patterns: Sequence[str] = SMALL_FILES) -> Path:
    """The folder that a checkpoint names: inside its own, anywhere, or on the hub. patterns: the files to fetch.

    Raises CheckpointError for one that is not there.
    """
    inside = folder / name
    return inside if inside.is_dir() else checkpoint_folder(name, patterns)


def has_configuration(folder: Path) -> bool:
    """Whether a folder has the configuration of a network."""
    return any((folder / name).is_file() for name in CONFIGURATIONS)


def file_state(path: Path) -> tuple[object, ...]:
    """A value that changes with the files of a folder, or with one file."""
    files = _existing(path) if path.is_dir() else [path]
    states = [(file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in files]
    return (str(path.resolve()), *sorted(states))


def _existing(folder: Path) -> Iterable[Path]:
    return (path for path in folder.iterdir() if path.exists())


def _join(folder: Path, base: Path) -> Path:
    """A new folder of links, with the name that the adapter's has."""
    root = Path(tempfile.mkdtemp(prefix="probe-kit-adapter-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    joined = root / (folder.resolve().name or "adapter")
    joined.mkdir()
    adapter_names = sorted(path.name for path in _existing(folder))
    for path in sorted(_existing(folder)):
        (joined / path.name).symlink_to(path.resolve())
    for path in sorted(_existing(base)):
        if not _is_left_out(path) and not _is_replaced(path.name, adapter_names):
            (joined / path.name).symlink_to(path.resolve())
    for name in _BESIDE:
        if (base.parent / name).exists() and not (root / name).exists():
            (root / name).symlink_to((base.parent / name).resolve())
    remember_joined(joined, folder)
    return joined


def _is_left_out(path: Path) -> bool:
    """Whether a file of the base holds weights, or names them."""
    return path.name in (ADAPTER_FILE, *ADAPTER_WEIGHTS, _RUNS) or is_weights(path)


def _is_replaced(name: str, adapter_names: Sequence[str]) -> bool:
    """Whether the adapter has this file of the base, or one that is read together with such files."""
    parts = (begin for heads, begin in _READ_TOGETHER if any(head in adapter_names for head in heads))
    return name in adapter_names or any(name.startswith(begin) for begin in parts)
