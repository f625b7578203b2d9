"""The `probe-kit` command. It parses, calls the library and prints; tables go to stdout, progress to stderr."""

import signal
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
import typer.core
from rich.markup import escape

from probe_kit.console import counter, err, out, print_json, progress, split
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.extract.commands import export, extract, run_app
from probe_kit.suite.commands import app as suite_app

if TYPE_CHECKING:
    from probe_kit.doctor import Finding
    from probe_kit.extract import Run
    from probe_kit.hooks.verify import Verification
    from probe_kit.retention import RetentionTable
    from probe_kit.retention.measure import Iterations
    from probe_kit.train import Baseline, ProbeResults, Target

INTERRUPTED = 130


class Commands(typer.core.TyperGroup):
    """Turns errors and interruptions of any command into messages and exit codes."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            err.print("[yellow]interrupted[/]; everything finished so far is kept, the same command continues")
            raise typer.Exit(INTERRUPTED) from None
        except ProbeKitError as error:
            err.print(
                f"[bold red]{type(error).__name__}[/]: {escape(str(error))}", highlight=False, soft_wrap=True
            )
            for note in getattr(error, "__notes__", []):
                err.print(f"  {escape(note)}", highlight=False, soft_wrap=True)
            raise typer.Exit(error.exit_code) from error
        except _PATH_ERRORS as error:
            if error.filename is None:
                raise
            err.print(
                f"[bold red]{UsageError.__name__}[/]: {escape(_path_message(error))}",
                highlight=False,
                soft_wrap=True,
            )
            raise typer.Exit(UsageError.exit_code) from error


_PATH_ERRORS = (FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)
"""What the system says of a path that cannot be what it was given for."""


def _path_message(error: OSError) -> str:
    return f"{error.filename2 or error.filename} cannot be used: {error.strerror}. Give another path"


app = typer.Typer(
    cls=Commands,
    help="What does a robot policy still know, where inside it, and where on the way to the action is it lost?",
    epilog="Start with `probe-kit demo`. Exit codes: 0 done, 1 not what was asked, 2 wrong usage, 3 refused, "
    "130 interrupted with everything finished so far kept.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(suite_app, name="suite")
app.add_typer(run_app, name="run")
app.command()(extract)
app.command()(export)


def main() -> None:
    """Entry point; a SIGTERM counts as Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    app()


# -- demo ------------------------------------------------------------------------------------------------------


@app.command()
def demo(
    out_folder: Annotated[Path, typer.Option("--out", help="Folder for everything the demo makes.")] = Path(
        "probe-kit-demo"
    ),
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Test the instrument instead: policies of which the truth is known, expected beside measured.",
        ),
    ] = False,
) -> None:
    """Run the whole pipeline on the embedded default: episodes, activations, probes, retention.

    Takes under 5 minutes on 2 cores and downloads nothing. With --compare it does so for three policies and
    takes three times as long.
    """
    from probe_kit.demo import compare_organisms, run_demo

    if compare:
        from probe_kit.organisms import to_rich

        with progress() as bar:
            findings = compare_organisms(out_folder, lambda stage: counter(bar, stage))
        out.print(to_rich(findings))
        if not all(finding.agrees for finding in findings):
            raise typer.Exit(1)
        return
    with progress() as bar:
        made = run_demo(out_folder, lambda stage: counter(bar, stage))
    out.print(made.table.to_rich())
    out.print(made.next_steps(), highlight=False, soft_wrap=True)


# -- models ----------------------------------------------------------------------------------------------------


