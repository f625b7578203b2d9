"""`probe-kit diagnose`."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, err, marked, out, print_json, progress, say
from probe_kit._terminal.field_options import command_with
from probe_kit._terminal.options import further_option
from probe_kit.diagnose.choices import FRAMES, ITEMS_PER_FRAME
from probe_kit.extract import command_options as start
from probe_kit.extract.settings import ExtractSettings

if TYPE_CHECKING:
    from probe_kit.diagnose.diagnosis import Diagnosis
    from probe_kit.runs import Run

_ACTING = frozenset(
    {"model", "execute", "rotation", "no_act", "captured_calls", "later_views", "tokens", "frames", "video"}
    | {"inference_limit", "early_stop", "max_steps", "epsilon", "label", "accept_ignored_inputs"}
)
"""Options of runs that act, or store more than a diagnosis reads."""
ModelOrRun = Annotated[str, typer.Argument(metavar="MODEL|RUN", help="Model to diagnose, or folder of a run.")]
Frames = Annotated[int, typer.Option("--frames", min=6, max=1000, help="Number of frames.")]
Require = Annotated[
    common.Names | None,
    typer.Option(
        "--require",
        parser=common.Names.parse,
        metavar="A,B,…",
        help="Inputs that must matter, such as instruction,state. Default: all that vary.",
    ),
]
Paraphrases = Annotated[
    Path | None,
    further_option(
        "--paraphrases", help="CSV file with columns instruction, other: the same meaning in other words."
    ),
]
Inside = Annotated[
    bool, further_option("--inside/--no-inside", help="Patch every site, to find where an input is lost.")
]
Format = Annotated[
    Literal["table", "markdown", "json", "csv"], further_option("--format", help="Format of the output.")
]
Html = Annotated[Path | None, typer.Option("--html", help="Also write a page with a figure.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan and stop.")]


@command_with(*ExtractSettings.option_models(), offers=lambda name: name not in _ACTING)
def diagnose(
    typed: Mapping[str, Any],
    model_or_run: ModelOrRun,
    frames: Frames = FRAMES,
    require: Require = None,
    paraphrases: Paraphrases = None,
    inside: Inside = True,
    out_folder: start.OutFolder = None,
    html: Html = None,
    output_format: Format = "table",
    dry_run: DryRun = False,
) -> None:
    """Does each input reach the action, does it matter, and where is it lost?

    Varies one input and holds the others. The exit code is 1 if one does not matter.

    \b
    probe-kit diagnose pi0-tiny --categories color
    probe-kit diagnose pi0 --checkpoint DIR --dataset FOLDER --require instruction
    probe-kit diagnose runs/mine
    """
    from probe_kit.diagnose.diagnosis import diagnose_run
    from probe_kit.diagnose.paraphrases import read_paraphrases

    words = {} if paraphrases is None else read_paraphrases(paraphrases)
    run = _run_of(model_or_run, typed, frames, out_folder, dry_run)
    if run is None:
        return
    with err.status("diagnosing") as status:
        diagnosis = diagnose_run(
            run, frames=frames, inside=inside, paraphrases=words, progress=lambda text: status.update(text)
        )
    _print(diagnosis, output_format)
    if html is not None:
        from probe_kit.diagnose.page import write_page

        write_page(diagnosis, html)
        say(f"page: {html}")
    say(marked("run: [bold]{}[/]", run.location))
    raise typer.Exit(diagnosis.exit_code(require or ()))


def _run_of(
    name: str, typed: Mapping[str, Any], frames: int, out_folder: str | None, dry_run: bool
) -> "Run | None":
    """The stored run of this name, or one that is extracted now; None after a dry run."""
    from probe_kit.errors import UsageError
    from probe_kit.runs import open_run

    if "/" in name or (Path(name) / "run.json").exists():
        if typed:
            option = next(iter(typed)).replace("_", "-")
            raise UsageError(f"--{option} is a setting of a new run, and {name} is a stored one; leave it out")
        return None if dry_run else open_run(name)
    from probe_kit.extract import prepare
    from probe_kit.extract.commands import print_plan
    from probe_kit.runs.store import locate

    in_scene = not {"dataset", "env", "pictures"} & set(typed)
    captured = {"no_act": True} if in_scene else {}
    items = {"items": ITEMS_PER_FRAME * frames} if in_scene and "items" not in typed else {}
    # A policy that ignores both picture and instruction is what is looked for here.
    ignored = {"accept_ignored_inputs": True}
    settings = ExtractSettings.of_command({**typed, **items, "model": name, **captured, **ignored}, None)
    with err.status(f"loading {settings.source.loads} and model"):
        extraction = prepare(settings, out_folder, fetch=not dry_run)
    location = locate(out_folder or Path("runs") / f"diagnose-{extraction.default_name()}")
    print_plan(extraction, location)
    if dry_run:
        sites, names = extraction.plan.sites, 3
        inferences = frames * (2 + names * (2 + 2 * 3 + sites))
        say(f"about {inferences:,} inferences: {frames} frames, {names} inputs, {sites} sites")
        return None
    with progress() as bar:
        return extraction.run(location, progress=counter(bar, "episodes"))


def _print(diagnosis: "Diagnosis", output_format: str) -> None:
    from probe_kit.diagnose.sentences import diagnosis_table

    table = diagnosis_table(diagnosis)
    if output_format == "json":
        print_json(diagnosis.to_json())
    elif output_format == "table":
        out.print(table)
    else:
        out.print(table.to_markdown() if output_format == "markdown" else table.to_csv(), markup=False)
