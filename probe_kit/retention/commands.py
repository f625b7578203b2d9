"""The commands `probe-kit retention` and `probe-kit compare`, their output and their files."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._tables.printing import print_table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, markup, out, print_json, print_text, say, say_note, split
from probe_kit._terminal.field_options import command_with
from probe_kit.errors import NoProbesError, UsageError
from probe_kit.retention.choices import ComparisonKind, Section
from probe_kit.retention.table_options import (
    ComparisonOptions,
    LabelTableOptions,
    PageOptions,
    PaperTableOptions,
    RunTableOptions,
    SideTableOptions,
    StageTableOptions,
    StepTableOptions,
    VlmTableOptions,
    read_iterations,
)

if TYPE_CHECKING:
    from probe_kit.retention.displays.report_figure import ReportFigure
    from probe_kit.retention.table import RetentionTable
    from probe_kit.runs import Run

Kind = Annotated[
    ComparisonKind,
    typer.Option(
        "--kind",
        help="What to compare. runs: every other run with the first. groups: every two groups of models. vlm-vla: "
        "VLM runs with policy runs. stages: VLM_RUN and RUN, question by question: answer, probe, success. steps: "
        "checkpoints of one training, ordered by their training step.",
    ),
]


@command_with(SideTableOptions, LabelTableOptions, PaperTableOptions)
def retention(
    typed: Mapping[str, Any],
    run: Annotated[list[str] | None, typer.Argument(help="Run folder or URL.", metavar="RUN")] = None,
) -> None:
    """Print a run's success rates and how much of the backbone's signal reaches the action stream.

    With `--target COLUMN` the signal is that of a label of your own, see `probe-kit train --target COLUMN`.
    `probe-kit compare RUN RUN` compares runs.
    """
    options = _table_options(typed, SideTableOptions)
    if not run:
        raise UsageError("give a run folder; `probe-kit run show FOLDER` lists the runs below a folder")
    if len(run) > 1:
        raise UsageError(
            f"`probe-kit retention` reads one run, and {len(run)} are given. Compare them with `probe-kit compare "
            f"{' '.join(map(as_argument, run))}`"
        )
    _show_table(options, {None: run}, {})


@command_with(ComparisonOptions, StepTableOptions, LabelTableOptions, PaperTableOptions)
def compare(
    typed: Mapping[str, Any],
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            help="Run folders or URLs of the same questions. With --kind groups: NAME=RUN,RUN per group.",
            metavar="RUN…",
        ),
    ] = None,
    kind: Kind = "runs",
) -> None:
    """Compare runs: success rates, scores of probes and retention on the same questions.

    With `--kind stages` it compares a VLM and a policy question by question: answer, probe, success. Answer: the
    VLM answers right. Probe: a held-out probe of the policy is right. Success: the cube ends on the correct
    picture. Each in both layouts. Both runs need the same first frames.
    """
    paths = list(runs or ())
    if kind == "stages":
        _check_doubles(paths)
        show_stages(paths, StageTableOptions.of_typed(typed))
    elif kind == "steps":
        _check_given(paths)
        _show_steps(StepTableOptions.of_typed(typed), paths)
    elif kind == "vlm-vla":
        _check_given(paths)
        _show_table(VlmTableOptions.of_typed(typed), {None: paths}, {"vlm_vla": True})
    elif kind == "groups":
        _check_given(paths)
        of_groups = ComparisonOptions.of_typed(typed)
        _show_table(of_groups, _groups(paths), {"against": of_groups.reference})
    else:
        options = _table_options(typed, ComparisonOptions)
        _check_given(paths)
        reference = {"against": options.reference} if isinstance(options, ComparisonOptions) else {}
        _show_table(options, {None: paths}, reference)


def _table_options[Sides: SideTableOptions](
    typed: Mapping[str, Any], of_sides: type[Sides]
) -> Sides | LabelTableOptions | PaperTableOptions:
    """Return the options of the table that was requested: of labels, of the paper, or of sides."""
    if "target" in typed:
        return LabelTableOptions.of_typed(typed)
    if "family" in typed:
        raise UsageError("--family is for labels of your own; give --target COLUMN too, or leave it out")
    return PaperTableOptions.of_typed(typed) if "as_paper" in typed else of_sides.of_typed(typed)


def _check_given(paths: Sequence[str]) -> None:
    """Raise UsageError where no run is given."""
    if not paths:
        raise UsageError("give run folders, or groups of them as --kind groups NAME=RUN,RUN NAME=RUN,RUN")


def _show_table(
    options: SideTableOptions | LabelTableOptions | PaperTableOptions,
    paths: Mapping[str | None, Sequence[str]],
    compared: Mapping[str, Any],
) -> None:
    """Print the table of runs, and write what belongs to it.

    Args:
        options: Options of the table.
        paths: Runs by group; None for runs without a group.
        compared: Arguments of `retention_table` that say what is compared.
    """
    table, runs = _make_table(options, paths, compared)
    if isinstance(options, PaperTableOptions):
        print_table(table.as_paper, options.style, table.notes)
        return
    details = options.details or ()
    _write_files(options, runs, table)
    _print_sections(table, options.style, details)


def _make_table(
    options: RunTableOptions, paths: Mapping[str | None, Sequence[str]], compared: Mapping[str, Any]
) -> "tuple[RetentionTable, list[Run]]":
    """Return the table of runs by group, and all of its runs in order."""
    from probe_kit.retention import retention_table
    from probe_kit.runs import open_run

    listed = [path for of_group in paths.values() for path in of_group]
    _check_doubles(listed)
    arguments = options.arguments() | {"iterations": read_iterations(options.iterations)}
    if isinstance(options, PageOptions):
        options.check_files()
    opened = {
        group: [open_run(path, allow_partial=options.partial).in_wording(options.wording) for path in of_group]
        for group, of_group in paths.items()
    }
    runs = [run for of_group in opened.values() for run in of_group]
    keys = _keys(listed, options.probes)
    grouped: Any = runs if None in opened else opened
    return retention_table(grouped, options.views, keys=keys, **arguments, **compared), runs


def _write_files(options: PageOptions, runs: "Sequence[Run]", table: "RetentionTable") -> None:
    """Draw the figures and the report of a table that were requested."""
    if options.figures is not None:
        from probe_kit.retention.displays import collect_figures

        save_all(collect_figures(runs, table), options.figures, "all" in (options.details or ()))
    if options.html is not None:
        from probe_kit.retention.report import write_report

        with err.status("drawing the report"):
            written = write_report(runs, options.html, table)
        say_report(written)


def _show_steps(options: StepTableOptions, paths: Sequence[str]) -> None:
    """Print the table over training steps, and draw its figure."""
    from probe_kit.retention import retention_table
    from probe_kit.retention.displays.display import ProvenanceLine
    from probe_kit.retention.training_steps import read_steps, step_table, training_step_figure
    from probe_kit.runs import open_run

    _check_doubles(paths)
    options.check_files()
    arguments = options.arguments() | {"iterations": read_iterations(options.iterations)}
    runs = [open_run(path, allow_partial=options.partial).in_wording(options.wording) for path in paths]
    keys = _keys(paths, options.probes)
    training = read_steps(options.steps, runs)
    order = sorted(range(len(runs)), key=lambda at: training[str(runs[at].location)])
    table = retention_table(
        [runs[at] for at in order], options.views, keys=[keys[at] for at in order], **arguments
    )
    by_step = step_table(table, training)
    if options.figures is not None:
        lines = [ProvenanceLine.of_row(mean) for mean in table.means]
        save_all([training_step_figure(by_step, lines)], options.figures)
    print_table(by_step, options.style, (*table.unpaired, *table.notes))


def _print_sections(table: "RetentionTable", style: str, details: Sequence[str]) -> None:
    """Print the table in a format, with the sections that were requested where the format has any."""
    sections: Collection[Section] | Literal["all"]
    sections = "all" if "all" in details else cast("tuple[Section, ...]", details)
    if style == "table":
        out.print(table.to_rich(sections))
    elif style in ("json", "csv", "markdown"):  # Markdown has every table
        print_table(table, style, table.notes)
    else:
        print_text(table.to_latex(sections) if style == "latex" else table.to_text(style, sections))
        for note in table.notes:
            say_note(note)


def _keys(paths: Sequence[str], texts: Sequence[str]) -> list[str | None]:
    """Return the key of every run in order, None where none was chosen.

    A run goes by its path or its folder's name.
    """
    keys: list[str | None] = [None] * len(paths)
    for text in texts:
        name, separator, key = text.rpartition("=")
        if not (separator and name and key):
            raise UsageError(f"--probes {text!r} is not RUN=KEY; `probe-kit run show RUN` lists the keys")
        matches = [at for at, path in enumerate(paths) if _strip_name(path) == _strip_name(name)]
        matches = matches or [at for at, path in enumerate(paths) if _strip_name(path).rpartition("/")[2] == name]
        if len(matches) != 1:
            raise UsageError(
                f"--probes {text!r}: {name} is {'several' if matches else 'none'} of the runs {', '.join(paths)}"
            )
        if keys[matches[0]] is not None:
            raise UsageError(f"--probes chooses probes of {name} twice; choose one")
        keys[matches[0]] = key
    return keys


def _strip_name(path: str) -> str:
    return path.rstrip("/") if "://" in path else str(Path(path).resolve())


def _check_doubles(paths: Sequence[str]) -> None:
    """Raise UsageError for a path that is given twice, before anything is opened.

    The function `retention` also knows copies of a run.
    """
    for at, path in enumerate(paths):
        if _strip_name(path) in map(_strip_name, paths[:at]):
            raise UsageError(f"{path} is given twice; its episodes would count twice. Leave one out")


def _groups(texts: Sequence[str]) -> dict[str | None, Sequence[str]]:
    groups: dict[str | None, Sequence[str]] = {}
    for text in texts:
        name, separator, paths = text.partition("=")
        if not (separator and name and split(paths)):
            raise UsageError(f"{text!r} is not NAME=RUN,RUN, a group of models")
        if name in groups:
            raise UsageError(f"the group {name!r} is given twice; write all of its runs after one {name}=")
        groups[name] = tuple(filter(None, map(str.strip, paths.split(","))))  # a run given twice is refused
    return groups


def save_all(figures: "Sequence[ReportFigure]", folder: Path, details: bool = False) -> None:
    """Draw the main figures into a folder, and print where each is and how many are left out.

    Args:
        figures: All figures of a table.
        folder: Folder of the figures.
        details: Whether every figure is drawn.
    """
    from probe_kit.retention.displays import save_figures

    drawn = [report_figure for report_figure in figures if details or not report_figure.is_detail]
    for path in save_figures(drawn, folder):
        say(f"figure: {path}")
    if left_out := len(figures) - len(drawn):
        say(f"{plural(left_out, 'further figure')}: add --details all")


def say_report(written: Path) -> None:
    """Print where a report is, and its size."""
    from probe_kit.runs.run_folders import in_units

    say(f"report: {written} ({in_units(written.stat().st_size)})")


def show_stages(runs: Sequence[str], options: StageTableOptions) -> None:
    """Compare what a VLM answers, a policy encodes and a policy does, question by question.

    Answered: the VLM answers right. Encoded: a probe of the policy reads the answer, above chance and controls.
    Acted: the cube ends on the correct picture. Raises as `match_runs` too.

    Args:
        runs: The VLM's, then the policy's; both need the same first frames.
        options: Options of the table; at most one view, of the policy run's probes, and None for the first.

    Raises:
        UsageError: For other runs or views.
    """
    from probe_kit.retention.behaviour import scored
    from probe_kit.retention.columns.tables import known_used_tables
    from probe_kit.retention.compare.known_used import match_runs
    from probe_kit.runs import open_run
    from probe_kit.train.results.store import load_side_results

    style, views = options.style, options.views
    common.check_no_others({f"--format {style}": style not in ("table", "json")}, options.table)
    options.check_files()
    if len(runs) != 2:
        raise UsageError(f"--kind stages compares two runs, and {len(runs)} are given; expected VLM_RUN RUN")
    if views is not None and len(views) != 1:
        raise UsageError(
            f"--kind stages reads probes of one view; --views {','.join(views)} has {len(views)}. Give one"
        )
    _, key = _keys(runs, options.probes)
    view = views[0] if views else None
    vlm = scored(open_run(runs[0]), options.score, options.with_side_words)
    policy = open_run(runs[1]).in_wording(options.wording)
    try:
        results = load_side_results(policy, key)
    except NoProbesError as error:
        if view is not None:
            raise UsageError(f"--views {view}: {error}") from None
        results = None
    joined = match_runs(vlm, policy, results, view)
    if style == "json":
        print_json(joined.to_json())
    else:
        for table in known_used_tables(joined):
            out.print(table)
        for note in joined.notes:
            out.print(markup("[yellow]{}[/]", note))
    if options.figures is not None:
        from probe_kit.retention.displays.bars import known_used_figure

        save_all([known_used_figure(joined)], options.figures)
