"""The `probe-kit` command: what it is made of, and what becomes of errors.

Every package keeps its own commands, which parse, call the library and print; tables go to stdout, progress to
stderr.
"""

import signal
from typing import Any

import typer
import typer.core
from click import NoSuchOption
from rich.markup import escape

from probe_kit.commands import demo, doctor
from probe_kit.console import err
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.extract.commands import MOVED, extract
from probe_kit.extract.model_commands import models
from probe_kit.extract.run_commands import app as run_app
from probe_kit.extract.run_commands import export
from probe_kit.hooks.commands import verify
from probe_kit.retention.commands import retention
from probe_kit.suite.commands import app as suite_app
from probe_kit.train.commands import show, train

INTERRUPTED = 130


class Commands(typer.core.TyperGroup):
    """Turns errors and interruptions of any command into messages and exit codes."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except NoSuchOption as error:
            if error.option_name in MOVED:
                raise UsageError(f"{error.option_name} is now {MOVED[error.option_name]}") from None
            raise
        except KeyboardInterrupt:
            err.print("[yellow]interrupted[/]; everything finished so far is kept, the same command continues")
            raise typer.Exit(INTERRUPTED) from None
        except ProbeKitError as error:
            err.print(
                f"[bold red]{type(error).__name__}[/]: {escape(str(error))}", highlight=False, soft_wrap=True
            )
            for note in getattr(error, "__notes__", []):
                err.print(f"  {escape(note)}", highlight=False, soft_wrap=True)
            raise typer.Exit(error.exit_code) from error
        except _PATH_ERRORS as error:
            if error.filename is None:
                raise
            err.print(
                f"[bold red]{UsageError.__name__}[/]: {escape(_path_message(error))}",
                highlight=False,
                soft_wrap=True,
            )
            raise typer.Exit(UsageError.exit_code) from error


_PATH_ERRORS = (FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)
"""What the system says of a path that cannot be what it was given for."""


def _path_message(error: OSError) -> str:
    return f"{error.filename2 or error.filename} cannot be used: {error.strerror}. Give another path"


app = typer.Typer(
    cls=Commands,
    help="What does a robot policy still know, where inside it, and where on the way to the action is it lost?",
    epilog="Start with `probe-kit demo`. Exit codes: 0 done, 1 not what was asked, 2 wrong usage, 3 refused, "
    "130 interrupted with everything finished so far kept.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(suite_app, name="suite")
app.add_typer(run_app, name="run")
run_app.command()(show)
for command in (extract, export, demo, models, verify, train, retention, doctor):
    app.command()(command)


def main() -> None:
    """Entry point; a SIGTERM counts as Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    app()
