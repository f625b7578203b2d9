"""`probe-kit dataset`: data sets of recordings."""

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from probe_kit._terminal.console import err, marked, out
from probe_kit._terminal.field_options import command_with
from probe_kit._terminal.plain_text import terminal_safe
from probe_kit.extract.parts import ActMachine, ModelSettings
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.recording import LeRobotSource

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

    from probe_kit.extract.preparation import check_recording, load_acting_policy
    from probe_kit.extract.sources.recording_source import RecordingSource

    settings = ExtractSettings.of_command({**typed, "model": model or "pi0-tiny", "dataset": folder})
    with err.status("reading the data set"):
        recording: RecordingSource = settings.source.open()  # type: ignore[assignment]  # of --dataset
        recording.check_frames()
        facts = recording.facts()
    if model is not None:
        with err.status("loading the model"):
            check_recording(settings, recording)
            recording, policy = recording.fitted(load_acting_policy(settings))
        facts |= recording.facts_of(policy)
    table = Table(show_header=False, box=None)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, marked("{}", terminal_safe(value)))
    out.print(table)
    if model is not None:
        recording.check_recorded_units(policy, settings.machine.accept_units)
