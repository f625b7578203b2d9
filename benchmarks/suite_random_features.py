"""What an untrained conjunction of pictures and words gets for free on the embedded suite, by category.

    python benchmarks/suite_random_features.py [--items 150] [--seeds 0] [--width 96]
        [--categories …]

Accuracy in % of the control `random-features`: of its five random layers the best one, and their mean, on the
control's own nested folds. No model is asked. Several seeds: other drawings, averaged.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import track
from rich.table import Table
from threadpoolctl import threadpool_limits

from probe_kit.hashing import derive_seed
from probe_kit.hooks import Site
from probe_kit.suite import Suite, build_suite
from probe_kit.train import ArrayRun
from probe_kit.train.control_features import LAYERS, ControlInputs
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.probe_sweep import ProbeSweep
from probe_kit.train.samples import Samples


def main() -> None:
    """Draw the suites, fit the control, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--items", type=int, default=150)
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--width", type=int, default=96, help="units of a random layer; 96 is pi0-tiny's backbone")
    parser.add_argument("--categories", default=None)
    options = parser.parse_args()
    categories = options.categories.split(",") if options.categories else None
    seeds = [int(seed) for seed in options.seeds.split(",")]
    accuracies: dict[str, list[tuple[float, float]]] = {}
    with threadpool_limits(1), TemporaryDirectory() as scratch:
        for seed in seeds:
            suite = build_suite(Path(scratch) / str(seed), categories, options.items, seed)
            for category, scores in free_accuracy(suite, options.width).items():
                accuracies.setdefault(category, []).append(scores)
    table = Table(
        title=f"random-features, {options.items} items, width {options.width}: best and mean of {LAYERS} layers, %"
    )
    for heading in ("category", "accuracy"):
        table.add_column(heading)
    for category, scores in accuracies.items():
        table.add_row(category, _cell(scores))
    Console().print(table)


def free_accuracy(suite: Suite, width: int) -> dict[str, tuple[float, float]]:
    """By category, the accuracy of the best random layer and the mean of all."""
    blank = np.zeros((len(_episodes(suite)), 1), np.float32)
    run = ArrayRun(suite.folder, "none", suite.identity, _episodes(suite), {(Site("backbone", 0), "mean"): blank})
    sweep = ProbeSweep.of(run, "side.correct", None, views=("mean",), permutations=0, seed=0)
    inputs = ControlInputs(run, sweep.samples, True, suite)
    accuracy_by_category = {}
    for category in track(suite.categories, suite.identity, console=Console(stderr=True)):
        problem = sweep.problems[category]
        accuracies = []
        for number in range(LAYERS):
            layer = inputs.layer(problem.positions, width, derive_seed("binding", 0, number))
            decisions = problem.fit(Samples.pooled(layer)).decisions
            accuracies.append(float(correctness(decisions, problem.labels).mean()))
        accuracy_by_category[category] = (max(accuracies), float(np.mean(accuracies)))
    return accuracy_by_category


def _episodes(suite: Suite) -> pd.DataFrame:
    """What a run would know of its episodes before it began."""
    return pd.DataFrame(
        [
            {
                "episode_id": episode.episode_id,
                "item_id": episode.item.item_id,
                "group_id": episode.item.group_id,
                "category": episode.item.category,
                "layout": episode.layout,
                "side_correct": episode.side_correct,
                "instruction": episode.item.instruction,
                "outcome": "oob",
            }
            for episode in suite.episodes()
        ]
    )


def _cell(scores: list[tuple[float, float]]) -> str:
    best, mean = (100 * np.mean(part) for part in zip(*scores, strict=True))
    return f"{best:.1f} ({mean:.1f})"


if __name__ == "__main__":
    main()
