"""Checks of a checkpoint's files before anything heavy is imported. Imports no torch."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import read_json
from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks.checkpoints.adapter_files import adapter_in
from probe_kit.hooks.checkpoints.checkpoint import (
    ADAPTER_FILE,
    CONFIG_FILE,
    check_unambiguous,
    is_in_cache,
    missing_weights,
)


def check_files(
    folder: Path, types: Sequence[str], weights: bool = True, instead: Sequence[tuple[str, str]] = ()
) -> None:
    """Look at what can be wrong with a checkpoint before anything heavy is imported.

    types: what `type` or `model_type` of its config may be. weights: whether its weights will be read. instead:
    for other types that people may take for one of them, what to do.
    Raises CheckpointError for a missing or unreadable config or one of another model, and for a LoRA adapter that
    cannot be merged; WeightsError for missing weights, and for two sets of them.
    """
    file = folder / CONFIG_FILE
    adapter = adapter_in(folder) if weights else None
    if not file.is_file():
        raise CheckpointError(f"{file} is missing; {folder} is not a checkpoint of {' or '.join(types)}")
    config = read_json(file, CheckpointError, "Download the checkpoint again")
    model_type = _type_of(config)
    if not isinstance(model_type, str) or model_type not in types:
        way_out = dict(instead).get(str(model_type), "Pass the right --model")
        raise CheckpointError(f"{file} holds a {model_type!r} model; expected {' or '.join(types)}. {way_out}")
    if not weights:
        return
    weights_folder = folder if adapter is None else adapter.base_folder()
    check_unambiguous(weights_folder)
    if lacking := missing_weights(weights_folder):
        raise WeightsError(f"no weights in {weights_folder}: {lacking}. {_way_to_weights(weights_folder)}")


def _type_of(config: Any) -> Any:
    """The model type that a config.json describes; that of a training run of Prismatic has a part `model`."""
    if not isinstance(config, dict):
        return None
    part = config.get("model")
    if isinstance(part, dict) and "vision_backbone_id" in part:
        return "prismatic"
    return config.get("type") or config.get("model_type")


def _way_to_weights(folder: Path) -> str:
    """Advice where weights are missing; an adapter in a folder below is no weights of this one."""
    if is_in_cache(folder):
        return (
            "Either the repository lacks them, or its copy in the cache is incomplete: compare with the files on "
            "its page, and fetch it again with the network on"
        )
    below = sorted(path.parent.name for path in folder.glob(f"*/{ADAPTER_FILE}"))
    return f"Pass {folder / below[0]}, which holds an adapter" if below else "Download the checkpoint again"
