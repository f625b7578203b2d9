"""Folders of checkpoints: LoRA adapters and their bases, checks of files, states. Imports no torch."""

import atexit
import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import load_json, read_json, read_json_object
from probe_kit.errors import CheckpointError, ProbeKitError, WeightsError
from probe_kit.hooks.checkpoints.checkpoint import (
    ADAPTER_FILE,
    CONFIG_FILE,
    PATTERNS,
    SMALL_FILES,
    check_unambiguous,
    is_in_cache,
    is_weights,
    missing_weights,
    plain_folder,
)
from probe_kit.models.checkpoint_files import PICTURES, PICTURES_FILE, PROCESSOR_FILE

ADAPTER_WEIGHTS = ("adapter_model.safetensors", "adapter_model.bin")
SCALING = ("r", "lora_alpha", "rank_pattern", "alpha_pattern", "use_rslora", "use_dora", "lora_bias")
"""Fields that decide how much the factors add to a weight."""
_COPIES = ("bias", "modules_to_save")
_NAMING = ("peft_type", "base_model_name_or_path")
_WITHOUT_EFFECT = (
    "task_type", "auto_mapping", "peft_version", "inference_mode", "target_modules", "exclude_modules",
    "lora_dropout", "layers_to_transform", "layers_pattern", "megatron_core", "qalora_group_size",
    "runtime_config", "eva_config", "loftq_config", "velora_config", "ensure_weight_tying",
)  # fmt: skip
"""Fields of training, speed, and rules for choosing modules: the tensors themselves say which ones they change."""
_INERT: Mapping[str, tuple[Any, ...]] = {
    "init_lora_weights": (True, False, None, "gaussian", "eva", "orthogonal"),
    "revision": (None, "", "main"),
}
"""Fields with the values under which a merge is exact. Other initialisations change the base's weights."""
_NOTHING: tuple[Any, ...] = (None, False, "", [], {})
"""The values that switch every other field off."""


@dataclass(frozen=True)
class AdapterFiles:
    """A LoRA adapter in a folder.

    Attributes:
        settings: The content of its `adapter_config.json`.
        weights: The file of its tensors.
    """

    folder: Path
    settings: Mapping[str, Any]
    weights: Path

    @property
    def base(self) -> str:
        """Folder or hub id of the checkpoint that it was trained on, as the file names it."""
        return str(self.settings["base_model_name_or_path"])

    def base_folder(self, patterns: Sequence[str] = PATTERNS) -> Path:
        """The folder of the base's checkpoint; a relative path may start at the adapter.

        `patterns` are the files that are needed of a base on the hub.

        Raises:
            CheckpointError: If it is not there, or is an adapter itself.
        """
        return base_folder_of(self.folder, self.settings, patterns)


_JOINED: dict[str, Path] = {}
"""Folders in which the files of an adapter and its base are joined, with the adapter's own."""


def with_adapters_named(text: str) -> str:
    """Return a text in which every joined folder has the name of its adapter's own."""
    for joined, folder in _JOINED.items():
        text = text.replace(joined, str(folder))
    return text


def base_folder_of(folder: Path, settings: Mapping[str, Any], patterns: Sequence[str] = PATTERNS) -> Path:
    """The folder of the base of the adapter in `folder`, with these settings; see `AdapterFiles.base_folder`.

    Raises:
        CheckpointError: If it is not there, or is an adapter itself.
    """
    base = str(settings["base_model_name_or_path"])
    sibling = folder / base
    try:
        base_folder = sibling.resolve() if sibling.is_dir() else plain_folder(base, patterns)
    except CheckpointError as error:
        raise CheckpointError(
            f"the LoRA adapter in {folder} was trained on {base!r}: {error}. "
            f"Correct base_model_name_or_path in its {ADAPTER_FILE}"
        ) from error
    if base_folder.resolve() == folder.resolve():
        return folder
    if (base_folder / ADAPTER_FILE).is_file():
        raise CheckpointError(
            f"the base {base_folder} of the LoRA adapter in {folder} is an adapter itself. Merge the base with "
            "peft first, and name the merged folder as base_model_name_or_path"
        )
    return base_folder


