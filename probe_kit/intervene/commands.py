"""`probe-kit intervene`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.panel import Panel
from rich.text import Text

from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, marked, out, print_json_text, print_text, progress, say
from probe_kit._terminal.panelled_help import PanelledHelp
from probe_kit.intervene import command_options as own
from probe_kit.intervene.kinds.registry import KINDS, intervention_of

if TYPE_CHECKING:
    from probe_kit.intervene.replay.conditions import Intervention
    from probe_kit.intervene.replay.session import ReplaySource
    from probe_kit.intervene.results.results import InterventionResult
    from probe_kit.runs import Run


class KindHelp(PanelledHelp):
    """Help with the kinds; `--help-all` has a panel for each."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """The most used options, then a line per kind."""
        super().format_help(ctx, formatter)
        width = max(map(len, KINDS)) + 1
        for name, kind in KINDS.items():
            typer.echo(f" {name:{width}}{kind.summary}")
        typer.echo()

    def format_whole_help(self, ctx: Any, formatter: Any) -> None:
        """All options, then what each kind does and what the options mean to it."""
        super().format_whole_help(ctx, formatter)
        for name, kind in KINDS.items():
            lines = [f"--{option.replace('_', '-')}: {meaning}" for option, meaning in kind.options.items()]
            text = Text("\n".join([kind.summary, *lines]))
            width = Console().width  # as Typer's own panels have it
            out.print(Panel(text, title=f"--kind {name}", title_align="left", border_style="dim", width=width))


def intervene(
    run: common.RunFolder,
    kind: own.KindName = "image-swap",
    categories: common.Categories = None,
    items: common.Items = None,
    sites: own.Sites = None,
    roles: own.Roles = None,
    direction: own.Direction = None,
    controls: own.Controls = None,
    coefficients: own.Coefficients = None,
    target_side: own.TargetSide = None,
    seed: common.Seed = 0,
    readout: own.ReadoutName = "first-chunk",
    suite: common.SuiteFolder = None,
    checkpoint: own.Checkpoint = None,
    model_options: common.ModelOptions = None,
    weights_seed: own.WeightsSeed = None,
    scene_files: own.SceneFiles = None,
    wording: common.Wording = None,
    device: common.Device = "cpu",
    style: common.Format = "table",
    partial: common.Partial = False,
    details: common.WholeTable = False,
) -> None:
    """Test whether decodable information is used: change one input or activation and measure the action.

    The result is stored in the run, and `retention` reads it. Run it again to resume.

    \b
    probe-kit intervene runs/mine
    probe-kit intervene runs/mine --kind interchange --sites "backbone.*"
    """
    from probe_kit.hooks.contract.options import read_pairs
    from probe_kit.intervene import ReplaySource
    from probe_kit.runs import open_run

    opened = open_run(run, allow_partial=partial).in_wording(wording)
    of_every_kind = {"categories": categories, "items": items, "readout": readout}
    inside: dict[str, Any] = {
        "sites": sites, "roles": roles, "direction": direction, "controls": controls,
        "coefficients": coefficients, "target_side": target_side, "seed": seed or None,
    }  # fmt: skip
    given = {name: value for name, value in inside.items() if value is not None}
    intervention = intervention_of(kind, opened, of_every_kind, given)
    files = {name: Path(str(place)) for name, place in read_pairs(scene_files or []).items()}
    source = ReplaySource(suite, checkpoint, read_pairs(model_options or []), weights_seed, device, files)
    result = _run(opened, intervention, source)
    print_result(result, style, details)
    say(marked("stored as {}; next: [bold]probe-kit retention {}[/]", result.key, run))


def _run(run: "Run", intervention: "Intervention", source: "ReplaySource") -> "InterventionResult":
    """With progress. Says so if the result was stored before."""
    from probe_kit.intervene import run_intervention
    from probe_kit.intervene.edits.unread import unread_note
    from probe_kit.intervene.kinds.image_swap.verdict import groups_for_not_used
    from probe_kit.intervene.runner import check_supported, too_few_groups, unread_sites
    from probe_kit.intervene.store.answers import is_stored
    from probe_kit.intervene.store.settings import check_run_fits, key_of, settings_of

    check_run_fits(run)
    check_supported(run, intervention)
    was_stored = is_stored(run.location, key_of(settings_of(intervention, run)))
    few = {} if was_stored else too_few_groups(run, intervention)
    if few:
        counts = ", ".join(f"{name} has {count}" for name, count in few.items())
        needed = groups_for_not_used()
        say(marked("[yellow]note:[/] the verdict “not used” needs {} groups of items; {}", needed, counts))
    unread = () if was_stored else unread_sites(run, intervention)
    if unread:
        say(marked("[yellow]note:[/] {}", unread_note(unread)))
    with progress() as bar:
        fitted = counter(bar, "items fitted on") if intervention.fits_first else None
        replayed = counter(bar, "items replayed")
        result = run_intervention(run, intervention, source, progress=replayed, on_fit_progress=fitted)
    if was_stored:
        say("loaded the stored result; no model was run")
    return result


def print_result(result: "InterventionResult", style: common.Format = "table", details: bool = False) -> None:
    """Its table, the notes, and last the finding. details: print every column."""
    if style == "json":
        print_json_text(result.to_json())
    elif style == "csv":
        print_text(result.to_csv())
    else:
        out.print(result.to_rich(details))
    for note in result.notes:
        say(marked("[yellow]note:[/] {}", note))
    if style == "table":
        for sentence in result.sentences:
            out.print(sentence)
