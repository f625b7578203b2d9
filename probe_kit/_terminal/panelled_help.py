"""Help by panel: of a command with many options `--help` prints the most used ones, `--help-all` all."""

from collections.abc import Iterator
from typing import Any

import typer
import typer.core

from probe_kit.errors import UsageError

MOST_OPTIONS = 12
"""A command with more options than this prints its further panels with `--help-all` only."""
HELP_ALL = "--help-all"
_MAIN_ONLY = "probe_kit.main_options_only"


class PanelledHelp(typer.core.TyperCommand):
    """A command whose most used options are those without a `rich_help_panel`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments; `--help-all` among them prints every panel and ends the command.

        Raises UsageError for an option of one value that is given twice, of which click would take the last.
        """
        if HELP_ALL in args and not ctx.resilient_parsing:
            self.format_whole_help(ctx, ctx.make_formatter())
            ctx.exit()
        if not ctx.resilient_parsing:
            self._check_doubles(args)
        return super().parse_args(ctx, args)

    def _check_doubles(self, args: list[str]) -> None:
        for option in self.params:
            takes_one = option.param_type_name == "option" and option.nargs == 1
            if not takes_one or option.multiple or option.is_flag or option.count:  # type: ignore[attr-defined]
                continue
            values = list(_values_of(option.opts, args))
            if len(values) > 1:
                raise UsageError(
                    f"{option.opts[0]} is given twice, {values[0]!r} and {values[1]!r}; this command takes one. "
                    "Leave one out"
                )

    def get_params(self, ctx: Any) -> list[Any]:
        """All options, or the most used ones while `--help` prints them."""
        found = super().get_params(ctx)
        return [one for one in found if not _panel_of(one)] if ctx.meta.get(_MAIN_ONLY) else found

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the most used options, and the names of the further panels."""
        further = self._further_panels()
        ctx.meta[_MAIN_ONLY] = bool(further)
        try:
            super().format_help(ctx, formatter)
        finally:
            ctx.meta[_MAIN_ONLY] = False
        if further:
            typer.echo(f" Further options, with {HELP_ALL}: {', '.join(further)}.\n")

    def format_whole_help(self, ctx: Any, formatter: Any) -> None:
        """Print all panels."""
        super().format_help(ctx, formatter)

    def _further_panels(self) -> list[str]:
        panels = [panel for one in self.params if (panel := _panel_of(one))]
        return list(dict.fromkeys(panels)) if len(self.params) > MOST_OPTIONS else []


def _values_of(names: list[str], args: list[str]) -> Iterator[str]:
    """The values of an option in the order in which they are given, as `--name VALUE` or `--name=VALUE`."""
    for at, arg in enumerate(args):
        name, equals, value = arg.partition("=")
        if name not in names:
            continue
        if equals:
            yield value
        elif at + 1 < len(args):
            yield args[at + 1]


def _panel_of(parameter: Any) -> str | None:
    panel: str | None = getattr(parameter, "rich_help_panel", None)
    return panel
