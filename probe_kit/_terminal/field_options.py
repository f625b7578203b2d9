"""Commands whose options are fields of models: a field is declared once, as setting, option and key of a file.

A field that a command offers has a `typer.Option` in its annotation. The type, the choices, the default and the
bounds are the field's own; pydantic ignores the option, and typer sees nothing of the model. A command with many
options prints those of further panels with `--help-all` only.
"""

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from types import UnionType
from typing import Annotated, Any, Self, Union, get_args, get_origin

import typer
import typer.core
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo
from typer.models import OptionInfo

from probe_kit._system.complaints import UNKNOWN, complaints_of, in_words
from probe_kit._terminal.console import whole_numbers_in_help
from probe_kit.errors import UsageError


class Part(BaseModel):
    """A frozen group of settings. Values without a name are those of the first fields.

    Raises:
        UsageError: For a value that does not fit; it names the field, the value and what is expected in its place.
        TypeError: For more values than fields.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    def __init__(self, *first: Any, **values: Any) -> None:
        names = [name for name in type(self).model_fields if name != "kind"]
        if len(first) > len(names):
            raise TypeError(f"{type(self).__name__} has {len(names)} fields; {len(first)} values are given")
        try:
            super().__init__(**dict(zip(names, first, strict=False)), **values)
        except ValidationError as error:
            raise UsageError(_complaint_of_unknown(type(self).__name__, error) or in_words(error)) from None

    def changed(self, **values: Any) -> Self:
        """Return the group with other values, which are checked."""
        return type(self)(**(dict(self) | values))


def _complaint_of_unknown(subject: str, error: ValidationError) -> str:
    """Return a sentence on a field that the model `subject` lacks; empty if that is not the first mistake."""
    path, text = next(complaints_of(error))
    return f"{subject} has no setting {'.'.join(map(str, path))}; leave it out" if text == UNKNOWN else ""


@dataclass(frozen=True)
class FieldOption:
    """A field that a command offers as an option.

    Attributes:
        field: The name of the field in its model.
        parameter: The option's name in Python, from its long form.
        flag: The long form, such as `--captured-calls`.
    """

    field: str
    parameter: str
    flag: str
    info: FieldInfo
    option: OptionInfo

    @property
    def typed(self) -> Any:
        """The type that typer reads: texts where the field reads several of them, and anything behind a parser."""
        bare = _bare(self.info.annotation)
        if self.option.parser is not None:
            return object
        return list[str] | None if get_origin(bare) in (dict, tuple) else bare


def options_of(model: type[BaseModel]) -> Iterator[FieldOption]:
    """Yield the options among the fields of a model, in their order."""
    for name, info in model.model_fields.items():
        for option in (entry for entry in info.metadata if isinstance(entry, OptionInfo)):
            texts = (option.default, *(option.param_decls or ()))
            declared = (str(text).rpartition("/")[2].strip() for text in texts)
            flag = next(text for text in declared if text.startswith("--"))
            yield FieldOption(name, flag.removeprefix("--").replace("-", "_"), flag, info, option)


def command_with(
    *models: type[BaseModel], offers: Callable[[str], bool] = bool
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command with the options of models, in front of its own.

    The command gets the values that were typed by the name of their parameter, as its first argument. A parameter
    that two models share is one option; one that the command has itself, or does not offer, is not added.

    Args:
        *models: The models; required fields of the first one are required options.
        offers: Whether the command offers a parameter, by its name; by default all.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        first, *parameters = inspect.signature(command, eval_str=True).parameters.values()
        names = {parameter.name for parameter in parameters}
        added: dict[str, inspect.Parameter] = {}
        for option in chain.from_iterable(map(options_of, models)):
            if option.parameter not in names and offers(option.parameter):
                added.setdefault(option.parameter, _parameter(option))

        def run(context: typer.Context, **values: Any) -> None:
            typed = {
                name: value for name in added if _was_typed(context, name) and (value := values[name]) is not None
            }
            command(typed, **{parameter.name: values[parameter.name] for parameter in parameters})

        required_names = _required_parameters(models)
        required = [parameter for parameter in added.values() if parameter.name in required_names]
        optional = [parameter for parameter in (*parameters, *added.values()) if parameter not in required]
        ordered = [*required, *sorted(optional, key=lambda parameter: _panel(parameter) is not None)]
        context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        keyword = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in ordered]
        run.__signature__ = inspect.Signature([context, *keyword])  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in (context, *keyword)}
        run.__name__, run.__doc__, run.__module__ = command.__name__, command.__doc__, command.__module__
        run.__wrapped__ = command  # type: ignore[attr-defined]
        del first
        return run

    return decorate


def _required_parameters(models: Iterable[type[BaseModel]]) -> set[str]:
    """Return the parameters that every command line has: those of required fields of the first model."""
    first = next(iter(models), None)
    return (
        set() if first is None else {option.parameter for option in options_of(first) if option.info.is_required()}
    )


def _parameter(offered: FieldOption) -> inspect.Parameter:
    required = offered.info.is_required()
    default = None if required or offered.typed == list[str] | None else offered.info.default
    typed = offered.typed | None if default is None and offered.typed is not object else offered.typed
    return inspect.Parameter(
        offered.parameter,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[typed, offered.option],
    )


def _was_typed(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def _panel(parameter: inspect.Parameter) -> str | None:
    for entry in get_args(parameter.annotation)[1:]:
        if isinstance(entry, OptionInfo):
            return entry.rich_help_panel
    return None


def _bare(annotation: Any) -> Any:
    """Return a type without the metadata of its parts, such as `int | None` of an optional bounded number."""
    if get_origin(annotation) is Annotated:
        return _bare(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return Union[tuple(_bare(member) for member in get_args(annotation))]  # noqa: UP007 - made of a tuple
    return annotation


def plain(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries that are neither None nor False: those that were chosen."""
    return {name: entry for name, entry in value.items() if entry is not None and entry is not False}


