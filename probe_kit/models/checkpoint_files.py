"""Small files of checkpoints: names of tensors, processors, statistics. Importing them loads no torch."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from probe_kit._system.bounded_files import check_no_pointer, read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, UsageError, WeightsError

if TYPE_CHECKING:
    from torch import Tensor

Renames = tuple[tuple[str, str], ...]
"""Patterns and replacements, applied in this order."""

LANGUAGE_FIRST: Renames = (
    (r"^(?:model\.)?language_model\.lm_head\.", "lm_head."),
    (r"^(?:model\.)?language_model\.(?:model\.)?", "model.language_model."),
    (r"^(?:model\.)?(vision_tower|multi_modal_projector)\.", r"model.\1."),
)
"""Renames of a vision-language model with a whole language model inside.

Released files call its layers `language_model.model.…`, transformers 5.5 saves `model.language_model.model.…`, and
a module has `model.language_model.…`.
"""

SIGLIP_TOWER: Renames = (
    (r"(^|\.)vision_tower\.(?=(?:embeddings|encoder|post_layernorm|head)\.)", r"\1vision_tower.vision_model."),
)
"""Renames of a SigLIP tower inside a network: newer transformers than the installed one have one level less."""


def rename_tensor(name: str, renames: Sequence[tuple[str, str]]) -> str:
    """Return the module's name of a tensor that a file calls `name`."""
    for pattern, replacement in renames:
        name = re.sub(pattern, replacement, name)
    return name


def renamed_tensors(
    tensors: "Mapping[str, Tensor]", name_in_module: Callable[[str], str], source: str = "the checkpoint"
) -> "dict[str, Tensor]":
    """Return the tensors of a file under the names of the module.

    Args:
        tensors: The content of the file.
        name_in_module: The module's name of a tensor in the file.
        source: The name of the file, for messages.

    Raises:
        WeightsError: For two tensors of one name with different numbers: a folder into which two layouts were
            saved.
    """
    stored_names: dict[str, str] = {}
    for name, tensor in tensors.items():
        other = stored_names.setdefault(name_in_module(name), name)
        if other is not name and not _are_equal(tensor, tensors[other]):
            raise WeightsError(
                f"weights in {source}: {other} and {name} are two names of one tensor, and hold different "
                "numbers. Two models were saved into one folder: save the one that is meant into a new folder"
            )
    return {module_name: tensors[name] for module_name, name in stored_names.items()}


def _are_equal(tensor: "Tensor", other: "Tensor") -> bool:
    return tensor.dtype == other.dtype and tensor.equal(other)


# -- processors -----------------------------------------------------------------------------------------------

PROCESSOR_FILE, PICTURES_FILE = "processor_config.json", "preprocessor_config.json"
PICTURES = "image_processor"
"""The part of a processor's file that says how pictures are prepared."""
_NAMING = ("processor_class", "image_processor_type", "feature_extractor_type", "auto_map", "_processor_class")


class PictureValues(NamedTuple):
    """The settings of a checkpoint for the preparation of pictures.

    Attributes:
        values: The settings by name.
        source: The file that has them, and its part, for messages.
    """

    values: dict[str, Any]
    source: str


_SAVE_AGAIN = "Save the processor of the training there, with its save_pretrained, or download the file again"


def processor_files(folder: Path) -> dict[str, dict[str, Any]]:
    """Return what the files of a processor in `folder` say, by their names for messages.

    The part for pictures comes first, then the file that it is in, then the file of pictures alone.

    Raises:
        CheckpointError: For a file that cannot be read.
    """
    files = {}
    for name in (PROCESSOR_FILE, PICTURES_FILE):
        if (file := folder / name).is_file():
            files[str(file)] = values = read_json_object(file, CheckpointError, _SAVE_AGAIN)
            pictures = values.get(PICTURES) if name == PROCESSOR_FILE else None
            if pictures is not None and not isinstance(pictures, dict):
                raise CheckpointError(f"{file} has {PICTURES} {pictures!r}; expected named values. {_SAVE_AGAIN}")
            files = {f"{file} ({PICTURES})": pictures, **files} if pictures is not None else files
    return files


