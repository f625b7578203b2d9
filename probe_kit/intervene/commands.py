"""`probe-kit intervene`. The meaning of an option to a kind is in the kind's file."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.panel import Panel
from rich.text import Text

from probe_kit._tables.printing import Format, print_table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, marked, out, progress, say, say_note, split
from probe_kit._terminal.field_options import PanelledHelp, command_with
from probe_kit._terminal.options import LISTED, Names, choices, further_option, one_of
from probe_kit.errors import UsageError
from probe_kit.extract.config_files import MovedOptions, moved_of
from probe_kit.hooks.contract.declared import Readout
from probe_kit.intervene.kinds import every_kind, kind_names, kind_of
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit.intervene.kinds.base import Intervention
    from probe_kit.intervene.results.results import InterventionResult
    from probe_kit.intervene.sessions.session import ReplaySource
    from probe_kit.runs import Run


_inside_option = partial(typer.Option, rich_help_panel="Inside the network")


class Numbers(tuple[float, ...]):
    """Comma-separated numbers."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Numbers") -> "Numbers":
        """The numbers of `text`; a default that is no text is returned as it is. Raises UsageError."""
        if not isinstance(text, str):
            return text
        try:
            return cls(map(float, split(text) or ()))
        except ValueError:
            raise UsageError(f"--coefficients is {text!r}; expected numbers such as 1,2,4") from None


KindName = Annotated[
    str,
    typer.Option(
        "--kind",
        parser=one_of(kind_names()),
        metavar=choices(kind_names()),
        help="Kind of intervention; see below.",
    ),
]
Checkpoint = Annotated[
    str | None,
    typer.Option(
        "--checkpoint", help="Checkpoint folder or Hugging Face id, OWNER/NAME[@REVISION]. Default: the run's."
    ),
]
Sites = Annotated[
    Names | None,
    _inside_option(
        "--sites",
        **LISTED,
        help="Sites, comma-separated: backbone.*, backbone.02, expert.03@0-4, backbone.02.heads.* or kv.*.",
    ),
]
Roles = Annotated[
    Names | None,
    _inside_option(
        "--roles",
        **LISTED,
        help="Token roles, comma-separated: all, image, image.left, image.right, language, state, action.",
    ),
]
Direction = Annotated[
    str | None,
    _inside_option(
        "--direction",
        help="Direction or subspace: none, mean-difference, probe, mean-difference:K, leace, inlp:K, or FILE#NAME "
        "of a safetensors or npz file.",
    ),
]
Controls = Annotated[
    int | None, _inside_option("--controls", help="Number of matched random directions.", min=0, max=100)
]
Coefficients = Annotated[
    Numbers | None,
    _inside_option(
        "--coefficients",
        parser=Numbers.parse,
        metavar="1,2,…",
        help="Coefficients, comma-separated, in half class-mean differences.",
    ),
]
TargetSide = Annotated[
    str | None, _inside_option("--target-side", help="Target side: wrong, correct, left or right.")
]
_pairs_option = partial(typer.Option, rich_help_panel="Recordings and your own environment")
Vary = Annotated[
    str | None,
    _pairs_option(
        "--vary",
        metavar="INPUT",
        help="Input that the source has of another frame: instruction, picture, picture.CAMERA or state.",
    ),
]
FramesEach = Annotated[
    int | None, _pairs_option("--frames", help="Frames of each episode, evenly spaced. Default: 4.", min=1)
]
PairTable = Annotated[
    Path | None,
    _pairs_option(
        "--pairs",
        metavar="FILE",
        help="Table of pairs of your own, with the columns episode, frame, donor_episode, donor_frame.",
    ),
]
ReadoutName = Annotated[
    Readout,
    further_option(
        "--readout",
        help="first-chunk: measure the first inference. per-step: measure every inference along the unedited "
        "episode (teacher-forced), for policies with one action per inference.",
    ),
]
WeightsSeed = Annotated[
    int | None, further_option("--weights-seed", help="Seed of the untrained weights. Default: that of the run.")
]


