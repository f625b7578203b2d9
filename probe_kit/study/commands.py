"""`probe-kit study`: a whole study from one file."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._tables.printing import Format, print_table
from probe_kit._terminal.console import counter, err, markup, out, print_json, print_text, progress, say
from probe_kit._terminal.options import (
    AsJson,
    EnvWorkers,
    Partial,
    RayAddress,
    check_no_others,
    speed_option,
)
from probe_kit.errors import UsageError
from probe_kit.train.command_options import Jobs

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.study import LoadedStudy, StudyFailure, StudyPlan
    from probe_kit.study.playing import Event

HELP = """Run a whole study from one file: models × conditions × categories.

Print the plan, play what is missing, look at what is stored, print the tables.
Stored runs are never played again.

\b
probe-kit study run embedded --dry-run
probe-kit study run embedded
probe-kit study table embedded success
"""
app = typer.Typer(help=HELP, no_args_is_help=True)
UNFINISHED = 1
DATA_SET = "Data set"
File = Annotated[
    str,
    typer.Argument(metavar="FILE", help="Study file, or the name of a study of the package: embedded or paper."),
]
Only = Annotated[
    str | None,
    typer.Option(
        "--only", metavar="NAME", help="Play only the runs of this block of the study file, or of this model."
    ),
]


@app.command("run")
def run(
    file: File,
    only: Only = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan and stop. Loads no model and writes no run.")
    ] = False,
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="With --dry-run: exit with 1 if anything is missing.")
    ] = False,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="With --dry-run: compare every stored byte with its hash; exit with 1 if one was changed. Takes "
            "long.",
        ),
    ] = False,
    orphans: Annotated[
        bool, typer.Option("--orphans", help="With --dry-run: list stored runs that the file does not use.")
    ] = False,
    as_json: AsJson = False,
    no_probes: Annotated[bool, typer.Option("--no-probes", help="Fit no probes.")] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Try again the models and episodes that failed.")
    ] = False,
    slots: Annotated[
        int,
        speed_option(
            "--slots",
            min=0,
            max=1024,
            help="Number of processes, each with one model; probes use them too. 0: everything runs in this "
            "process.",
        ),
    ] = 0,
    ray: RayAddress = None,
    env_workers: EnvWorkers = None,
    jobs: Jobs = None,
) -> None:
    """Play and ask what a study needs and is not stored yet, then fit its probes.

    Each model is loaded once. A model that fails stops itself alone, and its reason is stored.
    The same command resumes. What failed while it played is tried again with --retry-failed. --dry-run prints
    what is stored, and why other runs are to be made.

    \b
    probe-kit study run mine.toml --dry-run
    probe-kit study run mine.toml --dry-run --verify --orphans
    probe-kit study run mine.toml --slots 2
    probe-kit study run mine.toml --only base --retry-failed
    """  # noqa: D301
    from probe_kit.study import load_study, plan_study

    if slots and ray is not None:
        raise UsageError("give either --slots, for processes of this machine, or --ray, for a cluster")
    looks = {"--exit-code": exit_code, "--verify": verify, "--orphans": orphans}
    if not dry_run and any(looks.values()):
        flag = next(name for name, is_on in looks.items() if is_on)
        raise UsageError(f"{flag} looks at what is stored and plays nothing; give it with --dry-run")
    study = load_study(file)
    if study.archive is not None and not dry_run:
        raise UsageError(f"{file} is an archive without activations; nothing can be added to its runs")
    plan = plan_study(study, only)
    if dry_run:
        changed = _look(plan, verify, orphans, as_json)
        if changed or (exit_code and not plan.complete):
            raise typer.Exit(UNFINISHED)
        return
    failed = _play(plan, slots=slots, ray=ray, env_workers=env_workers, retry_failed=retry_failed)
    if plan.totals()["missing"]:
        plan = plan_study(study, only)
    if plan.totals()["unprobed"] and not no_probes:
        from probe_kit.study import fit_probes  # which loads torch

        with progress() as bar:
            failures = fit_probes(plan, _counters(bar, "probes of "), jobs or slots or None)
        # What waits for a run is no failure of its own.
        failed += [failure for failure in failures if failure.stage != "waiting"]
        plan = plan_study(study, only)
    _print(plan, as_json)
    for failure in failed:
        say(markup("[red]{}[/]", failure))
    if failed or plan.totals()["missing"]:
        raise typer.Exit(UNFINISHED)
    if study.study.tables:
        say(markup("next: [bold]probe-kit study table {}[/]", as_argument(file)))


def _print(plan: "StudyPlan", as_json: bool) -> None:
    from probe_kit._tables.table import Cell, Table

    if as_json:
        print_json(plan.to_json())
        return
    columns = ("model", "run", "blocks", "episodes", "inferences", "state")
    rows = []
    for planned in plan.cells:
        cell = planned.cell
        blocks, episodes = ", ".join(cell.selections), Cell(cell.episodes, "{:,}".format)
        inferences = Cell(None) if cell.asks else Cell(cell.inferences, "{:,}".format)
        rows.append((cell.model, planned.run_text, blocks, episodes, inferences, planned.words))
    out.print(Table.of(f"study {plan.study.study.name}", columns, rows, overflow="wrap"))
    for line in plan.lines():
        _print_plain(line)


def _print_plain(line: str) -> None:
    out.print(line, highlight=False, markup=False, soft_wrap=True)


def _look(plan: "StudyPlan", verify: bool, orphans: bool, as_json: bool) -> bool:
    """Print the plan, changed bytes and unused runs; return whether a byte was changed."""
    from probe_kit.study.plan import changed_runs, orphaned_runs

    problems = changed_runs(plan) if verify else {}
    unused = orphaned_runs(plan) if orphans else []
    if as_json:
        audits = {**({"problems": problems} if verify else {}), **({"orphans": unused} if orphans else {})}
        print_json({**plan.to_json(), **audits})
        return bool(problems)
    _print(plan, as_json)
    for name, texts in problems.items():
        for problem in texts:
            _print_plain(f"damaged: {name}: {problem}")
    for location in unused:
        _print_plain(f"used by no run of the file: {location}")
    return bool(problems)


def _play(plan: "StudyPlan", **options: Any) -> "list[StudyFailure]":
    """Play what is missing, with a bar for the study and one per run in play."""
    from probe_kit.study import EpisodeStored, StudyFailure, conduct_study

    with progress() as bar:
        totals, count = plan.totals(), _counters(bar, "")
        stored, of_study = totals["episodes"] - totals["missing"], counter(bar, f"study {plan.study.study.name}")

        def report(event: "Event") -> None:
            nonlocal stored
            if isinstance(event, StudyFailure):
                say(markup("[red]{}[/]", event))
            elif isinstance(event, EpisodeStored):
                count(event.run, event.stored, event.planned)
                stored += 1
                of_study(stored, totals["episodes"])

        return conduct_study(plan, report, **options)


def _counters(bar: Any, prefix: str) -> Callable[..., None]:
    """Return a callback (run, done, total, …) with a bar per run, which appears with the first count."""
    of_run = cache(lambda run: counter(bar, f"{prefix}{run}"))
    return lambda run, finished, total, *_: of_run(run)(finished, total)


@app.command("table")
def table(
    file: File,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Which table of the study file. Default: all.")
    ] = None,
    style: Format = "table",
    html: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="Write state, all tables and all figures as one HTML file."),
    ] = None,
    partial: Partial = False,
) -> None:
    """Print a table of a study, or all, from its stored runs. Loads no model.

    With --partial the command exits with 1 if anything is missing that the study would play.
    """
    from probe_kit.study import load_study, make_table
    from probe_kit.study.tables import make_each

    study = load_study(file)
    if html is not None:
        if name is not None or style != "table":
            raise UsageError("--html holds all tables and figures; leave NAME and --format out")
        _write_report(study, html, partial)
        return
    if style == "csv" and name is None and len(study.study.tables) > 1:
        raise UsageError(
            f"--format csv prints one table, and {file} has {', '.join(study.study.tables)}; give the name of one"
        )
    names = [name] if name else list(study.study.tables)
    accepts_missing = partial and name is None
    tables, missing = make_each(names, lambda each: make_table(study, each, partial), accepts_missing)
    for table_name, why in missing.items():
        say(markup("[red]no table {}: {}[/]", table_name, why))
    _print_tables(tables, style, single=name is not None)
    if not name and style not in ("json", "csv"):
        numbers = [number for printed in tables.values() for number in printed.numbers]
        tests = sum(number.get("p") is not None or number.get("p_over_models") is not None for number in numbers)
        say(
            f"{plural(len(tables), 'table')} with {plural(tests, 'test')}; "
            "each is corrected within its own comparison."
        )
    if missing or any(printed.is_partial for printed in tables.values()):
        raise typer.Exit(UNFINISHED)


def _print_tables(tables: "dict[str, Table]", style: str, single: bool) -> None:
    if style == "json":
        records = {
            name: {"table": printed.title, "note": "; ".join(printed.all_notes), "numbers": list(printed.numbers)}
            for name, printed in tables.items()
        }
        print_json(next(iter(records.values())) if single else records)
        return
    for at, printed in enumerate(tables.values()):
        if at and style not in ("table", "csv"):
            print_text("")
        print_table(printed, style)


def _write_report(study: "LoadedStudy", html: Path, partial: bool) -> None:
    from probe_kit.retention.commands import say_report
    from probe_kit.study import write_study_report

    if html.is_dir():
        raise UsageError(f"--html {html} is a folder; give a file, such as {html / 'report.html'}")
    with err.status("drawing the report"):
        report = write_study_report(study, html, partial)
    say_report(html)
    for name, reason in report.missing.items():
        say(markup("[red]no {}: {}[/]", name, reason))
    if report.is_partial:
        raise typer.Exit(UNFINISHED)


@app.command("figure")
def figure(
    file: File,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Which figure of the study file. Default: all.")
    ] = None,
    out_folder: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Folder for PNG and PDF files.")
    ] = Path("figures"),
    partial: Partial = False,
) -> None:
    """Draw a figure of a study, or all, from its stored runs. Loads no model."""
    from probe_kit.retention.displays import save_figures
    from probe_kit.retention.table_options import check_file
    from probe_kit.study import load_study, make_figures

    check_file(out_folder)
    study = load_study(file)
    for figure_name in [name] if name else study.study.figures:
        for path in save_figures(make_figures(study, figure_name, partial), out_folder):
            _print_plain(str(path))


@app.command("pack")
def pack(
    file: File,
    out_file: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="PATH",
            help="Zip file (*.zip) or folder to write. With --data-set it must be a folder.",
        ),
    ],
    directions: Annotated[bool, typer.Option("--directions", help="Include the weights of probes.")] = False,
    pictures: Annotated[bool, typer.Option("--pictures", help="Include frames and videos.")] = False,
    trajectories: Annotated[
        bool,
        typer.Option(
            "--trajectories", help="Include every control step, so that other outcome rules can be applied."
        ),
    ] = False,
    data_set: Annotated[
        bool,
        typer.Option(
            "--data-set",
            help="Write a data set: card, episodes, tables, archive and hashes.",
            rich_help_panel=DATA_SET,
        ),
    ] = False,
    publish: Annotated[
        str | None,
        typer.Option(
            "--publish",
            metavar="OWNER/NAME",
            help="Upload the data set to this repository of the hub.",
            rich_help_panel=DATA_SET,
        ),
    ] = None,
    pull_request: Annotated[
        bool,
        typer.Option(
            "--pr", help="With --publish: open a pull request in a data set that exists.", rich_help_panel=DATA_SET
        ),
    ] = False,
    private: Annotated[
        bool,
        typer.Option("--private", help="With --publish: make a new data set private.", rich_help_panel=DATA_SET),
    ] = False,
    licence: Annotated[
        str | None,
        typer.Option(
            "--license",
            metavar="NAME",
            help="Licence of the data set, such as cc-by-4.0.",
            rich_help_panel=DATA_SET,
        ),
    ] = None,
    partial: Partial = False,
) -> None:
    """Pack runs without activations, and all tables; `study table PATH` prints them from the archive alone.

    With --publish the pack is a data set of the Hugging Face hub.
    """
    from probe_kit.study import load_study, pack_study, publish_data_set, write_data_set
    from probe_kit.study.pack import EXTRAS

    if publish is None and (pull_request or private):
        raise UsageError(
            f"{'--pr' if pull_request else '--private'} is of an upload; give --publish OWNER/NAME too"
        )
    if data_set or publish is not None:
        check_no_others(
            {"--directions": directions, "--pictures": pictures, "--trajectories": trajectories}, "a data set"
        )
        with err.status("packing"):
            record = write_data_set(load_study(file), out_file, partial, licence, again=publish is not None)
        for name, reason in record.missing.items():
            _print_plain(f"not in it: {name}: {reason}")
        address = str(out_file)
        if publish is not None:
            with err.status("uploading"):
                address = publish_data_set(out_file, publish, pull_request, private)
        _print_plain(address)
        return
    if licence is not None:
        raise UsageError("--license is of a data set; give --data-set or --publish OWNER/NAME too")
    extras = dict(zip(EXTRAS, (pictures, trajectories, directions), strict=True))
    with err.status("packing"):
        record = pack_study(load_study(file), out_file, partial, [name for name in EXTRAS if extras[name]])
    out.print(
        f"{out_file}: {plural(len(record.runs), 'run')}, without {', '.join(record.left_out)}", soft_wrap=True
    )
    for name, reason in record.missing.items():
        _print_plain(f"not packed: {name}: {reason}")
