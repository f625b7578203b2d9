"""`probe-kit dataset`: data sets of recordings."""

from typing import Annotated

import typer

from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, marked, out
from probe_kit._terminal.plain_text import terminal_safe
from probe_kit.extract.command_options import AcceptUnits
from probe_kit.extract.recordings import options as recorded

app = typer.Typer(help="Inspect data sets of recordings.", no_args_is_help=True)


@app.command("show")
def show_dataset(
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="A LeRobotDataset, or USER/NAME@COMMIT of the hub.")
    ],
    model: Annotated[str | None, typer.Option("--model", help="Compare with the inputs of this model.")] = None,
    checkpoint: common.Checkpoint = None,
    options: common.ModelOptions = None,
    episodes: recorded.Episodes = None,
    select: recorded.Select = None,
    cameras: recorded.Cameras = None,
    rotations: recorded.Rotations = None,
    instruction: recorded.Instruction = None,
    accept_units: AcceptUnits = False,
) -> None:
    """Show what a data set holds and how a model would be shown it. Writes nothing.

    Files, numbers and videos of the chosen episodes are checked. With a model, the state of every chosen frame is
    compared with the statistics of the checkpoint. What `extract` refuses is an error here too.

    \b
    probe-kit dataset show FOLDER
    probe-kit dataset show FOLDER --model pi0 --checkpoint DIR --camera base=observation.images.top
    """
    from rich.table import Table

    from probe_kit.extract.prepared import check_recording, load_acting_policy, open_recording
    from probe_kit.extract.recordings.lerobot_source import LeRobotSource
    from probe_kit.extract.rollout.recorded.described import describe_fit, describe_recording
    from probe_kit.extract.rollout.recorded.recorded_controller import check_recorded_units, fit
    from probe_kit.extract.settings import ExtractSettings

    settings = ExtractSettings.from_options(
        model=model or "pi0-tiny", checkpoint=checkpoint, options=options, dataset=folder, episodes=episodes,
        select=select, cameras=cameras, rotations=rotations, instruction=instruction,
        accept_units=accept_units,
    )  # fmt: skip
    assert isinstance(settings.source, LeRobotSource)
    with err.status("reading the data set"):
        recording = open_recording(settings.source)
        recording.check()
        facts, fitted = describe_recording(recording), None
    if model is not None:
        with err.status("loading the model"):
            check_recording(settings, recording)
            fitted = fit(recording, load_acting_policy(settings))
        facts |= describe_fit(fitted)
    table = Table(show_header=False, box=None)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, marked("{}", terminal_safe(value)))
    out.print(table)
    if fitted is not None:
        check_recorded_units(fitted, accept_units)
