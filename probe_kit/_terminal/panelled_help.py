"""Help by panel: of a command with many options `--help` prints the most used ones, `--help-all` all."""

from typing import Any

import typer
import typer.core

MOST_OPTIONS = 12
"""A command with more options than this prints its further panels with `--help-all` only."""
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
        """All options, or the most used ones while `--help` prints them."""
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
            super().format_help(ctx, formatter)
        finally:
            ctx.meta[_MAIN_ONLY] = False
        if panels:
            typer.echo(f" Further options, with {HELP_ALL}: {', '.join(panels)}.\n")

    def format_whole_help(self, ctx: Any, formatter: Any) -> None:
        """Print all panels."""
        super().format_help(ctx, formatter)

    def _further_panels(self) -> list[str]:
        panels = [panel for parameter in self.params if (panel := _panel_of(parameter))]
        return list(dict.fromkeys(panels)) if len(self.params) > MOST_OPTIONS else []


def _panel_of(parameter: Any) -> str | None:
    panel: str | None = getattr(parameter, "rich_help_panel", None)
    return panel
