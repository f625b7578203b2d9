"""`probe-kit study`: a whole study from one file."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from probe_kit._terminal.console import counter, err, marked, out, print_json, print_text, progress, say
from probe_kit._terminal.options import AsJson, EnvWorkers, Partial
from probe_kit.errors import UsageError
from probe_kit.train.command_options import Jobs

if TYPE_CHECKING:
    from probe_kit.retention.columns.text_table import TextTable
    from probe_kit.study import ModelFailure, ProbeFailure, StudyPlan
    from probe_kit.study.plan import PlannedCell

app = typer.Typer(help="Run a whole study from one file.", no_args_is_help=True)
UNFINISHED = 1
Style = Literal["table", "markdown", "latex", "json"]
File = Annotated[
    str,
    typer.Argument(metavar="FILE", help="Study file, or the name of a study of the package: embedded or paper."),
]
Only = Annotated[
    str | None, typer.Option("--only", metavar="NAME", help="Take the runs of this block or this model only.")
]


@app.command("run")
def run(
    file: File,
    only: Only = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan. Loads no model and writes nothing.")
    ] = False,
    as_json: AsJson = False,
    env_workers: EnvWorkers = None,
    no_probes: Annotated[bool, typer.Option("--no-probes", help="Fit no probes.")] = False,
    jobs: Jobs = None,
) -> None:
    """Play and ask what a study needs and is not stored yet, then fit its probes.

    Each model is loaded once for all of its runs. A model that fails stops itself alone. The same command resumes.
    """
    from probe_kit.study import conduct_study, fit_probes, load_study, plan_study

    study = load_study(file)
    if study.archive is not None and not dry_run:
        raise UsageError(f"{file} is an archive without activations; nothing can be added to its runs")
    plan = plan_study(study, only)
    if dry_run or as_json:
        print_json(plan.to_json()) if as_json else _print_plan(plan)
    if dry_run:
        return
    with progress() as bar:
        counters: dict[str, Callable[..., None]] = {}

        def tell(one: "PlannedCell", done: int, planned: int, outcome: str) -> None:
            if one.cell.name not in counters:
                counters[one.cell.name] = counter(bar, one.cell.name)
            counters[one.cell.name](done, planned, outcome)

        def count(name: str, done: int, sites: int, last: str) -> None:
            name = f"probes of {name}"
            if name not in counters:
                counters[name] = counter(bar, name)
            counters[name](done, sites, last)

        failed: list[ModelFailure | ProbeFailure] = []
        failed += conduct_study(plan, tell, lambda one: say(marked("[red]{}[/]", one)), env_workers)
        unfitted = [] if no_probes else fit_probes(study, only, count, jobs)
        failed += [one for one in unfitted if not one.missing]
    after = plan_study(study, only)
    _print_plan(after)
    for failure in failed:
        say(marked("[red]{}[/]", failure))
    if failed or after.totals()["missing"]:
        raise typer.Exit(UNFINISHED)


@app.command("status")
def status(file: File, only: Only = None, as_json: AsJson = False) -> None:
    """Print which runs of a study are stored, and why others are to be made; exit with 1 if any is missing."""
    from probe_kit.study import load_study, plan_study

    plan = plan_study(load_study(file), only)
    print_json(plan.to_json()) if as_json else _print_plan(plan)
    if plan.totals()["missing"]:
        raise typer.Exit(UNFINISHED)


@app.command("table")
def table(
    file: File,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Table of the file; all of them by default.")
    ] = None,
    style: Annotated[Style, typer.Option("--format", help="Output format.")] = "table",
    partial: Partial = False,
) -> None:
    """Print a table of a study, or all, from its stored runs. Loads no model."""
    from probe_kit.retention.formats.latex import latex_table
    from probe_kit.study import load_study, make_table
    from probe_kit.study.tables.formats import markdown_text, table_json

    study = load_study(file)
    made = {one: make_table(study, one, partial) for one in ([name] if name else study.study.tables)}
    if style == "json":
        found = {one: table_json(own) for one, own in made.items()}
        print_json(found[name] if name else found)
        return
    for own in made.values():
        if style == "table":
            _print_table(own.text)
        else:
            print_text(latex_table(own.text) if style == "latex" else markdown_text(own))
    if not name:
        tests = sum(own.n_tests for own in made.values())
        say(f"{len(made)} tables with {tests} tests; each is corrected within its own comparison.")


@app.command("figure")
def figure(
    file: File,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Figure of the file; all of them by default.")
    ] = None,
    out_folder: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Folder for PNG and PDF files.")
    ] = Path("figures"),
    partial: Partial = False,
) -> None:
    """Draw a figure of a study, or all, from its stored runs. Loads no model."""
    from probe_kit.retention.commands import check_file
    from probe_kit.retention.displays import save_figures
    from probe_kit.study import load_study, make_figures

    check_file(out_folder)
    study = load_study(file)
    for one in [name] if name else study.study.figures:
        for path in save_figures(make_figures(study, one, partial), out_folder):
            out.print(str(path), highlight=False, markup=False, soft_wrap=True)


@app.command("pack")
def pack(
    file: File,
    out_file: Annotated[Path, typer.Option("--out", metavar="PATH", help="Zip file (*.zip), or a folder.")],
    directions: Annotated[bool, typer.Option("--directions", help="With the weights of probes.")] = False,
    pictures: Annotated[bool, typer.Option("--pictures", help="With frames and videos.")] = False,
    partial: Partial = False,
) -> None:
    """Pack runs without activations, and all tables; `study table PATH` prints them from the archive alone."""
    from probe_kit.study import load_study, pack_study

    with err.status("packing"):
        made = pack_study(load_study(file), out_file, partial, directions, pictures)
    out.print(f"{out_file}: {len(made.keys)} runs, without {', '.join(made.left_out)}", soft_wrap=True)
    for name, reason in made.missing.items():
        out.print(f"not packed: {name}: {reason}", highlight=False, markup=False, soft_wrap=True)


@app.command("publish")
def publish(
    file: File,
    repository: Annotated[str, typer.Argument(metavar="REPO", help="Data set on the hub, as owner/name.")],
    out_folder: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Folder for the data set.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write the folder, and upload nothing.")] = False,
    pull_request: Annotated[
        bool, typer.Option("--pr", help="Open a pull request in a data set that exists.")
    ] = False,
    private: Annotated[bool, typer.Option("--private", help="Make a new data set private.")] = False,
    licence: Annotated[
        str | None, typer.Option("--license", metavar="NAME", help="Of the data set, such as cc-by-4.0.")
    ] = None,
    partial: Partial = False,
) -> None:
    """Publish a study as a data set: card, episodes, tables, archive and hashes. Activations stay here."""
    from probe_kit.study import load_study, publish_data_set, write_data_set

    with err.status("packing"):
        made = write_data_set(load_study(file), out_folder, partial, licence)
    for name, reason in made.missing.items():
        out.print(f"not in it: {name}: {reason}", highlight=False, markup=False, soft_wrap=True)
    if dry_run:
        out.print(str(out_folder), highlight=False, markup=False, soft_wrap=True)
        return
    with err.status("uploading"):
        address = publish_data_set(out_folder, repository, pull_request, private)
    out.print(address, highlight=False, markup=False, soft_wrap=True)


def _print_table(text: "TextTable") -> None:
    from rich.table import Table

    shown = Table(*text.columns, title=text.title, caption=f"{text.note}.", box=None)
    for cells in text.cells:
        shown.add_row(*(marked("{}", cell) for cell in cells))
    out.print(shown)


def _print_plan(plan: "StudyPlan") -> None:
    """A line per run, then what all of them take."""
    from rich.table import Table

    name = plan.study.study.name
    table = Table("model", "run", "blocks", "episodes", "inferences", "state", title=f"study {name}", box=None)
    for column in table.columns[3:5]:
        column.justify = "right"
    for one in plan.cells:
        cell = one.cell
        way = cell.way + (f", seed {cell.seed}" if cell.seed else "")
        inferences = "–" if cell.asks else f"{cell.inferences:,}"
        cells = (cell.model, way, ", ".join(cell.selections), f"{cell.episodes:,}", inferences)
        table.add_row(*(marked("{}", text) for text in (*cells, one.why)))
    out.print(table)
    for line in _lines(plan):
        out.print(line, highlight=False, markup=False, soft_wrap=True)


def _lines(plan: "StudyPlan") -> list[str]:
    """Totals, hours with their source, and what is skipped."""
    totals, suite = plan.totals(), plan.study.suite
    lines = [
        f"suite: {suite.identity}; items from {suite.source}",
        f"{totals['runs']} runs, {totals['episodes']:,} episodes ({totals['acted']:,} acted, "
        f"{totals['captured']:,} captured without acting, {totals['asked']:,} asked), at most "
        f"{totals['inferences']:,} inferences of policies (given by shape: no model was loaded)",
        f"missing: {totals['missing']:,} episodes",
    ]
    hours, unmeasured = plan.hours(), plan.unmeasured()
    if hours:
        each = ", ".join(f"{model} {value:.2g}" for model, value in hours.items())
        lines.append(f"hours: {sum(hours.values()):.2g} ({each}; measured here in stored episodes)")
    if unmeasured:
        lines.append(f"hours unknown, because no episode was measured here: {', '.join(unmeasured)}")
    lines += [f"skipped: {model}: {reason}" for model, reason in plan.skipped().items()]
    return lines
