"""`probe-kit dataset show` and `probe-kit check-environment`: sources of observations before they are shown."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.escaping import terminal_safe
from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, marked, out, print_json, say
from probe_kit._terminal.field_options import command_with
from probe_kit.extract.parts import ActMachine, ModelSettings
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.environment import EnvOptions
from probe_kit.extract.sources.recording import LeRobotSource

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

FAILED = 1
_OFFERED = {
    "checkpoint", "model_option", "episodes", "select", "camera", "rotate", "instruction", "accept_units",
}  # fmt: skip
app = typer.Typer(help="Inspect data sets of recordings.", no_args_is_help=True)


@app.command("show")
@command_with(ModelSettings, ActMachine, LeRobotSource, offers=_OFFERED.__contains__)
def show_dataset(
    typed: Mapping[str, Any],
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="A LeRobotDataset, or USER/NAME@COMMIT of the hub.")
    ],
    model: Annotated[str | None, typer.Option("--model", help="Compare with the inputs of this model.")] = None,
) -> None:
    """Show what a data set holds and how a model would be shown it. Writes nothing.

    Files, numbers and videos of the chosen episodes are checked. With a model, the state of every chosen frame is
    compared with the statistics of the checkpoint. What `extract` refuses is an error here too.

    \b
    probe-kit dataset show FOLDER
    probe-kit dataset show FOLDER --model pi0 --checkpoint DIR --camera base=observation.images.top
    """
    from rich.table import Table

    from probe_kit.extract.preparation import check_unloaded
    from probe_kit.extract.rollout.task import task_of
    from probe_kit.extract.sources.recording_source import RecordingSource

    settings = ExtractSettings.of_command({**typed, "model": model or "pi0-tiny", "dataset": folder})
    with err.status("reading the data set"):
        recording: RecordingSource = settings.source.open()  # type: ignore[assignment]  # of --dataset
        recording.check_frames()
        facts = recording.facts()
    if model is not None:
        with err.status("loading the model"):
            check_unloaded(settings, recording)
            policy: Policy = task_of(settings).load(settings)  # type: ignore[assignment]  # scripts were refused
            recording, policy = recording.fitted(policy)
        facts |= recording.facts_of(policy)
    table = Table(show_header=False, box=None)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, marked("{}", terminal_safe(value)))
    out.print(table)
    if model is not None:
        recording.check_recorded_units(policy, settings.machine.accept_units)


def check_environment(
    environment: Annotated[
        str,
        typer.Argument(metavar="MODULE:CLASS", help="Your environment, or lerobot:TYPE such as lerobot:libero."),
    ],
    env_options: EnvOptions = None,
    as_json: common.AsJson = False,
) -> None:
    """Check an environment of your own against its contract, without a model.

    Two episodes of five actions are played, twice. Each check is one line: passed or failed, and the promise that
    is checked. A failure says what was seen and what was expected.

    Example: `probe-kit check-environment kitchen:Kitchen`

    Exits with 1 if a check failed.
    """
    from probe_kit.extract import EnvSource
    from probe_kit.extract import check_environment as checks_of

    source = EnvSource(environment, options=env_options or ())
    checks = []
    for check in checks_of(source):
        checks.append(check)
        if not as_json:
            state, colour = ("passed", "green") if check.passed else ("failed", "bold red")
            out.print(marked(f"[{colour}]{{}}[/] {{}}", f"{state:8}", check.sentence), soft_wrap=True)
            if check.problem:
                out.print(marked("         [dim]seen[/] {}", terminal_safe(check.problem)), soft_wrap=True)
    failed = sum(not check.passed for check in checks)
    if as_json:
        listed = [{**asdict(check), "passed": check.passed} for check in checks]
        print_json({"environment": environment, "passed": not failed, "checks": listed})
    elif failed:
        out.print(f"{len(checks) - failed} passed, {failed} failed")
    else:
        out.print(f"{len(checks)} passed")
        say(marked("next: [bold]probe-kit extract --model NAME --env {}[/] --out runs/own", environment))
    raise typer.Exit(FAILED if failed else 0)