# -- help in panels -------------------------------------------------------------------------------------------

MOST_OPTIONS = 12
"""The most options with which a command prints all of them; beyond, `--help-all` prints the further panels."""
HELP_ALL = "--help-all"
_MAIN_ONLY = "probe_kit.main_options_only"


class PanelledHelp(typer.core.TyperCommand):
    """A command whose most used options are those without a `rich_help_panel`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments; `--help-all` among them prints every panel and ends the command."""
        if HELP_ALL in args and not ctx.resilient_parsing:
            self.format_whole_help(ctx, ctx.make_formatter())
            ctx.exit()
        return super().parse_args(ctx, args)

    def get_params(self, ctx: Any) -> list[Any]:
        """Return all options, or the most used ones while `--help` prints them."""
        parameters = super().get_params(ctx)
        return (
            [parameter for parameter in parameters if not _panel_of(parameter)]
            if ctx.meta.get(_MAIN_ONLY)
            else parameters
        )

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the most used options, and the names of the further panels."""
        panels = self._further_panels()
        ctx.meta[_MAIN_ONLY] = bool(panels)
        try:
            with whole_numbers_in_help():
                super().format_help(ctx, formatter)
        finally:
            ctx.meta[_MAIN_ONLY] = False
        if panels:
            typer.echo(f" Further options, with {HELP_ALL}: {', '.join(panels)}.\n")

    def format_whole_help(self, ctx: Any, formatter: Any) -> None:
        """Print all panels."""
        with whole_numbers_in_help():
            super().format_help(ctx, formatter)

    def _further_panels(self) -> list[str]:
        panels = [panel for parameter in self.params if (panel := _panel_of(parameter))]
        return list(dict.fromkeys(panels)) if len(self.params) > MOST_OPTIONS else []


def _panel_of(parameter: Any) -> str | None:
    panel: str | None = getattr(parameter, "rich_help_panel", None)
    return panel
