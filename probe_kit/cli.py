"""The `probe-kit` command: registers the subcommands and turns errors into messages and exit codes.

Every package keeps its own commands, which parse, call the library and print; tables go to stdout, progress to
stderr.
"""

import gc
import re
import sys
import warnings
from functools import cache
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from probe_kit._system.escaping import terminal_safe
from probe_kit._terminal.console import markup, out, say
from probe_kit._terminal.error_reporting import report_error
from probe_kit._terminal.field_options import PanelledHelp
from probe_kit._terminal.interruption import heed_signals
from probe_kit.check_adapter.command import check_adapter
from probe_kit.demo.commands import demo
from probe_kit.diagnose.commands import diagnose
from probe_kit.doctor_command import doctor
from probe_kit.extract.commands import ask, extract
from probe_kit.extract.inspect_commands import check_environment, dataset_app, models, run_app
from probe_kit.hooks.commands import new_adapter, verify
from probe_kit.intervene.commands import KindHelp, intervene, show
from probe_kit.intervene.words_command import words
from probe_kit.retention.commands import compare, retention
from probe_kit.serve.commands import serve
from probe_kit.study.commands import app as study_app
from probe_kit.suite.commands import app as suite_app
from probe_kit.train.commands import train
from probe_kit.train.power_commands import power
from probe_kit.train.target_commands import labels, targets
from probe_kit.view.commands import RUNS_BY_NAME, view

if TYPE_CHECKING:
    from probe_kit.runs import Run

PANELS = {
    "Start": ("demo", "doctor", "models"),
    "Make runs": ("suite", "extract", "ask", "serve", "dataset", "run"),
    "Probe": ("power", "targets", "train", "labels"),
    "Is it used?": ("diagnose", "intervene", "words"),
    "Read results": ("retention", "compare", "view"),
    "A whole study from one file": ("study",),
    "Your own model or environment": ("new-adapter", "check-adapter", "check-environment", "verify"),
}
"""Commands and groups by the user's aim, in the order in which help lists them."""
_PANEL_OF = {name: panel for panel, names in PANELS.items() for name in names}

MOVED = {
    (
        "retention",
        "No such option: --compare",
    ): "`probe-kit compare RUN…` compares runs, by --kind and --reference.",
    ("run", "No such command 'list'."): "`probe-kit run show FOLDER` lists the runs of a folder.",
}
"""What took the place of an old spelling, by the command and the complaint about it."""

PARSE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]
"""The `UsageError` of click, from the copy of click that typer uses, whichever that is."""
_FOR_TYPER: tuple[type[BaseException], ...] = (
    typer.Exit, typer.Abort, typer.BadParameter.__mro__[2], BrokenPipeError
)  # fmt: skip
"""Exceptions that typer handles: an exit code, complaints about arguments, and a closed output (`head`)."""


