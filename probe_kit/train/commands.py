"""`probe-kit train`, and how `probe-kit run show` lists what it stored."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.text import Text

from probe_kit._terminal.console import counter, marked, out, progress, say, split
from probe_kit._terminal.responsive_table import Cell, FittingTable, Part
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

    from probe_kit.train import Baseline, FoldUnit, Incomplete, ProbeResults, RunReader, Target
    from probe_kit.train.results.inventory import Inventory, StoredProbes


def train(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    categories: Annotated[
        str | None, typer.Option(help="Comma-separated; default each of the run. all: every episode pooled.")
    ] = None,
    views: Annotated[
        str, typer.Option(help="Comma-separated: mean, last, mean:language …, tokens, tokens:ROLE.")
    ] = "mean",
    permutations: Annotated[
        int, typer.Option(help="Relabellings behind the p-values.", min=0, max=1_000_000)
    ] = 200,
    token_permutations: Annotated[
        int, typer.Option(help="Relabellings for token views.", min=0, max=1_000_000)
    ] = 59,
    target: Annotated[
        str, typer.Option(help="correct: side of the right picture. chosen: side placed. shuffled: control.")
    ] = "correct",
    folds: Annotated[
        str, typer.Option(help="groups, or concepts: items about the same two concepts stay together too.")
    ] = "groups",
    incomplete: Annotated[
        str, typer.Option(help="Items of which an episode is missing: keep the other, or drop it too.")
    ] = "keep",
    controls: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: position, instruction, pixels, binding, or none. Default binding, if the "
            "suite is at hand: --suite, or the embedded one."
        ),
    ] = None,
    suite: Annotated[Path | None, typer.Option(help="Folder of the run's suite, for pixels and binding.")] = None,
    untrained: Annotated[
        str | None, typer.Option(help="Run of the same episodes to subtract, usually by random weights.")
    ] = None,
    call: Annotated[
        str,
        typer.Option(
            help="Captured inferences to probe, counted from 0 and comma-separated, or all; see extract "
            "--captured-calls."
        ),
    ] = "0",
    wording: Annotated[
        str | None, typer.Option(help="Of a run with several wordings: the one to probe; default its first.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of folds and relabellings.")] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(
            help="Processes that share the sites; default 1, with --ray one for every core.", min=1, max=1024
        ),
    ] = None,
    ray: Annotated[str | None, typer.Option(help="Share the sites on a Ray cluster: ADDRESS or auto.")] = None,
    device: Annotated[str | None, typer.Option(help="Solve with torch there, such as cuda; one process.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Fit logistic probes at every site and store their scores in the run.

    Nested, grouped cross-validation; p-values by relabelling groups of items. Same settings are read back.
    """
    from probe_kit.extract import open_run
    from probe_kit.train import FOLD_UNITS, INCOMPLETE, TARGETS, train_probes
    from probe_kit.train.controls.baselines import embedded_suite_of

    asked, baselines = cast("Target", _one_of("target", target, TARGETS)), _baselines(controls)
    units = cast("FoldUnit", _one_of("folds", folds, FOLD_UNITS))
    rest = cast("Incomplete", _one_of("incomplete", incomplete, INCOMPLETE))
    opened = open_run(run, allow_partial=partial).in_wording(wording)
    beside = None if untrained is None else open_run(untrained, allow_partial=partial).in_wording(wording)
    pictures = suite or embedded_suite_of(opened)
    for number in _calls(call, opened):
        with progress() as bar:
            results = train_probes(
                opened,
                split(categories),
                split(views) or (),
                permutations=permutations,
                token_permutations=token_permutations,
                target=asked,
                call=number,
                folds=units,
                incomplete=rest,
                controls=baselines if baselines is not None else _default_controls(pictures),
                suite=pictures,
                untrained=beside,
                seed=seed,
                jobs=jobs,
                device=device,
                ray=ray,
                progress=counter(bar, f"sites, call {number}" if number else "sites"),
            )
        _print_peaks(results, opened.random_weights)
    if not results.controls.excess:
        say("signal is judged against chance only: give --suite, or --untrained with a run of random weights")
    say(marked("next: [bold]probe-kit retention {}[/]", run))


