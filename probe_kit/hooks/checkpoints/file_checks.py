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
    found = _type_of(config)
    if not isinstance(found, str) or found not in types:
        way_out = dict(instead).get(str(found), "Pass the right --model")
        raise CheckpointError(f"{file} holds a {found!r} model; expected {' or '.join(types)}. {way_out}")
    if not weights:
        return
    place = folder if adapter is None else adapter.base_folder()
    check_unambiguous(place)
    if lacking := missing_weights(place):
        raise WeightsError(f"no weights in {place}: {lacking}. {_way_to_weights(place)}")


def _type_of(config: Any) -> Any:
    """What kind of model a config.json describes; that of a training run of Prismatic has a part `model`."""
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