@app.command()
def models(
    name: Annotated[str | None, typer.Argument(help="Show one model only.")] = None,
    run: Annotated[str | None, typer.Option(help="Show the certificate of this run instead.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """List the models that can be run: checkpoints, streams, what this machine lacks for them."""
    if run is not None:
        from probe_kit.extract import open_run

        print_json(open_run(run, allow_partial=True).certificate)
        return
    rows = _model_rows(name)
    if as_json:
        print_json(rows)
        return
    for row in rows:
        out.print(f"[bold]{row['model']}[/]  {escape(row['description'])}", highlight=False)
        for key in ("checkpoint", "streams", "embodiment", "ready", "notes"):
            if row[key]:
                out.print(f"  [dim]{key:10}[/] {escape(row[key])}", highlight=False, soft_wrap=True)


def _model_rows(name: str | None) -> list[dict[str, str]]:
    from probe_kit.extract.play.controllers import SCRIPTED
    from probe_kit.hooks.registry import families, find_family

    chosen = list(families().values())
    if name is not None:
        chosen = [] if name in SCRIPTED else [find_family(name, tuple(SCRIPTED))]
    rows = [
        {
            "model": family.name,
            "description": family.description,
            "checkpoint": family.default_checkpoint or "embedded",
            "streams": family.streams,
            "embodiment": family.embodiment,
            "ready": f"needs {family.missing()}" if family.missing() else "yes",
            "notes": family.notes,
        }
        for family in chosen
    ]
    scripted = {"checkpoint": "", "streams": "", "embodiment": "", "ready": "yes", "notes": "no activations"}
    rows += [
        {"model": model, "description": text, **scripted}
        for model, text in SCRIPTED.items()
        if name in (None, model)
    ]
    return rows


# -- verify ----------------------------------------------------------------------------------------------------


@app.command()
def verify(
    family: Annotated[str, typer.Argument(help="A family of `probe-kit models`.")],
    folder: Annotated[Path | None, typer.Argument(help="Golden reference: checkpoint/ and reference.npz.")] = None,
    keys: Annotated[Path | None, typer.Option(help="Recorded key list of the full-size model.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """Compare an adapter with outputs recorded from the model's original implementation.

    Exit code 1 if anything is over its tolerance. What the adapter cannot produce is listed, never passed.
    """
    from probe_kit.hooks.verify import verify_keys, verify_reference

    if (folder is None) == (keys is None):
        raise UsageError("give either a golden reference folder or --keys FILE")
    verification = verify_keys(family, keys) if keys else verify_reference(family, cast("Path", folder))
    if as_json:
        print_json(verification.to_json())
    else:
        _print_verification(verification)
    raise typer.Exit(0 if verification.passed else 1)


def _print_verification(verification: "Verification") -> None:
    from rich.table import Table

    colours = {"ok": "green", "over": "red", "not compared": "yellow"}
    table = Table("output", "max abs error", "tolerance", "", "note", title=f"{verification.family}")
    for c in verification.comparisons:
        error = "-" if c.error is None else f"{c.error:.2e}"
        status = f"[{colours[c.status]}]{c.status}[/]"
        table.add_row(c.output, error, f"{c.tolerance:.0e}", status, escape(c.note))
    out.print(table)


# -- train -----------------------------------------------------------------------------------------------------


@app.command()
def train(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    categories: Annotated[
        str | None, typer.Option(help="Comma-separated; default each of the run. all: every episode pooled.")
    ] = None,
    views: Annotated[
        str, typer.Option(help="Comma-separated: mean, last, mean:language …, tokens, tokens:ROLE.")
    ] = "mean",
    permutations: Annotated[int, typer.Option(help="Relabellings behind the p-values.", min=0)] = 200,
    token_permutations: Annotated[int, typer.Option(help="Relabellings for token views.", min=0)] = 59,
    target: Annotated[
        str, typer.Option(help="correct: side of the right picture. chosen: side placed. shuffled: control.")
    ] = "correct",
    controls: Annotated[
        str | None, typer.Option(help="Comma-separated baselines: position, instruction, pixels.")
    ] = None,
    suite: Annotated[Path | None, typer.Option(help="Folder of the run's suite, for pixels.")] = None,
    twin: Annotated[
        str | None, typer.Option(help="Run of the same episodes to subtract, usually by random weights.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of folds and relabellings.")] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(help="Processes that share the sites; default 1, with --ray one for every core.", min=1),
    ] = None,
    ray: Annotated[str | None, typer.Option(help="Share the sites on a Ray cluster: ADDRESS or auto.")] = None,
    device: Annotated[str | None, typer.Option(help="Solve with torch there, such as cuda; one process.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Fit logistic probes at every site and store their scores in the run.

    Nested, grouped cross-validation; p-values by relabelling whole items. Same settings are read back.
    """
    from probe_kit.extract import open_run
    from probe_kit.train import train_probes

    opened = open_run(run, allow_partial=partial)
    with progress() as bar:
        results = train_probes(
            opened,
            split(categories),
            split(views) or ("mean",),
            permutations=permutations,
            token_permutations=token_permutations,
            target=_target(target),
            controls=_baselines(controls),
            suite=suite,
            twin=None if twin is None else open_run(twin, allow_partial=partial),
            seed=seed,
            jobs=jobs,
            device=device,
            ray=ray,
            progress=counter(bar, "sites"),
        )
    _print_peaks(results, opened.random_weights)
    err.print(f"next: [bold]probe-kit retention {run}[/]", highlight=False, soft_wrap=True)


def _baselines(names: str | None) -> "tuple[Baseline, ...]":
    from probe_kit.train import BASELINES

    for name in split(names) or ():
        if name not in BASELINES:
            raise UsageError(f"unknown control {name!r}; expected some of {', '.join(BASELINES)}")
    return cast("tuple[Baseline, ...]", split(names) or ())


def _target(name: str) -> "Target":
    from probe_kit.train import TARGETS

    for target in TARGETS:
        if name == target:
            return cast("Target", target)
    raise UsageError(f"unknown target {name!r}; expected one of {', '.join(TARGETS)}")


def _print_peaks(results: "ProbeResults", random_weights: bool) -> None:
    from rich import box
    from rich.table import Table

    mark = ", RANDOM WEIGHTS" if random_weights else ""
    peaks = results.scores.sort_values("accuracy", ascending=False, kind="stable")
    for view, of_view in peaks.groupby("view", sort=False):
        columns = ("category", "best site", "accuracy % [95 %]", "family-wise p", "n")
        table = Table(*columns, title=f"best site per stream, view {view}{mark}", box=box.SIMPLE_HEAD)
        for _, rows in of_view.groupby(["category", "stream"]):
            best = rows.iloc[0]
            accuracy = f"{100 * best['accuracy']:.1f} [{100 * best['ci_low']:.1f}, {100 * best['ci_high']:.1f}]"
            table.add_row(best["category"], best["site"], accuracy, f"{best['p_fwe']:.3f}", str(best["n"]))
        out.print(table)


# -- retention -------------------------------------------------------------------------------------------------


@app.command()
def retention(
    runs: Annotated[list[str] | None, typer.Argument(help="One or more run folders or URLs.")] = None,
    group: Annotated[
        list[str] | None, typer.Option(help="NAME=RUN,RUN: compare groups of runs, such as co-trained or not.")
    ] = None,
    style: Annotated[str, typer.Option("--format", help="table, json, csv, markdown or latex.")] = "table",
    views: Annotated[str | None, typer.Option(help="Comma-separated; default all probed ones.")] = None,
    iterations: Annotated[
        str, typer.Option(help="Expert iterations or action tokens that count: all, last or a number.")
    ] = "all",
    epsilons: Annotated[
        str | None, typer.Option(help="Zone radii in metres at which SR is scored again, from stored positions.")
    ] = None,
    html: Annotated[Path | None, typer.Option(help="File for a report to look at, without network.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for all figures, as PNG and PDF.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Accept runs that are not finished.")] = False,
) -> None:
    """Print success rates and how much of the backbone's signal reaches the action expert."""
    from probe_kit.env.outcome import SENSITIVITY_RADII
    from probe_kit.extract import open_run
    from probe_kit.retention import retention as make_table

    if style not in _FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(_FORMATS)}")
    if bool(runs) == bool(group):
        raise UsageError("give run folders, or groups of them as --group NAME=RUN,RUN")
    grouped = _groups(group) if group else {"": tuple(runs or ())}
    _refuse_doubles([path for paths in grouped.values() for path in paths])
    radii = SENSITIVITY_RADII if epsilons is None else [_radius(part) for part in split(epsilons) or ()]
    opened = {name: [open_run(p, allow_partial=partial) for p in paths] for name, paths in grouped.items()}
    table = make_table(
        opened if group else opened[""], split(views), iterations=_iterations(iterations), epsilons=radii
    )
    if style == "table":
        out.print(table.to_rich())
    else:
        typer.echo(getattr(table, f"to_{style}")())
    listed = [run for of_group in opened.values() for run in of_group]
    if figures is not None:
        _save_figures(listed, table, figures)
    if html is not None:
        from probe_kit.retention.report import write_report

        with err.status("drawing the report"):
            written = write_report(listed, html, table)
        err.print(f"report: {written}", highlight=False, soft_wrap=True)


def _groups(texts: list[str]) -> dict[str, tuple[str, ...]]:
    groups = {}
    for text in texts:
        name, separator, paths = text.partition("=")
        if not (separator and name and split(paths)):
            raise UsageError(f"--group {text!r} is not NAME=RUN,RUN")
        if name in groups:
            raise UsageError(f"--group {name!r} is given twice; write all of its runs after one {name}=")
        groups[name] = split(paths) or ()
    return groups


def _refuse_doubles(paths: list[str]) -> None:
    """A run that counts twice makes every interval too narrow."""
    seen: set[str] = set()
    for path in paths:
        place = path.rstrip("/") if "://" in path else str(Path(path).resolve())
        if place in seen:
            raise UsageError(f"{path} is given twice; its episodes would count twice. Leave one out")
        seen.add(place)


def _radius(text: str) -> float:
    try:
        radius = float(text)
    except ValueError:
        raise UsageError(f"{text!r} is not a number of metres") from None
    if not 0 < radius < inf:
        raise UsageError(f"a zone radius is {text} m; expected a positive number")
    return radius


def _iterations(text: str) -> "Iterations":
    if text.isdigit():
        return int(text)
    if text not in ("all", "last"):
        raise UsageError(f"iterations {text!r}; expected all, last or a number")
    return cast("Iterations", text)


_FORMATS = ("table", "json", "csv", "markdown", "latex")


def _save_figures(runs: "list[Run]", table: "RetentionTable", folder: Path) -> None:
    from probe_kit.retention.displays import gallery, save_figures

    for path in save_figures(gallery(runs, table), folder):
        err.print(f"figure: {path}", highlight=False, soft_wrap=True)


# -- doctor ----------------------------------------------------------------------------------------------------


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """Say what works on this machine, and what to do about the rest; exit 1 if the demo could not run."""
    from probe_kit.doctor import examine

    with err.status("looking around"):
        findings = examine()
    if as_json:
        print_json([finding.to_json() for finding in findings])
    else:
        _print_findings(findings)
    raise typer.Exit(1 if any(finding.state == "missing" for finding in findings) else 0)


def _print_findings(findings: "list[Finding]") -> None:
    from rich.table import Table

    colours = {"ok": "green", "note": "yellow", "missing": "red"}
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        advice = f"\n[dim]{escape(finding.advice)}[/]" if finding.advice else ""
        mark = f"[{colours[finding.state]}]{finding.state}[/]"
        table.add_row(mark, finding.subject, escape(finding.seen) + advice)
    out.print(table)
