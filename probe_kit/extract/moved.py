"""Files and modules of a run's source that were moved: the options of a command that give them anew."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import create_model

from probe_kit._terminal.field_options import FieldOption, Part
from probe_kit.errors import UsageError
from probe_kit.extract.config_files import CONFIG, source_of_run
from probe_kit.extract.sources.kinds import SOURCES, kind_of

if TYPE_CHECKING:
    from probe_kit.extract.sources.source import SourceSettings
    from probe_kit.runs import Run

_PANEL = "Source that was moved"


def _options(kind: "type[SourceSettings]") -> dict[str, FieldOption]:
    """The options that give a moved part of this kind of source, by field."""
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

    Other parameters are passed over. Raises UsageError for a part that only another kind of source has.
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
    """Return the settings of a run's source, to show its observations again. moved: parts given anew, by field.

    Raises what `source_of_run` raises.
    """
    kind = kind_of(run.settings[CONFIG]["source"]) if CONFIG in run.settings else None
    flags = {} if kind is None else {field: option.flag for field, option in _options(kind).items()}
    values = source_of_run(run, moved, flags)
    kind = kind_of(values)
    return kind(**kind.with_moved(values, moved))