class KindHelp(PanelledHelp):
    """Help with the kinds; `--help-all` has a panel for each."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """The most used options, then a line per kind."""
        super().format_help(ctx, formatter)
        kinds = every_kind()
        width = max(len(kind.kind) for kind in kinds) + 1
        for kind in kinds:
            typer.echo(f" {kind.kind:{width}}{kind.summary}")
        typer.echo()

    def format_whole_help(self, ctx: Any, formatter: Any) -> None:
        """All options, then what each kind does and what the options mean to it."""
        super().format_whole_help(ctx, formatter)
        for kind in every_kind():
            lines = [f"--{option.replace('_', '-')}: {meaning}" for option, meaning in kind.options.items()]
            text = Text("\n".join([kind.summary, *lines]))
            width = Console().width  # as Typer's own panels have it
            out.print(
                Panel(text, title=f"--kind {kind.kind}", title_align="left", border_style="dim", width=width)
            )


@command_with(MovedOptions)
def intervene(
    typed: Mapping[str, Any],
    run: common.RunFolder,
    kind: KindName = "image-swap",
    categories: common.Categories = None,
    items: common.Items = None,
    sites: Sites = None,
    roles: Roles = None,
    direction: Direction = None,
    controls: Controls = None,
    coefficients: Coefficients = None,
    target_side: TargetSide = None,
    seed: common.Seed = 0,
    readout: ReadoutName = "first-chunk",
    suite: common.SuiteFolder = None,
    checkpoint: Checkpoint = None,
    model_options: common.ModelOptions = None,
    weights_seed: WeightsSeed = None,
    vary: Vary = None,
    frames: FramesEach = None,
    pairs: PairTable = None,
    wording: common.Wording = None,
    device: common.Device = "cpu",
    style: Format = "table",
    partial: common.Partial = False,
    details: common.WholeTable = False,
) -> None:
    """Test whether decodable information is used: change one input or activation and measure the action.

    The result is stored in the run, and `retention` reads it. Run it again to resume.

    \b
    probe-kit intervene runs/mine
    probe-kit intervene runs/mine --kind interchange --sites "backbone.*"
    """
    from probe_kit.hooks.contract.declared import read_pairs as read_options
    from probe_kit.intervene import ReplaySource
    from probe_kit.intervene.pairs import read_pairs
    from probe_kit.runs import open_run

    opened = open_run(run, allow_partial=partial).in_wording(wording)
    of_every_kind: dict[str, Any] = {
        "categories": categories, "items": items, "readout": readout, "vary": vary or "", "frames": frames,
        "pairs": () if pairs is None else read_pairs(pairs),
    }  # fmt: skip
    inside: dict[str, Any] = {
        "sites": sites, "roles": roles, "direction": direction, "controls": controls,
        "coefficients": coefficients, "target_side": target_side, "seed": seed or None,
    }  # fmt: skip
    kind_options = {name: value for name, value in inside.items() if value is not None}
    check_options(kind, kind_options)
    intervention = kind_of(kind).from_options(opened, **of_every_kind, **kind_options)
    intervention.check_run(opened)
    source = ReplaySource(
        suite, checkpoint, read_options(model_options or []), weights_seed, device, moved_of(opened, typed)
    )
    result = _run(opened, intervention, source)
    print_result(result, style, details)
    if style == "table":
        following = "retention {}[/]  use beside probes and success"
        following = following if result.outcomes.has_sides else "run show {}[/]  what the run stores"
        say(marked(f"next: [bold]probe-kit {following}", run))
    say(marked("stored as {}", result.key))


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that does not apply to a kind. options: by name, of the command line."""
    for option in options:
        if option not in kind_of(name).options:
            kinds = [kind.kind for kind in every_kind() if option in kind.options]
            raise UsageError(
                f"--{option.replace('_', '-')} does not apply to --kind {name}; remove it or choose another "
                f"kind: {', '.join(kinds)}"
            )


def _run(run: "Run", intervention: "Intervention", source: "ReplaySource") -> "InterventionResult":
    """Run an intervention with progress; print a line if its result was stored before."""
    from probe_kit.intervene import run_intervention
    from probe_kit.intervene.outcomes import is_stored
    from probe_kit.intervene.places import unread_note
    from probe_kit.intervene.runner import check_supported, too_few_groups, unread_sites
    from probe_kit.intervene.settings import check_run_fits, key_of, settings_of
    from probe_kit.statistics.sufficiency import groups_for_not_used

    check_run_fits(run)
    check_supported(run, intervention)
    was_stored = is_stored(run.location, key_of(settings_of(intervention, run)))
    few = {} if was_stored else too_few_groups(run, intervention)
    if few:
        counts = ", ".join(f"{category_of(name).title} has {count}" for name, count in few.items())
        needed = groups_for_not_used()
        say_note(f"“not used” needs {needed} groups of items and cannot be found: {counts}. Extract more items.")
    unread = () if was_stored else unread_sites(run, intervention)
    if unread:
        say_note(unread_note(unread))
    with progress() as bar:
        fitted = counter(bar, "items fitted on") if intervention.fits_first else None
        replayed = counter(bar, "items replayed")
        result = run_intervention(run, intervention, source, progress=replayed, on_fit_progress=fitted)
    if was_stored:
        say("loaded the stored result; no model was run")
    return result


def print_result(result: "InterventionResult", style: str = "table", details: bool = False) -> None:
    """Its table, the notes, and last the finding. details: print every column."""
    # JSON and CSV hold the numbers of all rows, the other formats the table.
    print_table(result if style in ("json", "csv") else result.to_rich(details), style, result.notes)
    if style == "table":
        for sentence in result.sentences if details else result.findings:
            out.print(sentence)