def adapter_settings(file: Path) -> dict[str, Any]:
    """The content of an `adapter_config.json` of an adapter that can be merged.

    Raises:
        CheckpointError: For a file that cannot be read, and for an adapter that cannot be merged exactly.
    """
    settings = dict(read_json_object(file, CheckpointError, "Download the adapter again"))
    _check_settings(file, settings)
    return settings


def adapter_in(folder: Path) -> AdapterFiles | None:
    """The LoRA adapter in a checkpoint's folder; None where there is none.

    Raises:
        CheckpointError: For an adapter that cannot be merged exactly, for one that lacks a file, and for weights
            beside it that may be the base's or merged.
    """
    folder = _JOINED.get(str(folder), folder)
    file = folder / ADAPTER_FILE
    weights = next((folder / name for name in ADAPTER_WEIGHTS if (folder / name).is_file()), None)
    if not file.is_file():
        _check_no_traces(folder, weights)
        return None
    settings = adapter_settings(file)
    if weights is None:
        raise CheckpointError(
            f"{folder} has {ADAPTER_FILE}, but neither {' nor '.join(ADAPTER_WEIGHTS)}. Download the adapter again"
        )
    adapter = AdapterFiles(folder, settings, weights)
    if not missing_weights(folder):
        _check_own_base(adapter)
    return adapter


def _check_no_traces(folder: Path, weights: Path | None) -> None:
    """Raise CheckpointError for a folder that was an adapter's, without the file that says how it is merged."""
    if weights is not None:
        raise CheckpointError(
            f"{folder} has {weights.name}, but no {ADAPTER_FILE}, which says how it changes the weights. Put the "
            f"adapter's {ADAPTER_FILE} there, or remove {weights.name} if the weights are merged"
        )
    config = folder / CONFIG_FILE
    if not config.is_file():
        return
    values = read_json_object(config, CheckpointError, "Download the checkpoint again")
    if values.get("use_peft"):
        raise CheckpointError(
            f"{config} says use_peft: true, and {folder} has no {ADAPTER_FILE}: its weights alone may be those "
            f"of the base. Put {ADAPTER_FILE} and {ADAPTER_WEIGHTS[0]} there, or set use_peft to false if the "
            "weights are merged"
        )


def _check_settings(file: Path, settings: Mapping[str, Any]) -> None:
    """Raise CheckpointError for an adapter that adds something else to weights than its scaled factors."""
    if (kind := settings.get("peft_type")) != "LORA":
        raise CheckpointError(
            f"{file.parent} holds a {kind} adapter; only LORA can be merged. Merge it with peft, and pass the "
            "merged folder"
        )
    if not settings.get("base_model_name_or_path"):
        raise CheckpointError(f"{file} does not say its base_model_name_or_path; add it")
    plain = {*SCALING, *_COPIES, *_NAMING, *_WITHOUT_EFFECT}
    unexplained = {name: value for name, value in settings.items() if name not in plain}
    wrong = [
        f"{name}: {value!r}" for name, value in unexplained.items() if value not in _INERT.get(name, _NOTHING)
    ]
    if wrong:
        raise CheckpointError(
            f"{file} says {', '.join(wrong)}, which a merge of low-rank factors does not repeat exactly. Merge "
            "the adapter with the tool that made it, and pass the merged folder"
        )


def _check_own_base(adapter: AdapterFiles) -> None:
    """Raise CheckpointError unless the weights beside the adapter are the base that it names."""
    base_folder = adapter.folder / adapter.base
    if base_folder.is_dir() and base_folder.resolve() == adapter.folder.resolve():
        return
    raise CheckpointError(
        f"{adapter.folder} holds weights and a LoRA adapter of {adapter.base!r}: no file says whether these "
        f"weights are the base's or merged. If they are merged, remove {ADAPTER_FILE} and {adapter.weights.name}. "
        "If they are the base's, set base_model_name_or_path to '.'. If they are neither, remove them"
    )


# -- folders --------------------------------------------------------------------------------------------------

CONFIGURATIONS = (CONFIG_FILE, "config.yaml")
"""The files that can hold the configuration of a network; one of them does."""
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
"""The names that some layouts keep beside the folder of a checkpoint."""
_RUNS = "checkpoints"
_DONE: dict[tuple[object, ...], Path] = {}


