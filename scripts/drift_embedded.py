"""What learning to act did to the VLM's backbone: `python scripts/drift_embedded.py OUT BEFORE AFTER`.

BEFORE: a policy whose backbone is the VLM's, weight by weight, as `train_embedded_policy.py` begins (its
`OUT/start`). AFTER: one that was trained from it. Both get the same first frames and instructions and do not act.
Per category and layer: how alike their streams are (linear CKA), how well a probe finds the side of the asked
picture in either, and how well the probe of BEFORE does on AFTER. Finished runs are reused.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from probe_kit._terminal.console import counter, progress
from probe_kit.env import SceneSpec
from probe_kit.extract import ExtractSettings, Run, extract_run
from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.folds import Fold, grouped_folds
from probe_kit.suite import build_suite

CATEGORIES = ("color", "shape", "state", "traffic", "counting")
LAYERS = range(4)
FOLDS = 5
REGULARISATION = 0.1
"""Of the probes: C, on standardised features."""
Features = NDArray[np.float64]


def main(
    out: Annotated[Path, typer.Argument(help="Folder for suite and runs.")],
    before: Annotated[Path, typer.Argument(help="Checkpoint.")],
    after: Annotated[Path, typer.Argument(help="Checkpoint.")],
    items: Annotated[int, typer.Option(help="Per category, each in two layouts.")] = 60,
    view: Annotated[str, typer.Option(help="Of the backbone's tokens.")] = "mean:language",
    suite_version: Annotated[int, typer.Option(help="Of the embedded suite: 1 or 2.")] = 2,
    suite_seed: Annotated[int, typer.Option(help="Of the embedded suite.")] = 0,
) -> None:
    """Capture, compare, print."""
    with progress() as bar:
        name = f"suite-{suite_version}-{suite_seed}-{items}"
        suite = build_suite(out / name, CATEGORIES, items, suite_seed, counter(bar, "suite"), suite_version)
        runs = [_heard(out / name, suite.folder, place, counter(bar, place.name)) for place in (before, after)]
    typer.echo(
        f"| category | layer | CKA | {before.name}: probe % | {after.name}: probe % | first probe on second % |"
    )
    typer.echo("| --- | --- | --- | --- | --- | --- |")
    for category in CATEGORIES:
        for layer in LAYERS:
            cells = _compared(runs, category, Site("backbone", layer=layer), view)
            typer.echo(
                f"| {category} | {layer} | {cells[0]:.2f} | {' | '.join(f'{100 * c:.1f}' for c in cells[1:])} |"
            )


def _heard(out: Path, suite: Path, checkpoint: Path, count: object) -> Run:
    settings = ExtractSettings(
        "pi0-tiny",
        str(checkpoint),
        suite=suite,
        scene=SceneSpec.preset("act2answer"),
        capture_only=True,
        frames="none",
    )
    return extract_run(settings, out.with_name(f"{out.name}-{checkpoint.name}"), count)  # type: ignore[arg-type]


def _compared(runs: list[Run], category: str, site: Site, view: str) -> tuple[float, float, float, float]:
    """CKA, accuracy in the first run, in the second, and of the first run's probes on the second."""
    episodes = runs[0].episodes
    if list(episodes["episode_id"]) != list(runs[1].episodes["episode_id"]):
        raise typer.BadParameter("the two runs hold other episodes; give another OUT")
    rows = np.flatnonzero(episodes["category"] == category)
    first, second = (run.column(site, view)[rows].astype(np.float64) for run in runs)
    right = (episodes["side_correct"].to_numpy()[rows] == "right").astype(int)
    folds = grouped_folds(right, episodes["group_id"].to_numpy()[rows], FOLDS, seed=0)
    return (
        linear_cka(first, second),
        _accuracy(folds, right, first, first),
        _accuracy(folds, right, second, second),
        _accuracy(folds, right, first, second),
    )


def linear_cka(first: Features, second: Features) -> float:
    """How alike two sets of features (E, D1) and (E, D2) of the same episodes are: 1 up to turning and scaling."""
    first, second = first - first.mean(0), second - second.mean(0)
    shared = np.linalg.norm(first.T @ second) ** 2
    return float(shared / (np.linalg.norm(first.T @ first) * np.linalg.norm(second.T @ second)))


def _accuracy(folds: list[Fold], right: NDArray[np.int_], learned: Features, judged: Features) -> float:
    """Of a probe trained on `learned` without a fold, in that fold of `judged`; units are those of `learned`."""
    hits = []
    for fold in folds:
        mean, spread = learned[fold.train].mean(0), learned[fold.train].std(0) + 1e-6
        probe = LogisticRegression(C=REGULARISATION, max_iter=2000)
        probe.fit((learned[fold.train] - mean) / spread, right[fold.train])
        hits.append(probe.predict((judged[fold.test] - mean) / spread) == right[fold.test])
    return float(np.concatenate(hits).mean())


if __name__ == "__main__":
    typer.run(main)
