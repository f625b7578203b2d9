"""`probe-kit train`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from probe_kit.console import counter, err, out, progress, split
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.train import Baseline, ProbeResults, Target


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