def facts_table(found: "Inventory", further: Mapping[str, str]) -> "Table":
    """A run and what is stored with it. further: lines below, by name."""
    from rich.table import Table

    from probe_kit.extract.store.locations.summary import NOT_PROTECTED

    missing = found.planned - found.episodes
    outcomes = ", ".join(f"{name} {count}" for name, count in found.outcomes.items())
    facts = {
        "run": found.run,
        "model": found.model + (" (random weights)" if found.random_weights else ""),
        "weights": (found.weights_sha256 or "none (scripted)")[:12],
        "suite": found.suite,
        "settings": found.settings_sha256[:12],
        "episodes": f"{found.episodes} of {found.planned}" * (missing > 0) or str(found.episodes),
        "wordings": ", ".join(f"{name} {count}" for name, count in found.wordings.items()),
        "failed": str(found.failed or ""),
        "integrity": "" if found.protected else NOT_PROTECTED,
        "outcomes": outcomes,
        "categories": ", ".join(found.categories),
        **found.streams,
        **{f"probes {probes.key}": _probes_in_words(probes, found) for probes in found.probes},
        **{
            f"unfinished {key}": f"a sweep of {sites} sites so far; the same `probe-kit train` continues it"
            for key, sites in found.unfinished.items()
        },
        **further,
    }
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        if value:
            table.add_row(name, Text(value))
    return table


_STATES = {
    "used": "what `probe-kit retention` reads: the probes asked for last",
    "other": "read with --probes RUN=KEY",
    "other episodes": "of other episodes than the run has now",
    "other version": "written by another version of probe_kit, which this one cannot read",
}


def _probes_in_words(probes: "StoredProbes", found: "Inventory") -> str:
    state, fitted = _STATES[probes.state], f"fitted {probes.created[:16].replace('T', ' ')} UTC"
    if not probes.views:
        return f"{state}; {fitted}"
    parts = [f"{state}; views {', '.join(probes.views)}", f"target {probes.target}"]
    parts += [f"{probes.permutations} relabellings"]
    parts += [f"{probes.token_permutations} for tokens"] * (probes.token_permutations > 0)
    parts += [f"seed {probes.seed}"]
    parts += [f"captured inference {probes.call}"] * (probes.call > 0)
    parts += [f"wording {probes.wording}"] * bool(probes.wording)
    parts += [f"only {', '.join(probes.categories)}"] * (probes.categories != found.categories)
    parts += [f"controls {', '.join(probes.controls)}"] * bool(probes.controls)
    return "; ".join([*parts, fitted])


def _calls(text: str, run: "RunReader") -> list[int]:
    """The captured inferences that were asked for, each once."""
    from probe_kit.train.data.captured_call import captured_calls

    if text == "all":
        return list(range(captured_calls(run)))
    found = split(text) or ()
    if not found or not all(part.isdecimal() for part in found):
        raise UsageError(f"--call {text!r}; expected numbers from 0, comma-separated, or all")
    return list(dict.fromkeys(map(int, found)))


def _baselines(names: str | None) -> "tuple[Baseline, ...] | None":
    """None for the default."""
    from probe_kit.train import BASELINES

    if names is None:
        return None
    if names == "none":
        return ()
    return tuple(cast("Baseline", _one_of("control", name, BASELINES)) for name in split(names) or ())


def _default_controls(suite: Path | None) -> "tuple[Baseline, ...]":
    return () if suite is None else ("binding",)


def _one_of(what: str, name: str, known: Mapping[str, str]) -> str:
    if name not in known:
        raise UsageError(f"unknown {what} {name!r}; expected one of {', '.join(known)}")
    return name


def _print_peaks(results: "ProbeResults", random_weights: bool) -> None:
    from probe_kit.train.results.summary import SITE_HEADINGS, best_sites

    mark = ", RANDOM WEIGHTS" if random_weights else ""
    mark += f", call {results.settings.call}"
    peaks = best_sites(results.scores).sort_values(["category", "stream"], kind="stable")
    for view in results.settings.views:
        best = [row for _, row in peaks[peaks["view"] == view].iterrows()]
        headings = (*SITE_HEADINGS, "beats", "n")
        table = FittingTable(
            title=f"Best site per stream, view {view}{mark}",
            caption="+: as many other sites tie with it",
            name="category",
            names=tuple(str(row["category"]) for row in best),
            styles=("",) * len(best),
            parts=(Part("Best sites", headings, tuple(_peak_cells(row) for row in best)),),
        )
        out.print(table)


def _peak_cells(row: "pd.Series") -> tuple[Cell, ...]:
    from probe_kit.train.results.summary import site_cells

    return tuple(map(Cell, (*site_cells(row), _beats(row), str(row["n"]))))


def _beats(best: "pd.Series[Any]") -> str:
    """What a site is better than, of what was tried."""
    from pandas import isna

    from probe_kit.statistics.significance import SIGNIFICANCE

    chance = None if isna(best["p_fwe"]) else best["p_fwe"] < SIGNIFICANCE
    tried = {"chance": chance, "binding": best["beats_binding"], "untrained": best["beats_untrained"]}
    found = [name if better else f"not {name}" for name, better in tried.items() if not isna(better)]
    return ", ".join(found) or "–"