def checkpoint_folder(checkpoint: str, patterns: Sequence[str] = PATTERNS) -> Path:
    """The folder of a checkpoint, by path or hub id; that of an adapter alone is joined with its base's files.

    A file of the adapter replaces the base's, so its statistics win, and its settings of pictures do in whichever
    file they are. The joined folder holds links and is removed at the end of the process.

    Args:
        checkpoint: Folder path or hub id.
        patterns: The files that are needed of a hub repository, see `plain_folder`; also of a base on the hub.

    Raises:
        CheckpointError: As `plain_folder` does, and for a base that is not there or has no configuration either.
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
    """The folder that a checkpoint names: inside its own, anywhere, or on the hub.

    Args:
        folder: The folder of the checkpoint.
        name: The name that the checkpoint gives: a folder inside its own, a path or a hub id.
        patterns: The files to fetch.

    Raises:
        CheckpointError: For a folder that is not there.
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
    """Return a new folder of links, with the name that the adapter's has."""
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
    if PICTURES_FILE in adapter_names and PROCESSOR_FILE not in adapter_names:
        _drop_pictures(joined / PROCESSOR_FILE)
    for name in _BESIDE:
        if (base.parent / name).exists() and not (root / name).exists():
            (root / name).symlink_to((base.parent / name).resolve())
    _JOINED[str(joined)] = folder
    return joined


def _drop_pictures(processor: Path) -> None:
    """Replace a base's file of a processor by one without the part for pictures, which would count first."""
    if not processor.is_file():
        return
    values = read_json_object(processor, CheckpointError, "Download the base again")
    if values.pop(PICTURES, None) is not None:
        processor.unlink()
        processor.write_text(json.dumps(values), encoding="utf-8")


def _is_left_out(path: Path) -> bool:
    """Whether a file of the base holds weights, or names them."""
    return path.name in (ADAPTER_FILE, *ADAPTER_WEIGHTS, _RUNS) or is_weights(path)


def _is_replaced(name: str, adapter_names: Sequence[str]) -> bool:
    """Whether the adapter has this file of the base, or one that is read together with such files."""
    parts = (begin for heads, begin in _READ_TOGETHER if any(head in adapter_names for head in heads))
    return name in adapter_names or any(name.startswith(begin) for begin in parts)


# -- checks before loading ------------------------------------------------------------------------------------


def check_files(
    folder: Path, types: Sequence[str], weights: bool = True, instead: Sequence[tuple[str, str]] = ()
) -> None:
    """Check what can be wrong with a checkpoint before anything heavy is imported.

    Args:
        folder: The folder of the checkpoint.
        types: The values that `type` or `model_type` of its config may have.
        weights: Whether its weights will be read.
        instead: For other types that people may take for one of them, what to do.

    Raises:
        CheckpointError: For a missing or unreadable config or one of another model, and for a LoRA adapter that
            cannot be merged.
        WeightsError: For missing weights, and for two sets of them.
    """
    file = folder / CONFIG_FILE
    adapter = adapter_in(folder) if weights else None
    if not file.is_file():
        way_out = _way_to_checkpoint(folder, types)
        advice = way_out or (
            f". Give the folder that holds {CONFIG_FILE} and the weights; lerobot-train calls it pretrained_model"
        )
        raise CheckpointError(f"{file} is missing; {folder} is not a checkpoint of {' or '.join(types)}{advice}")
    config = read_json(file, CheckpointError, "Download the checkpoint again")
    model_type = _type_of(config)
    if not isinstance(model_type, str) or model_type not in types:
        way_out = dict(instead).get(str(model_type), "Pass the right --model")
        if model_type is None and (elsewhere := _way_to_checkpoint(folder, types)):
            raise CheckpointError(f"{file} names no type of model; expected {' or '.join(types)}{elsewhere}")
        raise CheckpointError(f"{file} holds a {model_type!r} model; expected {' or '.join(types)}. {way_out}")
    if not weights:
        return
    weights_folder = folder if adapter is None else adapter.base_folder()
    check_unambiguous(weights_folder)
    if lacking := missing_weights(weights_folder):
        raise WeightsError(f"no weights in {weights_folder}: {lacking}. {_way_to_weights(weights_folder)}")


