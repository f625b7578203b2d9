"""`probe-kit intervene`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit.console import counter, marked, out, print_json_text, print_text, progress, say, split
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.intervene.effects import Effects

KINDS = {"follow": "the two pictures exchanged, same state and noise"}
_FORMATS = ("table", "json", "csv")


def intervene(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    kind: Annotated[
        str, typer.Option(help="follow: with the two pictures exchanged, does the action change sides?")
    ] = "follow",
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the run.")] = None,
    items: Annotated[int | None, typer.Option(help="Items per category, the first ones; default all.")] = None,
    suite: Annotated[
        Path | None, typer.Option(help="Folder of the run's suite; default the embedded one.")
    ] = None,
    checkpoint: Annotated[
        str | None, typer.Option(help="Folder or hub id the run's policy came from; default the family's.")
    ] = None,
    model_option: Annotated[
        list[str] | None, typer.Option("--model-option", "-M", help="NAME=VALUE, as given to extract; may repeat.")
    ] = None,
    weights_seed: Annotated[int, typer.Option(help="Of a random twin's weights, as given to extract.")] = 0,
    scene_file: Annotated[
        list[str] | None,
        typer.Option(help="background=FILE or arm_urdf=FILE, if the scene was made with one; may repeat."),
    ] = None,
    wording: Annotated[
        str | None, typer.Option(help="Of a run with several wordings: the one to replay; default its first.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 …")] = "cpu",
    style: Annotated[str, typer.Option("--format", help="table, json or csv.")] = "table",
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Change what the policy sees, and nothing else: is what can be read also used?

    Replays the first inference of every episode and stores what came of it in the run, where `retention` shows it.
    The same command continues what was interrupted, and reads back what is there.
    """
    from probe_kit.extract import open_run
    from probe_kit.hooks.options import read_pairs
    from probe_kit.intervene import Follow, Source, intervene_on
    from probe_kit.intervene.settings import refuse_unfit

    if kind not in KINDS:
        raise UsageError(f"unknown kind {kind!r}; expected one of {', '.join(KINDS)}")
    if style not in _FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(_FORMATS)}")
    opened = open_run(run, allow_partial=partial).in_wording(wording)
    asked = Follow(categories=split(categories), items=items)
    refuse_unfit(opened)
    asked.chosen(opened)
    files = {name: Path(str(place)) for name, place in read_pairs(scene_file or []).items()}
    source = Source(suite, checkpoint, read_pairs(model_option or []), weights_seed, device, files)
    with progress() as bar:
        effects = intervene_on(opened, asked, source, progress=counter(bar, "items replayed"))
    _show(effects, style)
    say(marked("stored as {}; next: [bold]probe-kit retention {}[/]", effects.key, run))


def _show(effects: "Effects", style: str) -> None:
    if style == "json":
        print_json_text(effects.to_json())
    elif style == "csv":
        print_text(effects.to_csv())
    else:
        out.print(effects.to_rich())
    for note in effects.notes:
        say(marked("[yellow]note:[/] {}", note))
