"""`probe-kit intervene`."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
import typer.core
from rich.console import Console
from rich.panel import Panel
from rich.text import Text

from probe_kit._terminal.console import counter, marked, out, print_json_text, print_text, progress, say, split
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.interventions import Readout
from probe_kit.intervene.kinds.registry import KINDS, intervention_of

if TYPE_CHECKING:
    from probe_kit.extract import Run
    from probe_kit.intervene.replay.conditions import Intervention
    from probe_kit.intervene.replay.session import ReplaySource
    from probe_kit.intervene.results.results import InterventionResult

INSIDE = "Inside the network (what they mean to a kind is said below)"
if TYPE_CHECKING:
    type KindName = str
    type ReadoutName = str
else:  # the choices in help
    KindName = StrEnum("KindName", {name: name for name in KINDS})
    ReadoutName = StrEnum("ReadoutName", {name: name for name in get_args(Readout)})


class Style(StrEnum):
    """Format of the output."""

    TABLE = "table"
    JSON = "json"
    CSV = "csv"


class KindHelp(typer.core.TyperCommand):
    """Help with a panel for every kind."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """The options, then what each kind does and what the options mean to it."""
        super().format_help(ctx, formatter)
        for name, kind in KINDS.items():
            lines = [f"--{option.replace('_', '-')}: {meaning}" for option, meaning in kind.options.items()]
            text = Text("\n".join([kind.summary, *lines]))
            width = Console().width  # as Typer's own panels have it
            out.print(Panel(text, title=f"--kind {name}", title_align="left", border_style="dim", width=width))


def intervene(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    kind: Annotated[KindName, typer.Option(help="What is changed; see below.")] = "image-swap",
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the run.")] = None,
    items: Annotated[int | None, typer.Option(help="Items per category, the first ones; default all.")] = None,
    sites: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: backbone.*, backbone.02, expert.03@0-4, kv.*.", rich_help_panel=INSIDE
        ),
    ] = None,
    roles: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: all, image, image.left, image.right, language, state, action.",
            rich_help_panel=INSIDE,
        ),
    ] = None,
    direction: Annotated[
        str | None,
        typer.Option(
            help="none, mean-difference, probe, mean-difference:K, leace, inlp:K.", rich_help_panel=INSIDE
        ),
    ] = None,
    controls: Annotated[
        int | None,
        typer.Option(help="Matched random directions.", min=0, max=100, rich_help_panel=INSIDE),
    ] = None,
    coefficients: Annotated[
        str | None,
        typer.Option(help="Comma-separated, in half class-mean differences.", rich_help_panel=INSIDE),
    ] = None,
    target_side: Annotated[
        str | None, typer.Option(help="wrong, correct, left or right.", rich_help_panel=INSIDE)
    ] = None,
    seed: Annotated[int, typer.Option(help="Of controls and folds of directions.", rich_help_panel=INSIDE)] = 0,
    readout: Annotated[
        ReadoutName,
        typer.Option(
            help="first-chunk: what the first inference would do. per-step: what every inference of the unedited "
            "episode would (teacher-forced), for policies whose inference is one action.",
        ),
    ] = "first-chunk",
    suite: Annotated[
        Path | None, typer.Option(help="Folder of the run's suite; default the embedded one.")
    ] = None,
    checkpoint: Annotated[
        str | None, typer.Option(help="Folder or hub id the run's policy came from; default the family's.")
    ] = None,
    model_option: Annotated[
        list[str] | None, typer.Option("--model-option", "-M", help="NAME=VALUE, as given to extract; may repeat.")
    ] = None,
    weights_seed: Annotated[int, typer.Option(help="Of random weights, as given to extract.")] = 0,
    scene_file: Annotated[
        list[str] | None,
        typer.Option(help="background=FILE or arm_urdf=FILE, if the scene was made with one; may repeat."),
    ] = None,
    wording: Annotated[
        str | None, typer.Option(help="Of a run with several wordings: the one to replay; default its first.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 …")] = "cpu",
    style: Annotated[Style, typer.Option("--format", help="Of the output.")] = Style.TABLE,
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Test whether what can be read is also used: change what the policy sees or computes, and nothing else.

    Replays the first inference of every episode, or with --kind closed-loop all of
    it, and stores the result in the run, where `retention` reads it. The same
    command resumes an interrupted intervention and loads a stored one.
    """
    from probe_kit.extract import open_run
    from probe_kit.hooks.contract.options import read_pairs
    from probe_kit.intervene import ReplaySource

    opened = open_run(run, allow_partial=partial).in_wording(wording)
    common = {"categories": split(categories), "items": items, "readout": str(readout)}
    inside = {
        "sites": split(sites), "roles": split(roles), "direction": direction, "controls": controls,
        "coefficients": _numbers(coefficients), "target_side": target_side, "seed": seed or None,
    }  # fmt: skip
    given = {name: value for name, value in inside.items() if value is not None}
    intervention = intervention_of(str(kind), opened, common, given)
    files = {name: Path(str(place)) for name, place in read_pairs(scene_file or []).items()}
    source = ReplaySource(suite, checkpoint, read_pairs(model_option or []), weights_seed, device, files)
    result = _run(opened, intervention, source)
    _show(result, style)
    say(marked("stored as {}; next: [bold]probe-kit retention {}[/]", result.key, run))


def _run(run: "Run", intervention: "Intervention", source: "ReplaySource") -> "InterventionResult":
    """With progress. Says so if the result was stored before."""
    from probe_kit.intervene import run_intervention
    from probe_kit.intervene.runner import check_supported
    from probe_kit.intervene.store.answers import is_stored
    from probe_kit.intervene.store.settings import check_run_fits, key_of, settings_of

    check_run_fits(run)
    check_supported(run, intervention)
    was_stored = is_stored(run.location, key_of(settings_of(intervention, run)))
    with progress() as bar:
        fitted = counter(bar, "items fitted on") if intervention.fits_first else None
        replayed = counter(bar, "items replayed")
        result = run_intervention(run, intervention, source, progress=replayed, on_fit_progress=fitted)
    if was_stored:
        say("loaded the stored result; no model was run")
    return result


def _numbers(text: str | None) -> tuple[float, ...] | None:
    try:
        return None if text is None else tuple(map(float, split(text) or ()))
    except ValueError:
        raise UsageError(f"--coefficients is {text!r}; expected numbers such as 1,2,4") from None


def _show(result: "InterventionResult", style: Style) -> None:
    if style == Style.JSON:
        print_json_text(result.to_json())
    elif style == Style.CSV:
        print_text(result.to_csv())
    else:
        out.print(result.to_rich())
    for note in result.notes:
        say(marked("[yellow]note:[/] {}", note))
