"""Files of settings for `extract --config`: written by `--print-config`, or those of a run.

A run records where it had its checkpoint, the files of its source and those of the model's options. They are read
from there, unless an option beside `--config` gives another one.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import create_model

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.escaping import as_argument
from probe_kit._terminal.field_options import FieldOption, Part
from probe_kit.errors import UsageError
from probe_kit.extract.parts import is_here
from probe_kit.extract.settings import CONFIG, Settings
from probe_kit.extract.sources.kinds import SOURCES, kind_of, kinds_typed
from probe_kit.hooks.contract.declared import read_pairs
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.reader import origin_of
from probe_kit.runs.run_source import Origin

if TYPE_CHECKING:
    from probe_kit.extract.sources.source import SourceSettings
    from probe_kit.runs import Run


def origin_of_process(settings: Settings, card: Mapping[str, Any]) -> Origin:
    """Return the origin of a process that plays with some settings.

    Args:
        settings: The settings of the run.
        card: The card of its model as JSON; empty for a script.
    """
    model, checkpoint = settings.model, str(card.get("checkpoint") or "")
    return Origin(
        files={name: _absolute(path) for name, path in settings.source.files().items()},
        checkpoint=_absolute(checkpoint) if is_here(checkpoint) else checkpoint,
        options={**model.options, **{name: _absolute(path) for name, path in model.files().items()}},
        random_weights=model.random_weights,
        weights_seed=model.weights_seed,
        repositories=dict(card.get("repositories", {})),
    )


def _absolute(path: Path | str) -> str:
    return str(Path(path).expanduser().absolute())


def read_config(
    path: Path, typed: Mapping[str, Any] = MappingProxyType({}), asks: bool = False
) -> Mapping[str, Any]:
    """Return settings by part, from a file of `--print-config`, or from a run that its folder or `run.json` names.

    Args:
        path: The file, the folder of a run, or its `run.json`.
        typed: Values of a command line by parameter; what they replace is not searched for.
        asks: Whether the run is one of `probe-kit ask`.

    Raises:
        UsageError: For a file that holds neither, for a run without its settings, and for files of a run that are
            gone.
    """
    if path.is_dir() or path.name == RUN_FILE:
        return _run_settings(path if path.is_dir() else path.parent, typed, asks)
    return read_json_object(path, UsageError, "Write one with `probe-kit extract … --print-config`")


def _run_settings(folder: Path, typed: Mapping[str, Any], asks: bool) -> Mapping[str, Any]:
    """Return the settings of a run, with its checkpoint and its files where the run had them."""
    from probe_kit.runs.run import open_run

    run = open_run(folder, allow_partial=True)
    config: dict[str, Any] | None = run.settings.get(CONFIG)
    if config is None:
        raise UsageError(f"{folder} does not say with which settings it was requested; type the options again")
    if asks != ("prompt" in config["task"]):
        words, command = ("was not asked", "extract") if asks else ("was asked", "ask")
        raise UsageError(f"{folder} {words}; repeat it with `probe-kit {command} --config {as_argument(folder)}`")
    if (kind := kind_of(config["source"])) not in SOURCES:
        raise UsageError(f"{folder}: {run.source.words}. Continue it with `{kind.command}` and the same options")
    if any(edit.get("vector") for edit in config["task"].get("edits", ())):
        raise UsageError(
            f"{folder} was edited by vectors, which no run stores; repeat it in Python with `vectors`"
        )
    return {**config, "model": _model_of_run(run, config["model"], typed), **_typed_or_stored_source(run, typed)}


def _model_of_run(run: "Run", model: Mapping[str, Any], typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run's model as values. Raises UsageError for files that are gone and not typed."""
    origin, checkpoint = origin_of(run), model["checkpoint"]
    if typed.get("model") not in (None, model["family"]):
        return dict(model)
    if checkpoint is None and Path(origin.checkpoint).is_absolute():
        # Without it the family's default would be loaded, and nothing would say so.
        if "checkpoint" not in typed:
            _check_there(run, "checkpoint", Path(origin.checkpoint), "--checkpoint")
        checkpoint = origin.checkpoint
    for name in model["options"].keys() - read_pairs(typed.get("model_option", ())).keys():
        path = Path(str(origin.options.get(name, "")))
        if path.is_absolute():
            _check_there(run, name, path, f"-M {name}")
    return {**model, "checkpoint": checkpoint, "options": dict(origin.options)}