def _picture_sources(folder: Path) -> list[PictureValues]:
    """Return what files of `folder` say about pictures; the first one counts."""
    names = (f"{folder / PROCESSOR_FILE} ({PICTURES})", str(folder / PICTURES_FILE))
    files = processor_files(folder)
    return [PictureValues(files[name], name) for name in names if name in files]


def picture_values(folders: Path | Sequence[Path]) -> PictureValues | None:
    """Return what the first of `folders` with such a file says about pictures; None where none has one.

    transformers 5 saves one file, `processor_config.json` with a part `image_processor`; before, pictures had
    `preprocessor_config.json`. Where a folder has both, the part counts, as in transformers.

    Raises:
        CheckpointError: For a file that cannot be read.
    """
    for folder in (folders,) if isinstance(folders, Path) else folders:
        if sources := _picture_sources(folder):
            return sources[0]
    return None


def describe_picture_conflict(folder: Path) -> str:
    """Return which settings of pictures two files of a folder give different values; empty where they agree.

    Where an adapter is joined with its base, the adapter's file counts and the base's is no conflict.

    Raises:
        CheckpointError: For a file that cannot be read.
    """
    sources = _picture_sources(folder)
    origins = {(folder / name).resolve().parent for name in (PROCESSOR_FILE, PICTURES_FILE)}
    if len(sources) < len((PROCESSOR_FILE, PICTURES_FILE)) or len(origins) > 1:
        return ""
    inside, apart = sources
    both = sorted((inside.values.keys() & apart.values.keys()) - {*_NAMING})
    if not (different := [name for name in both if inside.values[name] != apart.values[name]]):
        return ""
    return (
        f"pictures are prepared as {PICTURES} in {PROCESSOR_FILE} says, as in transformers; {PICTURES_FILE} "
        f"beside it has another {', '.join(different)}"
    )


def processor_settings(folder: Path, needed: Sequence[str], optional: Sequence[str] = ()) -> PictureValues:
    """Return the named settings of pictures in `folder`; `optional` ones only where they are set.

    Raises:
        CheckpointError: If no file has them, one cannot be read, or a needed value is missing.
    """
    stored = picture_values(folder)
    if stored is None:
        raise CheckpointError(
            f"{folder / PICTURES_FILE} is missing, and so is {PICTURES} in {PROCESSOR_FILE}; one of the two "
            "defines how pictures are prepared for this checkpoint. Save the processor that it was trained with "
            "there, with its save_pretrained; the base's file is right only if training prepared pictures alike"
        )
    values = stored.values
    if missing := [name for name in needed if values.get(name) is None]:
        raise CheckpointError(f"{stored.source} lacks {', '.join(missing)}. {_SAVE_AGAIN}")
    settings = {name: values[name] for name in (*needed, *optional) if values.get(name) is not None}
    return PictureValues(settings, stored.source)


def square_side(settings: PictureValues) -> int:
    """Return the side in pixels of the square that `size` names.

    Raises:
        CheckpointError: If it names none.
    """
    size = settings.values["size"]
    height, width = (size.get(side) if isinstance(size, dict) else size for side in ("height", "width"))
    if not isinstance(height, int) or height != width:
        raise CheckpointError(f"{settings.source} has size {size}; expected a square of so many pixels")
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
        CheckpointError: If the object needs such code, or transformers cannot read its files, and for a folder
            without the configuration that is asked for: transformers would take the sizes of a class.
        LfsPointerError: For a Git LFS pointer among them.
    """
    reads_sizes, folder = hasattr(loader, "get_config_dict"), Path(source)
    if reads_sizes and folder.is_dir() and not (folder / "config.json").is_file():
        raise CheckpointError(f"{source} has no config.json. Download the checkpoint's JSON files again")
    try:
        with while_reading_pretrained(Path(source), getattr(loader, "__name__", "its loader")):
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
