"""Small files of checkpoints: names of tensors, processors, statistics. Importing them loads no torch."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import check_no_pointer, load_json, read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, UsageError

Renames = tuple[tuple[str, str], ...]
"""Patterns and replacements, applied in this order."""

LANGUAGE_FIRST: Renames = (
    (r"^language_model\.lm_head\.", "lm_head."),
    (r"^language_model\.model\.", "model.language_model."),
    (r"^(vision_tower|multi_modal_projector)\.", r"model.\1."),
)
"""Renames for files that hold a whole language model; files saved by today's transformers stay as they are."""


def renamed(name: str, renames: Sequence[tuple[str, str]]) -> str:
    """Return the module's name of a tensor that a file calls `name`."""
    for pattern, replacement in renames:
        name = re.sub(pattern, replacement, name)
    return name


# -- processors -----------------------------------------------------------------------------------------------

PROCESSOR_FILE = "preprocessor_config.json"


def processor_settings(folder: Path, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, Any]:
    """Return the named values of `preprocessor_config.json` in `folder`; `optional` ones only where they are set.

    Raises:
        CheckpointError: If the file is missing, is not JSON or lacks a needed value.
    """
    file = folder / PROCESSOR_FILE
    if not file.is_file():
        raise CheckpointError(
            f"{file} is missing; it defines how pictures are prepared for this checkpoint. "
            "Copy it from the model's page"
        )
    try:
        values = load_json(file)
    except ValueError as error:
        raise CheckpointError(f"{file} is not JSON ({error}); download the checkpoint again") from error
    if not isinstance(values, dict) or (missing := [name for name in needed if values.get(name) is None]):
        raise CheckpointError(f"{file} lacks {', '.join(missing) if isinstance(values, dict) else 'named values'}")
    return {name: values[name] for name in (*needed, *optional) if values.get(name) is not None}


def square_side(values: dict[str, Any], folder: Path) -> int:
    """Return the side in pixels of the square that `size` names.

    Raises:
        CheckpointError: If it names none.
    """
    size = values["size"]
    height, width = (size.get(side) if isinstance(size, dict) else size for side in ("height", "width"))
    if not isinstance(height, int) or height != width:
        raise CheckpointError(f"{folder / PROCESSOR_FILE} has size {size}; expected a square of so many pixels")
    return height


# -- files that transformers reads ----------------------------------------------------------------------------

_REMOTE_CODE = "trust_remote_code"
_AGAIN = "Take the files that the authors released, or save them again with transformers"
_TOKENIZER_NAMES = (
    "tokenizer", "special_tokens_map", "added_tokens", "vocab", "merges", "spiece", "chat_template",
)  # fmt: skip
_TEXTS = (".jinja", ".txt")
_PROCESSOR_NAMES = ("preprocessor_config", "processor_config", "video_preprocessor_config")


def _files_of(loader: str) -> tuple[str, ...]:
    """Return the beginnings of names of the files that a class of transformers reads, by the class's name."""
    if "Config" in loader:
        return ("config.json",)
    pictures = _PROCESSOR_NAMES if "Processor" in loader else ()
    words = () if "ImageProcessor" in loader or "VideoProcessor" in loader else _TOKENIZER_NAMES
    return (*words, *pictures)


@contextmanager
def while_reading_pretrained(folder: Path, loader: str) -> Iterator[None]:
    """Turn errors of a class of transformers, of this name, in the body into one that names the files it reads.

    Raises:
        CheckpointError: For files that it cannot read; of a damaged tokenizer.json with its own fault.
        LfsPointerError: For a Git LFS pointer among them.
    """
    names, tokenizer = _files_of(loader), folder / "tokenizer.json"
    for file in sorted(folder.glob("*")) if folder.is_dir() else ():
        if file.suffix in _TEXTS and file.name.startswith(names):
            check_no_pointer(file)  # any text is a template, or a list of words
    try:
        with while_reading(folder, advice=_AGAIN, names=names):
            yield
    except CheckpointError:
        if "tokenizer" in names and tokenizer.is_file():
            from tokenizers import Tokenizer

            with while_reading(tokenizer, advice=_AGAIN):
                Tokenizer.from_file(str(tokenizer))
        raise


