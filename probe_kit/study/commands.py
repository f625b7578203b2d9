"""`probe-kit study`: a whole study from one file."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from probe_kit._terminal.console import counter, marked, out, print_json, print_text, progress, say
from probe_kit._terminal.options import AsJson, EnvWorkers, Partial
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
    name: Annotated[str, typer.Argument(metavar="NAME", help="Table of the file.")],
    style: Annotated[Style, typer.Option("--format", help="Output format.")] = "table",
    partial: Partial = False,
) -> None:
    """Print a table of a study from its stored runs. Loads no model."""
    from probe_kit.retention.formats.latex import latex_table
    from probe_kit.retention.formats.markdown import markdown_table
    from probe_kit.study import load_study, make_table

    made = make_table(load_study(file), name, partial)
    if style == "json":
        print_json({"table": made.text.title, "note": made.text.note, "numbers": list(made.numbers)})
    elif style == "table":
        _print_table(made.text)
    else:
        text = latex_table(made.text) if style == "latex" else f"{markdown_table(made.text)}\n{made.text.note}."
        print_text(text)


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
