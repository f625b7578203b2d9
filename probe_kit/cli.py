"""The `probe-kit` command. It parses, calls the library and prints; tables go to stdout, progress to stderr."""

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
import typer.core
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from probe_kit.errors import ProbeKitError, UsageError

if TYPE_CHECKING:
    from probe_kit.extract import Extraction, Run
    from probe_kit.train import ProbeResults, Target

INTERRUPTED = 130

out, err = Console(), Console(stderr=True)


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


app = typer.Typer(
    cls=Commands,
    help="What does a robot policy still know, where inside it, and where on the way to the action is it lost?",
    epilog="Start with `probe-kit demo`. Exit codes: 0 done, 1 not what was asked, 2 wrong usage, 3 refused, "
    "130 interrupted with everything finished so far kept.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
suite_app = typer.Typer(help="Build and look at suites of questions.", no_args_is_help=True)
app.add_typer(suite_app, name="suite")


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
) -> None:
    """Run the whole pipeline on the embedded default: episodes, activations, probes, retention.

    Takes under 5 minutes on 2 cores and downloads nothing.
    """
    from probe_kit.demo import run_demo

    with _progress() as bar:
        made = run_demo(out_folder, lambda stage: _counter(bar, stage))
    out.print(made.table.to_rich())
    out.print(made.next_steps(), highlight=False, soft_wrap=True)


# -- models ----------------------------------------------------------------------------------------------------


