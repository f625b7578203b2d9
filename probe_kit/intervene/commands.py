"""The commands `probe-kit intervene` and `run show`.

The meaning of an option for a kind is in the kind's file.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.panel import Panel
from rich.text import Text

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._tables.numbers import whole_percent
from probe_kit._tables.printing import Format, print_table
from probe_kit._tables.table import Cell, Table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, markup, out, print_json, progress, say, say_note, split
from probe_kit._terminal.field_options import PanelledHelp, command_with
from probe_kit._terminal.options import (
    LISTED,
    AsJson,
    Names,
    Partial,
    check_no_others,
    choices,
    further_option,
    one_of,
)
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.extract.config_files import MovedOptions, moved_of
from probe_kit.hooks.contract.declared import Readout
from probe_kit.hooks.contract.declared import read_pairs as read_options
from probe_kit.intervene.kinds import every_kind, kind_names, kind_of
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.hooks.contract.sites import Stream
    from probe_kit.intervene.kinds.base import Intervention
    from probe_kit.intervene.results import InterventionResult
    from probe_kit.intervene.sessions import ReplayFiles
    from probe_kit.runs import Run


_inside_option = partial(typer.Option, rich_help_panel="Inside the network")


class Numbers(tuple[float, ...]):
    """A tuple of numbers that are given as comma-separated text."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Numbers") -> "Numbers":
        """Return the numbers of `text`; a default that is no text is returned as it is.

        Raises:
            UsageError: If a part of the text is no number.
        """
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
        help="Token roles, comma-separated: all, image, image.left, image.right, language, state, action. Of "
        "a knockout also kv.02.",
    ),
]
Direction = Annotated[
    str | None,
    _inside_option(
        "--direction",
        help="Direction or subspace that is changed: none, mean-difference, probe, mean-difference:K, leace, "
        "inlp:K, or FILE#NAME of a safetensors or npz file.",
    ),
]
Controls = Annotated[
    int | None,
    _inside_option(
        "--controls",
        help="Number of random controls: directions of the same size; of a knockout, cuts of random tokens; of "
        "an attribution, further places.",
        min=0,
        max=100,
    ),
]
Coefficients = Annotated[
    Numbers | None,
    _inside_option(
        "--coefficients",
        parser=Numbers.parse,
        metavar="1,2,…",
        help="Strengths of steering, comma-separated. 1 is half the difference of the class means, or the length "
        "of a file's vector.",
    ),
]
TargetSide = Annotated[
    str | None, _inside_option("--target-side", help="Side to steer toward: wrong, correct, left or right.")
]
Window = Annotated[
    str | None,
    _inside_option(
        "--window",
        metavar="WINDOW",
        help="Layers that a knockout cuts together. first: from the first layer to each. last: from each to the "
        "last. both: first and last (default). N: every N neighbouring layers.",
    ),
]
Readers = Annotated[
    str | None,
    _inside_option(
        "--readers",
        metavar="ROLE",
        help="Of a knockout: role of backbone tokens that can no longer read. "
        "Default: the action stream can no longer read.",
    ),
]
Heads = Annotated[
    Names | None,
    _inside_option(
        "--heads",
        **LISTED,
        help="Of a knockout: attention heads that are cut, counted from 0, such as 0,3. Default: all.",
    ),
]
ClosedLoopCut = Annotated[
    bool,
    _inside_option(
        "--closed-loop",
        help="Play whole episodes with the cut of a knockout at every inference, and show success rates.",
    ),
]
Untrained = Annotated[
    Path | None,
    _inside_option(
        "--untrained",
        metavar="RUN",
        help="Of a knockout: run of the same episodes with random weights. The same knockout must be stored "
        "there; it is shown beside this one.",
    ),
]
_pairs_option = partial(typer.Option, rich_help_panel="Recordings and your own environment")
Vary = Annotated[
    str | None,
    _pairs_option(
        "--vary",
        metavar="INPUT",
        help="Input that is taken from another frame: instruction, picture, picture.CAMERA or state.",
    ),
]
FramesEach = Annotated[
    int | None, _pairs_option("--frames", help="Number of frames per episode, evenly spaced. Default: 4.", min=1)
]
PairTable = Annotated[
    Path | None,
    _pairs_option(
        "--pairs",
        metavar="FILE",
        help="Your own pairs of frames to exchange: a table with the columns episode, frame, donor_episode, "
        "donor_frame.",
    ),
]
Instructions = Annotated[
    Path | None,
    _pairs_option(
        "--instructions",
        metavar="FILE",
        help="Instructions of other tasks, for a data set with a single task: one per line, or a table with a "
        "column instruction.",
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
        """Print the most used options, then a line per kind."""
        super().format_help(ctx, formatter)
        kinds = every_kind()
        width = max(len(kind.kind) for kind in kinds) + 1
        for kind in kinds:
            typer.echo(f" {kind.kind:{width}}{kind.summary}")
        typer.echo()

    def format_whole_help(self, ctx: Any, formatter: Any) -> None:
        """Print all options, then what each kind does and what the options mean to it."""
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
    window: Window = None,
    readers: Readers = None,
    heads: Heads = None,
    closed_loop: ClosedLoopCut = False,
    untrained: Untrained = None,
    seed: common.Seed = 0,
    readout: ReadoutName = "first-chunk",
    suite: common.SuiteFolder = None,
    checkpoint: Checkpoint = None,
    model_options: common.ModelOptions = None,
    weights_seed: WeightsSeed = None,
    vary: Vary = None,
    frames: FramesEach = None,
    pairs: PairTable = None,
    instructions: Instructions = None,
    wording: common.Wording = None,
    device: common.Device = "auto",
    style: Format = "table",
    partial: common.Partial = False,
    details: common.WholeTable = False,
) -> None:
    """Test whether decodable information is used: change one input or activation and measure the action.

    The result is stored in the run, and `retention` reads it. Run it again to resume.

    \b
    probe-kit intervene runs/mine
    probe-kit intervene runs/mine --kind interchange --sites "backbone.*"
    """  # noqa: D301 - click reads the \b
    from probe_kit.intervene import ReplayFiles
    from probe_kit.intervene.further_instructions import read_instructions
    from probe_kit.intervene.pairs import read_pairs
    from probe_kit.runs import open_run

    opened = open_run(run, allow_partial=partial).in_wording(wording)
    of_every_kind: dict[str, Any] = {
        "categories": categories, "items": items, "readout": readout, "vary": vary or "", "frames": frames,
        "pairs": () if pairs is None else read_pairs(pairs),
        "instructions": () if instructions is None else read_instructions(instructions),
    }  # fmt: skip
    inside: dict[str, Any] = {
        "sites": sites, "roles": roles, "direction": direction, "controls": controls,
        # Seed 0 is the default of every kind, and no kind without a seed refuses it.
        "coefficients": coefficients, "target_side": target_side, "seed": seed or None,
        "window": window, "readers": readers, "heads": heads, "closed_loop": closed_loop or None,
        "untrained": untrained,
    }  # fmt: skip
    kind_options = {name: value for name, value in inside.items() if value is not None}
    check_options(kind, kind_options)
    intervention = kind_of(kind).from_options(opened, **of_every_kind, **kind_options)
    source = ReplayFiles(
        suite, checkpoint, read_options(model_options or []), weights_seed, device, moved_of(opened, typed)
    )
    result = _run(opened, intervention, source)
    print_result(result, style, details)
    if style == "table":
        is_scene = result.outcomes.is_scene
        location = as_argument(run)
        following = f"retention {location}" if is_scene else f"run show {location}"
        what = "use beside probes and success" if is_scene else "what the run stores"
        say(markup("next: [bold]probe-kit {}[/]  {}", following, what))
    say(markup("stored as {}", result.key))


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Refuse an option that does not apply to a kind.

    Args:
        name: Name of the kind.
        options: Options of the command line, by name.

    Raises:
        UsageError: For an option that does not apply to the kind.
    """
    for option in options:
        if option not in kind_of(name).options:
            kinds = [kind.kind for kind in every_kind() if option in kind.options]
            raise UsageError(
                f"--{option.replace('_', '-')} does not apply to --kind {name}; remove it or choose another "
                f"kind: {', '.join(kinds)}"
            )


def _run(run: "Run", intervention: "Intervention", source: "ReplayFiles") -> "InterventionResult":
    """Run an intervention with progress; print a line if its result was stored before."""
    from probe_kit.intervene import run_intervention
    from probe_kit.intervene.runner import check_intervention, too_few_groups
    from probe_kit.intervene.settings import key_of, settings_of
    from probe_kit.intervene.stored import is_stored
    from probe_kit.statistics.sufficiency import groups_for_not_used

    check_intervention(run, intervention)
    was_stored = is_stored(run.location, key_of(settings_of(intervention, run)))
    few = {} if was_stored else too_few_groups(run, intervention)
    if few:
        counts = ", ".join(f"{category_of(name).title} has {count}" for name, count in few.items())
        needed = groups_for_not_used()
        say_note(f"“not used” needs {needed} groups of items and cannot be found: {counts}. Extract more items.")
    with progress() as bar:
        fitted = counter(bar, "items fitted on") if intervention.fits_first else None
        replayed = counter(bar, "items replayed")
        result = run_intervention(
            run, intervention, source, progress=replayed, on_fit_progress=fitted, on_note=say_note
        )
    if was_stored:
        say("loaded the stored result; no model was run")
    return result


def print_result(result: "InterventionResult", style: str = "table", details: bool = False) -> None:
    """Print the result's table, its notes, and last the finding.

    Args:
        result: Result of an intervention.
        style: Format of the table, such as `table`, `json` or `csv`.
        details: Whether to print every column, and sentences with numbers.
    """
    # JSON and CSV hold the numbers of all rows, the other formats the table.
    print_table(result if style in ("json", "csv") else result.to_rich(details), style, result.notes)
    if style == "table":
        for sentence in result.sentences if details else result.findings:
            out.print(sentence)


# -- runs, and what they store -------------------------------------------------------------------------------

_COLUMNS = ("run", "model", "suite", "episodes", "correct", "probes", "interventions")
"""Names of the facts that are shown."""


def _list_runs(folder: Path, paths: Sequence[Path], as_json: bool) -> None:
    """Print the runs below a folder. A run that cannot be read is named with the reason."""
    from probe_kit.runs import open_run

    lines: list[dict[str, Any]] = []
    for path in paths:
        name = str(path.relative_to(folder))
        try:
            lines.append({"run": name, **_facts(open_run(path, allow_partial=True))})
        except ProbeKitError as error:
            lines.append({"run": name, "error": f"{type(error).__name__}: {error}"})
    print_table(_table(lines, folder), "json" if as_json else "table")
    for line in lines:
        if "error" in line:
            say(markup("[yellow]{} cannot be read: {}[/]", line["run"], line["error"]))


def _facts(run: "Run") -> dict[str, Any]:
    from probe_kit.intervene.inventory import listed_interventions
    from probe_kit.runs.reader import full_name
    from probe_kit.train.results.inventory import inventory

    outcomes = run.episodes.get("outcome")
    judged = outcomes is not None and len(outcomes) > 0 and set(outcomes) <= {"correct", "wrong", "oob"}
    return {
        "model": full_name(run.label, run.random_weights),
        "suite": run.suite,
        "episodes": len(run.episodes),
        "correct": float((outcomes == "correct").mean()) if judged and outcomes is not None else None,
        "probes": len(inventory(run).probes),
        "interventions": len(listed_interventions(run)),
    }


def _table(lines: list[dict[str, Any]], folder: Path) -> Table:
    """Return the runs that can be read, a line each; the numbers also name the others."""
    rows = []
    for line in lines:
        if "error" not in line:
            # Hashes stay in the numbers: they would take the room of names.
            suite = line["suite"].partition("#")[0]
            cells = {**line, "correct": Cell(line["correct"], whole_percent), "suite": suite}
            rows.append([cells[name] for name in _COLUMNS])
    headings = ["correct %" if name == "correct" else name for name in _COLUMNS]
    return Table.of(f"runs below {folder}", headings, rows, numbers=tuple(lines), overflow="wrap")


def show(
    run: Annotated[
        str, typer.Argument(help="Run folder or URL, or a folder that holds runs at any depth.", metavar="RUN")
    ],
    label: Annotated[
        str | None,
        typer.Option(
            "--label",
            metavar="TEXT",
            help="First give the run this label, as tables and figures name it. Numbers, hashes and probes stay "
            "as they are.",
        ),
    ] = None,
    action_errors: Annotated[
        bool,
        typer.Option(
            "--action-errors",
            help="For a run on recordings: compare the actions that the model predicted with the recorded ones.",
        ),
    ] = False,
    partial: Partial = False,
    as_json: AsJson = False,
) -> None:
    """List the episodes, streams, probes and interventions of a run; the last two by key.

    Of a folder that holds runs it lists these: model, suite, episodes, and how many probes and interventions each
    has. `probe-kit view FOLDER` opens them all.

    With --action-errors, errors are in standard deviations of the recorded actions at the shown frames: the mean
    recorded action has an error of 1. `--json` prints every episode too; `probe-kit labels RUN` writes the
    error of every frame. An unfinished run needs --partial for it.
    """
    from probe_kit.intervene.inventory import listed_interventions
    from probe_kit.runs import label_run, open_run
    from probe_kit.runs.layout import INTERVENTIONS
    from probe_kit.runs.results import unfinished_bundles
    from probe_kit.runs.run_folders import runs_below
    from probe_kit.runs.run_inputs import notes_of_inputs
    from probe_kit.train.commands import facts_table
    from probe_kit.train.results.inventory import inventory
    from probe_kit.train.results.store import how_to_probe

    if below := runs_below(run):
        options = {"--label": label is not None, "--action-errors": action_errors, "--partial": partial}
        check_no_others(options, "a folder of runs")
        _list_runs(Path(run).expanduser(), below, as_json)
        return
    if partial and not action_errors:
        raise UsageError("--partial is for --action-errors; `run show` lists unfinished runs too. Leave it out")
    if label is not None:
        label_run(run, label)
    if action_errors:
        _show_action_errors(run, partial, as_json)
        return
    opened = open_run(run, allow_partial=True)
    facts, interventions = inventory(opened), listed_interventions(opened)
    unfinished = unfinished_bundles(opened.location, INTERVENTIONS)
    notes = notes_of_inputs(opened) if facts.episodes else []
    if as_json:
        listed = [asdict(intervention) for intervention in interventions]
        print_json(
            {
                **asdict(facts),
                "success": None if facts.success is None else facts.success.to_json(),
                "streams": {name: _shape(stream, opened.views(name)) for name, stream in opened.streams.items()},
                "interventions": listed,
                "unfinished_interventions": unfinished,
                "input_notes": notes,
            }
        )
        return
    rows = {"inputs": "; ".join(notes)}
    rows |= {f"intervention {intervention.key}": intervention.words for intervention in interventions}
    rows |= {
        f"unfinished {key}": f"an intervention, {plural(items, 'item')} so far; "
        "the same `probe-kit intervene` continues it"
        for key, items in unfinished.items()
    }
    out.print(facts_table(facts, rows))
    if not facts.probes:
        why = f". {how_to_probe(opened)}" if facts.streams else ": a policy without streams has none"
        out.print(f"no probes{why}", soft_wrap=True)


def _shape(stream: "Stream", views: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of a stream that a run stores, and the names of its views."""
    return {**stream.shape_json(), "views": list(views)}


def _show_action_errors(run: str, partial: bool, as_json: bool) -> None:
    """Print how predicted actions differ from the recorded ones.

    Raises as `compare_actions`.
    """
    from probe_kit.runs import compare_actions, open_run
    from probe_kit.runs.action_errors import action_error_table

    errors = compare_actions(open_run(run, allow_partial=partial))
    if as_json:
        print_json({"run": run, "numbers": _plain(errors.by_number), "episodes": _plain(errors.by_episode)})
    else:
        out.print(action_error_table(errors))


def _plain(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """Return the lines of a frame as values for JSON: NaN is null."""
    rows = frame.to_dict("records")
    return [{str(name): None if value != value else value for name, value in row.items()} for row in rows]