_DEEPEST = 4
"""The folders between a training's output and the checkpoints in it, at most."""
_MOST_FOLDERS = 2_000
_OPENPI_STATISTICS = ("assets/norm_stats.json", "assets/*/norm_stats.json", "assets/*/*/norm_stats.json")
_OPENPI_FIELDS = {"paligemma_variant", "action_expert_variant"}
_NO_CONVERTER = (
    "No release of openpi or lerobot converts it to lerobot's layout: take a checkpoint that lerobot-train saved, "
    "or one of the hub in its layout"
)


def _way_to_checkpoint(folder: Path, types: Sequence[str]) -> str:
    """Return where a checkpoint of these types lies near a folder, or whose layout it has; empty where unknown."""
    if (below := _checkpoints_near(folder, types))[:1]:
        more = f" (or {', '.join(map(str, below[1:3]))})" if len(below) > 1 else ""
        return f". One lies in it: pass --checkpoint {below[0]}{more}"
    statistics = [path for pattern in _OPENPI_STATISTICS for path in sorted(folder.glob(pattern))]
    marks = [str(path.relative_to(folder)) for path in statistics]
    if (folder / "params").is_dir() and (marks or (folder / "params" / "_METADATA").is_file()):
        return (
            f". This is openpi's JAX layout ({', '.join(['params', *marks])}). Its examples/"
            f"convert_jax_model_to_pytorch.py writes openpi's PyTorch layout. {_NO_CONVERTER}"
        )
    if _fields_of(folder) & _OPENPI_FIELDS:
        marks = ["config.json without a type", *marks]
    return f". This is openpi's PyTorch layout ({', '.join(marks)}). {_NO_CONVERTER}" if marks else ""


def _checkpoints_near(folder: Path, types: Sequence[str]) -> list[Path]:
    """The folders of checkpoints of these types below one, or beside it as lerobot has them; the latest first."""
    folders = [*_folders_below(folder), folder.absolute().parent / "pretrained_model"]
    checkpoints = [path for path in folders if _has_type(path, types)]
    distinct = {path.resolve(): path for path in sorted(checkpoints, key=_step)}
    return list(distinct.values())[::-1]


def _folders_below(folder: Path) -> list[Path]:
    """The folders in one, up to `_DEEPEST` deep and `_MOST_FOLDERS` in all: it may be a home, or a whole disk."""
    below, level = list[Path](), [folder]
    for _ in range(_DEEPEST):
        deeper: list[Path] = []
        for path in level:
            if len(below) + len(deeper) < _MOST_FOLDERS:
                with suppress(OSError):
                    deeper += [inner for inner in islice(path.iterdir(), _MOST_FOLDERS) if inner.is_dir()]
        below, level = below + deeper, deeper
    return below


def _step(folder: Path) -> list[tuple[float, str]]:
    """The key by which later checkpoints come last: a number at a name's end is a step; `last` is the latest."""
    ends = [(part, part.rpartition("-")[2]) for part in folder.parts]
    return [
        (float("inf") if part == "last" else float(end) if end.isdecimal() else -1, part) for part, end in ends
    ]


def _has_type(folder: Path, types: Sequence[str]) -> bool:
    """Whether a folder has the configuration of a model of these types, or is an adapter without any."""
    try:
        return _type_of(load_json(folder / CONFIG_FILE)) in types
    except FileNotFoundError:
        return (folder / ADAPTER_FILE).is_file()
    except (OSError, ValueError, ProbeKitError):
        return False


def _fields_of(folder: Path) -> set[str]:
    try:
        config = load_json(folder / CONFIG_FILE)
    except (OSError, ValueError):
        return set()
    return set(config) if isinstance(config, dict) else set()


def _type_of(config: Any) -> Any:
    """The model type that a config.json describes; that of a training run of Prismatic has a part `model`."""
    if not isinstance(config, dict):
        return None
    part = config.get("model")
    if isinstance(part, dict) and "vision_backbone_id" in part:
        return "prismatic"
    return config.get("type") or config.get("model_type")


def _way_to_weights(folder: Path) -> str:
    """Return advice where weights are missing; an adapter in a folder below is no weights of this one."""
    if is_in_cache(folder):
        return (
            "Either the repository lacks them, or its copy in the cache is incomplete: compare with the files on "
            "its page, and fetch it again with the network on"
        )
    below = sorted(path.parent.name for path in folder.glob(f"*/{ADAPTER_FILE}"))
    return f"Pass {folder / below[0]}, which holds an adapter" if below else "Download the checkpoint again"
