"""`probe-kit dataset`: data sets of recordings, and how a policy predicts their actions."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, marked, out, print_json, say
from probe_kit._terminal.plain_text import terminal_safe
from probe_kit.extract.recordings import options as recorded

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.extract.store.recorded.action_errors import ActionErrors

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
) -> None:
    """Show what a data set holds and how a model would be shown it. Writes nothing.

    With a model, the state of every chosen frame is compared with the statistics of the checkpoint.

    \b
    probe-kit dataset show FOLDER
    probe-kit dataset show FOLDER --model pi0 --checkpoint DIR --camera base=observation.images.top
    """
    from rich.table import Table

    from probe_kit.extract.prepared import load_acting_policy, open_recording
    from probe_kit.extract.recordings.lerobot_source import LeRobotSource
    from probe_kit.extract.rollout.recorded.described import describe_fit, describe_recording
    from probe_kit.extract.rollout.recorded.recorded_controller import fit
    from probe_kit.extract.settings import ExtractSettings

    settings = ExtractSettings.from_options(
        model=model or "pi0-tiny", checkpoint=checkpoint, options=options, dataset=folder, episodes=episodes,
        select=select, cameras=cameras, rotations=rotations, instruction=instruction,
    )  # fmt: skip
    assert isinstance(settings.source, LeRobotSource)
    with err.status("reading the data set"):
        recording = open_recording(settings.source)
        facts, warnings = describe_recording(recording), list[str]()
    if model is not None:
        with err.status("loading the model"):
            fitted, warnings = describe_fit(fit(recording, load_acting_policy(settings)))
        facts |= fitted
    table = Table(show_header=False, box=None)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, marked("{}", terminal_safe(value)))
    out.print(table)
    for warning in warnings:
        say(marked("[yellow]{}[/]", terminal_safe(warning)))


@app.command("errors")
def show_errors(run: common.RunFolder, partial: common.Partial = False, as_json: common.AsJson = False) -> None:
    """Compare the actions that a model predicted with the recorded ones.

    The errors are in standard deviations of the recorded actions at the shown frames: the mean recorded action has
    an error of 1. `--json` prints every episode too; `probe-kit labels RUN` writes the error of every frame.

    Example: `probe-kit dataset errors runs/own`
    """
    from probe_kit.extract import compare_actions, open_run

    errors = compare_actions(open_run(run, allow_partial=partial))
    if as_json:
        print_json({"run": run, "numbers": _plain(errors.by_number), "episodes": _plain(errors.by_episode)})
    else:
        _print_errors(errors)


def _plain(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The lines of a frame as JSON has them: NaN is null."""
    rows = frame.to_dict("records")
    return [{str(name): None if own != own else own for name, own in row.items()} for row in rows]


def _print_errors(errors: "ActionErrors") -> None:
    """A line per number of an action, and how the episodes differ."""
    from rich.table import Table

    episodes = errors.by_episode
    table = Table(title=f"predicted against recorded actions, {int(episodes['frames'].sum())} frames")
    for heading in ("number", "recorded deviation", "bias", "error, first action", "error, whole chunk"):
        table.add_column(heading, justify="left" if heading == "number" else "right")
    for row in _plain(errors.by_number):
        own = [row["bias"], row["first"], row["chunk"]]
        cells = ["constant" if one is None else f"{one:.2f}" for one in own]
        table.add_row(terminal_safe(row["number"]), f"{row['deviation']:.3g}", *cells)
    out.print(table)
    ordered = _plain(episodes.sort_values("first").dropna())
    span = [f"{row['first']:.2f} in episode {row['source_episode']}" for row in (ordered[:1] + ordered[-1:])]
    out.print(
        "bias and errors in recorded deviations; the mean recorded action has 1. First action: "
        f"{' to '.join(span) or 'nothing recorded'}",
        soft_wrap=True,
    )
