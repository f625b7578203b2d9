"""Files of settings for `extract --config`: written by `--print-config`, or those of a run."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.bounded_json import read_json_object
from probe_kit._terminal.field_options import options_of
from probe_kit.errors import UsageError
from probe_kit.extract.settings import Settings
from probe_kit.extract.sources.kinds import kind_of
from probe_kit.extract.sources.scene import SceneOptions, SceneSettings
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.origin import is_here
from probe_kit.runs.reader import origin_of

if TYPE_CHECKING:
    from probe_kit.runs import Run

CONFIG = "config"
"""The part of a run's settings that holds them as they were requested, by part."""


def portable(settings: Settings) -> dict[str, Any]:
    """The settings by part as a run stores them: without machine, label and places of this machine.

    Where checkpoint and files of the source lie is recorded by the process that played.
    """
    config = {name: part for name, part in settings.config().items() if name not in ("machine", "label")}
    model, source = config["model"], config["source"]
    if is_here(model["checkpoint"]):
        model["checkpoint"] = None
    for field, path in settings.source.files().items():
        _put(source, field, path.name)
    return config


def read_config(path: Path, typed: Collection[str] = (), asks: bool = False) -> Mapping[str, Any]:
    """Settings by part, from a file of `--print-config`, or from a run that its folder or `run.json` names.

    typed: parameters that a command line names; what they replace is not searched for. asks: whether the run is
    one of `probe-kit ask`.
    Raises UsageError for a file that holds neither, for a run without its settings, and for files of a run that
    are gone.
    """
    if path.is_dir() or path.name == RUN_FILE:
        return _of_run(path if path.is_dir() else path.parent, typed, asks)
    return read_json_object(path, UsageError, "Write one with `probe-kit extract … --print-config`")


def _of_run(folder: Path, typed: Collection[str], asks: bool) -> Mapping[str, Any]:
    """The settings of a run, with its checkpoint and the files of its source where the run found them."""
    from probe_kit.runs.run import open_run

    run = open_run(folder, allow_partial=True)
    config: dict[str, Any] | None = run.settings.get(CONFIG)
    if config is None:
        raise UsageError(f"{folder} does not say with which settings it was requested; type the options again")
    if asks != ("prompt" in config["task"]):
        words, command = ("was not asked", "extract") if asks else ("was asked", "ask")
        raise UsageError(f"{folder} {words}; repeat it with `probe-kit {command} --config {folder}`")
    if any(edit.get("vector") for edit in config["task"].get("edits", ())):
        raise UsageError(
            f"{folder} was edited by vectors, which no run stores; repeat it in Python with `vectors`"
        )
    origin = origin_of(run)
    model = {**config["model"], "options": dict(origin.options)}
    if model["checkpoint"] is None and is_here(origin.checkpoint):
        model["checkpoint"] = origin.checkpoint
    kind = kind_of(config["source"])
    options = {option.field: option for option in options_of(kind)}
    if kind is SceneSettings:
        options |= {f"scene.{option.field}": option for option in options_of(SceneOptions)}
    replaced = [field for field, option in options.items() if option.parameter in typed]
    source = source_of_run(run, replaced, {field: option.flag for field, option in options.items()})
    return {**config, "model": model, "source": source}


def source_of_run(run: "Run", replaced: Collection[str], flags: Mapping[str, str]) -> dict[str, Any]:
    """The settings of a run's source as values, with its files where the run found them.

    replaced: fields that are given anew. flags: options of a command that give fields.
    Raises UsageError for a run without its settings, and for files that are gone.
    """
    config = run.settings.get(CONFIG)
    if config is None:
        raise UsageError(f"{run.location} does not say with which settings it was requested; extract it again")
    origin = origin_of(run)
    source = dict(config["source"])
    for field, stored_path in origin.files.items():
        if field not in replaced:
            _check_there(run, field, Path(stored_path), flags)
            _put(source, field, stored_path)
    kind = kind_of(source)
    kind.find_again(origin.files)
    for field, path in kind(**source).files().items():  # of a run that does not say where they were
        if field not in replaced:
            _check_there(run, field, path, flags)
    return source


def _check_there(run: "Run", field: str, path: Path, flags: Mapping[str, str]) -> None:
    if not path.exists():
        again = f"Give it with {flags[field]}" if field in flags else "Put it there again"
        raise UsageError(f"{run.location} was made of {path}, its {field}, which is not here any more. {again}")


def _put(source: dict[str, Any], field: str, value: str) -> None:
    """Set a field of a source's settings, such as `folder` or `scene.background`; others are no settings."""
    first, _, inner = field.partition(".")
    if inner and first in source:
        source[first] = {**source[first], inner: value}
    elif first in source:
        source[first] = value