@app.command()
def models(
    name: Annotated[str | None, typer.Argument(help="Show one model only.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """List the models that can be run, their default checkpoints and what they need."""
    from rich.table import Table

    from probe_kit.extract.controllers import SCRIPTED
    from probe_kit.hooks.registry import families, find_family

    if name is None:
        chosen = list(families().values())
    else:
        chosen = [] if name in SCRIPTED else [find_family(name, tuple(SCRIPTED))]
    rows = [
        {"model": f.name, "checkpoint": f.default_checkpoint or "embedded", "description": f.description}
        | {"streams": "backbone, expert", "notes": f.notes}
        for f in chosen
    ]
    rows += [
        {"model": scripted, "checkpoint": "-", "description": text, "streams": "none", "notes": "no activations"}
        for scripted, text in SCRIPTED.items()
        if name in (None, scripted)
    ]
    if as_json:
        _print_json(rows)
        return
    table = Table("model", "default checkpoint", "what it is", "streams", "notes")
    for row in rows:
        table.add_row(row["model"], row["checkpoint"], row["description"], row["streams"], row["notes"])
    out.print(table)


# -- suite -----------------------------------------------------------------------------------------------------


@suite_app.command("build")
def suite_build(
    folder: Annotated[Path, typer.Argument(help="New folder for the suite.")],
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all embedded ones.")] = None,
    n: Annotated[int, typer.Option("--n", help="Items per category, even: items come as twins.")] = 150,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
) -> None:
    """Draw the embedded suite into FOLDER."""
    from probe_kit.suite import build_suite

    with _progress() as bar:
        suite = build_suite(folder, _split(categories), n, seed, progress=_counter(bar, "drawing items"))
    out.print(f"{suite.identity}: {len(suite.items)} items, {2 * len(suite.items)} episodes in {folder}")


@suite_app.command("show")
def suite_show(
    folder: Annotated[Path | None, typer.Argument(help="Suite folder; default the embedded suite.")] = None,
    out_folder: Annotated[Path, typer.Option("--out", help="Folder for the pictures.")] = Path("suite-sheets"),
) -> None:
    """Write a contact sheet per category: pairs, instructions, the correct picture framed."""
    from probe_kit.suite import contact_sheets, default_suite, load_suite

    suite = default_suite() if folder is None else load_suite(folder)
    for path in contact_sheets(suite, out_folder):
        out.print(str(path), highlight=False, soft_wrap=True)


@suite_app.command("list")
def suite_list(
    folder: Annotated[Path | None, typer.Argument(help="Suite folder; default the embedded suite.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """List the categories of a suite with their item counts."""
    from rich.table import Table

    from probe_kit.suite import CATEGORIES, default_suite, load_suite

    suite = default_suite() if folder is None else load_suite(folder)
    counts = {c: sum(item.category == c for item in suite.items) for c in suite.categories}
    if as_json:
        _print_json({"suite": suite.identity, "items": counts})
        return
    table = Table("category", "title", "domain", "items", "episodes", title=suite.identity)
    for slug, count in counts.items():
        category = CATEGORIES[slug]
        table.add_row(slug, category.title, category.domain, str(count), str(2 * count))
    out.print(table)


# -- extract ---------------------------------------------------------------------------------------------------


@app.command()
def extract(
    model: Annotated[str, typer.Option(help="A model of `probe-kit models`, or expert, expert-mirrored.")],
    out_folder: Annotated[
        Path | None, typer.Option("--out", help="Run folder; default runs/<model>-<settings hash>.")
    ] = None,
    checkpoint: Annotated[str | None, typer.Option(help="Folder or hub id; default the family's.")] = None,
    random_weights: Annotated[
        bool, typer.Option("--random-weights", help="Untrained twin of the same architecture, as a control.")
    ] = False,
    suite: Annotated[Path | None, typer.Option(help="Suite folder; default the embedded suite.")] = None,
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the suite.")] = None,
    items: Annotated[int | None, typer.Option(help="Items per category, even; default all.")] = None,
    scene: Annotated[str, typer.Option(help="Scene preset: bridge, frontal or vl-think.")] = "bridge",
    max_steps: Annotated[int | None, typer.Option(help="Actions per episode, at 5 Hz.")] = None,
    tokens: Annotated[str, typer.Option(help="pooled: views only. all: every token too (large).")] = "pooled",
    captured_calls: Annotated[int, typer.Option(help="Inferences captured per episode.")] = 1,
    execute: Annotated[
        int | None, typer.Option(help="Actions executed per inference; default the model's.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of cube places and policy noise.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 …")] = "cpu",
    dtype: Annotated[str | None, typer.Option(help="float32 or bfloat16; default the checkpoint's.")] = None,
    codec: Annotated[str, typer.Option(help="zstd, fast or none.")] = "zstd",
    video: Annotated[str, typer.Option(help="GIF of the first episode, of all, or none.")] = "none",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan and stop.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Start even if the disk looks too small.")] = False,
) -> None:
    """Let a model act in every episode and store its residual streams.

    The same command continues an interrupted run; other settings in the same folder are refused.
    """
    from probe_kit.env import SceneSpec
    from probe_kit.extract import ExtractSettings, prepare

    changes = {} if max_steps is None else {"max_steps": max_steps}
    settings = ExtractSettings(
        model=model,
        checkpoint=checkpoint,
        random_weights=random_weights,
        suite=suite,
        categories=_split(categories),
        items=items,
        scene=SceneSpec.preset(scene, **changes),
        seed=seed,
        tokens=tokens,
        captured_calls=captured_calls,
        execute=execute,
        codec=codec,
        device=device,
        dtype=dtype,
        video=video,
    )
    with err.status("loading suite and model"):
        extraction = prepare(settings)
    folder = out_folder or Path("runs") / extraction.default_name()
    _print_plan(extraction, folder)
    if dry_run:
        return
    with _progress() as bar:
        run = extraction.run(folder, force=force, progress=_counter(bar, "episodes"))
    _print_outcomes(run)


def _print_plan(extraction: "Extraction", folder: Path) -> None:
    from rich.table import Table

    plan, identity = extraction.plan, extraction.identity()
    weights = (identity["weights_sha256"] or "scripted")[:12]
    rows = {
        "model": f"{identity['model']}  weights {weights}" + ("  RANDOM" if identity["random_weights"] else ""),
        "suite": plan.suite.identity,
        "categories": ", ".join(plan.suite.categories),
        "episodes": f"{len(plan.episodes)} ({len(plan.suite.items)} items in both layouts)",
        "streams": "; ".join(_describe(s) for s in plan.streams) or "none",
        "activations": f"{plan.sites} sites, {plan.bytes / 1e6:,.1f} MB before compression",
        "run": str(folder),
    }
    table = Table(show_header=False, title="plan", box=None)
    for name, value in rows.items():
        table.add_row(f"[dim]{name}[/]", value)
    err.print(table)


def _describe(stored: Any) -> str:
    steps = f" x {stored.iterations} iterations" if stored.iterations else ""
    return f"{stored.name} {stored.layers} layers{steps} x {stored.tokens} tokens x {stored.width}"


def _print_outcomes(run: "Run") -> None:
    counts = run.episodes["outcome"].value_counts()
    text = ", ".join(f"{name} {count}" for name, count in counts.items())
    err.print(f"{len(run.episodes)} episodes: {text}", highlight=False)
    step = "retention" if not run.streams else "train"
    err.print(f"next: [bold]probe-kit {step} {run.path}[/]", highlight=False, soft_wrap=True)
    out.print(str(run.path), highlight=False, soft_wrap=True)


# -- train -----------------------------------------------------------------------------------------------------


@app.command()
def train(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    categories: Annotated[str | None, typer.Option(help="Comma-separated; default all of the run.")] = None,
    views: Annotated[str, typer.Option(help="Comma-separated pooled views: mean, last, mean:language …")] = "mean",
    permutations: Annotated[int, typer.Option(help="Relabellings behind the p-values.")] = 200,
    target: Annotated[
        str, typer.Option(help="correct: side of the right picture. chosen: side placed. shuffled: control.")
    ] = "correct",
    seed: Annotated[int, typer.Option(help="Seed of folds and relabellings.")] = 0,
    jobs: Annotated[int | None, typer.Option(help="Sites probed at a time; default one per core.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Fit logistic probes at every site and store their scores in the run.

    Nested, grouped cross-validation; p-values by relabelling whole items. Same settings are read back.
    """
    from probe_kit.extract import open_run
    from probe_kit.train import train_probes

    opened = open_run(run, allow_partial=partial)
    with _progress() as bar:
        results = train_probes(
            opened,
            _split(categories),
            _split(views) or ("mean",),
            permutations=permutations,
            target=_target(target),
            seed=seed,
            jobs=jobs,
            progress=_counter(bar, "sites"),
        )
    _print_peaks(results, opened.random_weights)
    err.print(f"next: [bold]probe-kit retention {run}[/]", highlight=False, soft_wrap=True)


def _print_peaks(results: "ProbeResults", random_weights: bool) -> None:
    from rich.table import Table

    mark = "  RANDOM WEIGHTS" if random_weights else ""
    table = Table("category", "view", "stream", "best site", "accuracy", "95 % interval", "family-wise p", "n")
    table.title = f"best site per stream{mark}"
    peaks = results.scores.sort_values("accuracy", ascending=False, kind="stable")
    for names, rows in peaks.groupby(["category", "view", "stream"]):
        best = rows.iloc[0]
        interval = f"{100 * best['ci_low']:.1f} – {100 * best['ci_high']:.1f}"
        accuracy, p = f"{100 * best['accuracy']:.1f} %", f"{best['p_fwe']:.3f}"
        table.add_row(
            *map(str, cast("tuple[str, ...]", names)), best["site"], accuracy, interval, p, str(best["n"])
        )
    out.print(table)


# -- retention -------------------------------------------------------------------------------------------------


@app.command()
def retention(
    runs: Annotated[list[Path], typer.Argument(help="One or more run folders.")],
    style: Annotated[str, typer.Option("--format", help="table, json, csv, markdown or latex.")] = "table",
    views: Annotated[str | None, typer.Option(help="Comma-separated; default all probed ones.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for layer curves as PNG.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Accept runs that are not finished.")] = False,
) -> None:
    """Print success rates and how much of the backbone's signal reaches the action expert."""
    from probe_kit.extract import open_run
    from probe_kit.retention import retention as make_table

    if style not in _FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(_FORMATS)}")
    opened = [open_run(path, allow_partial=partial) for path in runs]
    table = make_table(opened, views=_split(views))
    if style == "table":
        out.print(table.to_rich())
    else:
        typer.echo(getattr(table, f"to_{style}")())
    if figures is not None:
        _save_figures(opened, figures)


_FORMATS = ("table", "json", "csv", "markdown", "latex")


def _save_figures(runs: "list[Run]", folder: Path) -> None:
    from probe_kit.retention.figures import layer_curve
    from probe_kit.train import load_results

    folder.mkdir(parents=True, exist_ok=True)
    for run in runs:
        if run.streams:
            path = folder / f"{run.path.resolve().name}-layer-curves.png"
            layer_curve(load_results(run)).savefig(path)
            err.print(f"figure: {path}", highlight=False, soft_wrap=True)


# -- what the commands share -------------------------------------------------------------------------------------


def _split(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(part.strip() for part in text.split(",") if part.strip())


def _target(name: str) -> "Target":
    from probe_kit.train import TARGETS

    for target in TARGETS:
        if name == target:
            return cast("Target", target)
    raise UsageError(f"unknown target {name!r}; expected one of {', '.join(TARGETS)}")


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))


@contextmanager
def _progress() -> Iterator[Progress]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err) as bar:
        yield bar


def _counter(bar: Progress, description: str) -> Callable[..., None]:
    """A callback (done, total, …) that moves one bar."""
    task = bar.add_task(description, total=None)

    def advance(done: int, total: int, *_: object) -> None:
        bar.update(task, completed=done, total=total)

    return advance