def _typed_or_stored_source(run: "Run", typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part `source` of a run's settings; empty where a command line names one of another kind."""
    kind = kind_of(run.settings[CONFIG]["source"])
    if kinds_typed(typed).keys() - {kind}:
        return {}
    return {"source": _source_with_files(run, kind, kind.replaced_by(typed), kind.command_options())}


def _source_with_files(
    run: "Run", kind: "type[SourceSettings]", replaced: Collection[str], offered: Collection[str]
) -> dict[str, Any]:
    """Return the settings of a run's source as values, with its files where the run had them.

    Args:
        run: The run whose source is opened again; it stores its settings.
        kind: The class of these settings.
        replaced: The fields that are given anew.
        offered: The fields that an option of the command gives.

    Raises:
        UsageError: For files that are gone.
    """
    files = {field: path for field, path in origin_of(run).files.items() if field not in replaced}
    source = kind.with_files(run.settings[CONFIG]["source"], files)
    # A run that does not say where its files were leads to their names, which may lie here.
    for field, path in (kind(**source).files() | {field: Path(path) for field, path in files.items()}).items():
        if field not in replaced and not path.exists():
            option = kind.command_options()[field].flag if field in offered else None
            _check_there(run, field, path, option)
    kind.find_again(files)
    return source


def _check_there(run: "Run", field: str, path: Path, flag: str | None) -> None:
    """Raise UsageError for a file that is gone; `flag` is the option that gives another one, None without."""
    if not path.exists():
        again = f"Give it with {flag}" if flag else "Put it there again"
        raise UsageError(f"{run.location} was made of {path}, its {field}, which is not here any more. {again}")


# -- moved parts of a source -------------------------------------------------------------------------------------


_PANEL = "Source that was moved"


def _options(kind: "type[SourceSettings]") -> dict[str, FieldOption]:
    """Return the options that give a moved part of this kind of source, by field."""
    options = kind.command_options()
    return {field: options[field] for field in kind.moves}


def _moved_options() -> type[Part]:
    fields: dict[str, Any] = {}
    for kind in SOURCES:
        for field, option in _options(kind).items():
            metavar = option.option.metavar
            renewed = typer.Option(option.flag, metavar=metavar, help=kind.moves[field], rich_help_panel=_PANEL)
            fields.setdefault(option.parameter, (Annotated[option.typed | None, renewed], None))
    model: type[Part] = create_model("MovedOptions", __base__=Part, **fields)
    return model


MovedOptions = _moved_options()
"""A model of which each field is one option of `extract` that gives a moved part of some source."""


def moved_of(run: "Run", typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts of a run's source that typed parameters give anew, by field.

    Other parameters are ignored.

    Raises:
        UsageError: For a part that only another kind of source has.
    """
    config = run.settings.get(CONFIG)
    options = {} if config is None else _options(kind_of(config["source"]))
    moved = {field: typed[option.parameter] for field, option in options.items() if option.parameter in typed}
    parameters = {option.parameter for option in options.values()}
    if refused := [name for name in typed if name in MovedOptions.model_fields.keys() - parameters]:
        flags = ", ".join(option.flag for option in options.values()) or "none"
        raise UsageError(
            f"--{refused[0].replace('_', '-')} does not apply: {run.location} is made of {run.source.words}. What "
            f"may have moved of it is given with {flags}"
        )
    return moved


def source_again(run: "Run", moved: Mapping[str, Any]) -> "SourceSettings":
    """Return the settings of a run's source, to show its observations again.

    The parts of `moved`, by field, take the place of the stored ones.

    Raises:
        UsageError: For a run without its settings, and for files that are gone.
    """
    if CONFIG not in run.settings:
        raise UsageError(f"{run.location} does not say with which settings it was requested; extract it again")
    kind = kind_of(run.settings[CONFIG]["source"])
    stored = _source_with_files(run, kind, moved, kind.moves)
    return kind(**kind.with_moved(stored, moved), **({"run": run.location.address} if kind.of_run else {}))