def load_pretrained(loader: Any, source: Path | str, **options: Any) -> Any:
    """Return `loader.from_pretrained(source, **options)` of a class of transformers.

    A configuration can name Python code in its `auto_map`; without `trust_remote_code=False`, transformers asks on
    the terminal whether to run it.

    Args:
        loader: Class of transformers, such as a tokenizer's.
        source: A folder or a hub id.
        **options: Further keyword arguments of `from_pretrained`.

    Raises:
        CheckpointError: If the object needs such code, or transformers cannot read its files.
        LfsPointerError: For a Git LFS pointer among them.
    """
    try:
        with while_reading_pretrained(Path(source), loader.__name__):
            return loader.from_pretrained(str(source), trust_remote_code=False, **options)
    except CheckpointError as error:
        if not isinstance(error.__cause__, ValueError) or _REMOTE_CODE not in str(error.__cause__):
            raise
        raise CheckpointError(
            f"{source}: its configuration names Python code (auto_map) for {loader.__name__}, and probe_kit runs "
            "no code of a checkpoint. Take files that name a class of transformers, such as tokenizer.json with "
            "tokenizer_class in tokenizer_config.json"
        ) from error


# -- statistics -----------------------------------------------------------------------------------------------

STATISTICS_FILE = "dataset_statistics.json"
_SHOWN = 40


def read_statistics(file: Path) -> dict[str, Any]:
    """Return per data set `{"action": {"q01": …, "q99": …, "mask": …}}`; in the file `action` may be left out.

    Raises:
        CheckpointError: For a file that is missing or holds something else.
    """
    values = read_json_object(file, CheckpointError, "Take the file that fine-tuning wrote")
    entries = values.get("norm_stats", values)
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise CheckpointError(f"{file} holds no statistics per data set. Take the file that fine-tuning wrote")
    return {key: entry if "action" in entry else {"action": entry} for key, entry in entries.items()}


def stored_statistics(
    folders: Sequence[Path], otherwise: Mapping[str, Any], source: str
) -> tuple[Mapping[str, Any], str]:
    """Return the statistics that count for a checkpoint, and the name of their source, for messages.

    `dataset_statistics.json` of the first folder that has one stands alone: fine-tuning wrote it, and a
    configuration still lists the data sets of the base.

    Args:
        folders: Folders that may hold the file, in order of preference.
        otherwise: Statistics that count without the file.
        source: Name of the place of `otherwise`.

    Raises:
        CheckpointError: For a file that cannot be read.
    """
    for folder in folders:
        if (file := folder / STATISTICS_FILE).is_file():
            return read_statistics(file), str(file)
    return otherwise, source


def chosen_name(available: Collection[str], requested: str | None, option: str, source: str) -> str:
    """Return the data set, or robot, whose statistics are used: as chosen, or the only one.

    Args:
        available: Names that have statistics.
        requested: Chosen name; None for the only one.
        option: Name of the `-M` option that chooses, for messages.
        source: The file that holds them.

    Raises:
        UsageError: For a name that is not there, and for several without a choice: no file says whose units the
            actions get.
    """
    names = sorted(available)
    listed = ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
    if requested is None:
        if len(names) == 1:
            return names[0]
        raise UsageError(
            f"{source} has several action statistics, and nothing says whose units the actions get. Choose one "
            f"with -M {option}=NAME: {listed}"
        )
    if requested not in available:
        near = get_close_matches(requested, names, n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise UsageError(
            f"{source} has no action statistics of {requested!r}. Choose one with "
            f"-M {option}=NAME: {listed}.{hint}"
        )
    return requested
