"""Files of settings for `extract --config`: written by `--print-config`, or those of a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import UsageError
from probe_kit.extract.settings import Settings
from probe_kit.runs.layout import RUN_FILE

CONFIG = "config"
"""The part of a run's settings that holds them as they were requested, by part."""
_FILES_OF_SCENE = ("arm_urdf", "background")


def portable(settings: Settings) -> dict[str, Any]:
    """The settings by part as a run stores them: without machine, label and places of this machine.

    Where suite, checkpoint and files lie is recorded by the process that played.
    """
    config = {name: part for name, part in settings.config().items() if name not in ("machine", "label")}
    model, source = config["model"], config["source"]
    if _is_here(model["checkpoint"]):
        model["checkpoint"] = None
    if "scene" in source:
        source["suite"] = None
        source["scene"] |= dict.fromkeys(_FILES_OF_SCENE)
    elif "folder" in source:
        source["folder"] = settings.source.name
        source |= {"table": Path(source["table"]).name} if "table" in source else {}
    return config


def read_config(path: Path) -> Mapping[str, Any]:
    """Settings by part, from a file of `--print-config`, or from a run that its folder or `run.json` names.

    Raises UsageError for a file that holds neither, and for a run without its settings.
    """
    if path.is_dir() or path.name == RUN_FILE:
        return _of_run(path if path.is_dir() else path.parent)
    return read_json_object(path, UsageError, "Write one with `probe-kit extract … --print-config`")


def _of_run(folder: Path) -> Mapping[str, Any]:
    """The settings of a run, with its suite, checkpoint and files where the run found them."""
    from probe_kit.runs.run import open_run
    from probe_kit.runs.sources import RunSources

    run = open_run(folder, allow_partial=True)
    config: dict[str, Any] | None = run.settings.get(CONFIG)
    if config is None:
        raise UsageError(f"{folder} does not say with which settings it was requested; type the options again")
    played = run.sources[0] if run.sources else RunSources()
    model = {**config["model"], "options": dict(played.options)}
    if model["checkpoint"] is None and _is_here(played.checkpoint):
        model["checkpoint"] = played.checkpoint
    source = dict(config["source"])
    if "scene" in source:
        source |= {"suite": played.suite, "scene": {**source["scene"], **played.scene_files}}
    return {**config, "model": model, "source": source}


def _is_here(checkpoint: str | None) -> bool:
    return bool(checkpoint) and Path(str(checkpoint)).expanduser().exists()