class Commands(typer.core.TyperGroup):
    """Turns errors and interruptions of any command into messages and exit codes."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return all commands in the order of `PANELS`."""
        order = {name: number for number, name in enumerate(_PANEL_OF)}
        return sorted(super().list_commands(ctx), key=lambda name: (order.get(name, len(order)), name))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the options in front of the command; `--help` and `--version` print here."""
        try:
            return super().parse_args(ctx, args)
        except PARSE_ERROR as error:
            raise self._told_where(error, ctx) from None
        except BrokenPipeError:
            raise
        except OSError as error:  # standard output lies on a full disk
            raise typer.Exit(report_error(error)) from error

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            heed_signals()
            return self._run(ctx)
        except _FOR_TYPER:
            raise
        except (Exception, KeyboardInterrupt, SystemExit) as error:  # no caller above handles it
            if isinstance(error.__context__, BrokenPipeError):  # rich ends the process where help has no reader
                raise error.__context__ from None
            raise typer.Exit(report_error(error)) from error

    def _run(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except PARSE_ERROR as error:
            raise self._told_where(error, ctx) from None

    def _told_where(self, error: Any, ctx: Any) -> Exception:
        """Return the same error; it says where an old spelling, or an option of other commands, belongs."""
        # Only of an option that is unknown: one without its value carries its name too.
        option = error.option_name if hasattr(error, "possibilities") else None
        homes = [path for path, command in commands_of(self, ctx) if option in _options(command)]
        if moved := MOVED.get((str(error.ctx and error.ctx.info_name), str(error.message))):
            error.message, error.possibilities = f"{str(error.message).rstrip('.')}. {moved}", None
        elif homes:
            listed = ", ".join(f"`probe-kit {path}`" for path in homes)
            error.message, error.possibilities = (
                f"{option} is not an option of this command, but of {listed}.",
                None,
            )
        error.message = terminal_safe(_expected_value(str(error.message)))
        advised: Exception = error
        return advised


_PYDANTIC = (
    (r"^Value error, ", ""),
    (r"^Input should be greater than or equal to (\S+)$", r"expected at least \1"),
    (r"^Input should be less than or equal to (\S+)$", r"expected at most \1"),
    (r"^Input should be greater than (\S+)$", r"expected more than \1"),
    (r"^Input should be less than (\S+)$", r"expected less than \1"),
    (r"^Input should be a valid integer.*$", "expected a whole number"),
    (r"^Input should be a valid number.*$", "expected a number"),
    (r"^Input should be ", "expected "),
)
"""What pydantic writes about a typed value, from which typer takes it, and our words."""


def _expected_value(message: str) -> str:
    """Return the message about a typed value in the words of all other messages."""
    for pattern, replacement in _PYDANTIC:
        message = re.sub(pattern, replacement, message)
    return message


def commands_of(group: Any, ctx: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Return every command below `group` with its path, such as `suite build`."""
    commands: list[tuple[str, Any]] = []
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        path = f"{prefix}{name}"
        commands += commands_of(command, ctx, f"{path} ") if hasattr(command, "commands") else [(path, command)]
    return commands


def _options(command: Any) -> set[str]:
    return {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}


app = typer.Typer(
    cls=Commands,
    help="What does a robot policy still know, where inside it, and where on the way to the action is it lost?",
    epilog="Start with `probe-kit demo`. Exit codes: 0 done, 1 not what was asked, 2 wrong usage, 3 refused, "
    "130 interrupted; completed work is saved.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(requested: bool) -> None:
    if requested:
        from probe_kit import __version__

        out.print(f"probe-kit {__version__}")
        raise typer.Exit


@app.callback()
def _before_commands(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and stop.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Read the options in front of every command."""


def _stored_runs_of_study(name: str) -> "list[Run] | None":
    """Return the stored runs of a study file or of a study of the package; None for a run."""
    if Path(name).is_dir() or "://" in name:
        return None
    from probe_kit.study.stored import stored_runs_by_name

    return stored_runs_by_name(name)


for name, commands in (("suite", suite_app), ("run", run_app), ("study", study_app), ("dataset", dataset_app)):
    app.add_typer(commands, name=name, rich_help_panel=_PANEL_OF[name])
run_app.command()(show)
for command in (
    *(
        demo,
        doctor,
        models,
        extract,
        ask,
        serve,
        power,
        targets,
        train,
        labels,
        diagnose,
        words,
        retention,
        compare,
        view,
    ),
    *(new_adapter, check_adapter, check_environment, verify),
):
    app.command(rich_help_panel=_PANEL_OF[command.__name__.replace("_", "-")])(command)
app.command(cls=KindHelp, rich_help_panel=_PANEL_OF["intervene"])(intervene)
RUNS_BY_NAME.append(_stored_runs_of_study)
for group in (app, *(registered.typer_instance for registered in app.registered_groups)):
    for registered in group.registered_commands if group else ():
        if registered.cls is not KindHelp:
            registered.cls = PanelledHelp


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning as a note on stderr, without the place in our code where it was raised."""
    _say_warning(str(message))


@cache
def _say_warning(text: str) -> None:
    """Print a text once: Python forgets which it has shown wherever a library catches warnings."""
    say(markup("[yellow]warning:[/] {}", text))


def main() -> None:
    """Run the command of this process's arguments."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # signs that the terminal's encoding lacks are no reason to fail
            stream.reconfigure(errors="backslashreplace")
    warnings.showwarning = _show_warning
    # Python looks for cyclic garbage among all objects whenever a quarter of them is new. Imports make hundreds of
    # thousands that stay, which costs commands with a model half a second. New ones are looked at as before.
    gc.set_threshold(*gc.get_threshold()[:2], 100)
    app()
