"""Coverage of R² and false alarms of its controls, with trained probes of labels in eight worlds.

    python benchmarks/label_coverage.py [--draws 300] [--seed 0] [--only "24 ar"]

Every draw has a label, two networks that know it equally well, and nested ridge probes as `probe-kit train` fits
them. covered: share of intervals that hold the mean R² of all draws. exceeds: how often one network exceeds the
other at p < 0.05 (`better_than_reference` and `better_than_best`). A draw takes about 50 ms.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.statistics.bootstrap import explained_interval
from probe_kit.statistics.folds import SHARED_TRAINING, stratified_folds
from probe_kit.statistics.paired_tests import SHARED_PROBE, better_than_best, better_than_reference
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.crossval.task_scores import squared_deviations
from probe_kit.train.samples import Samples

Kind = Literal["white", "group", "skewed", "ar"]
WIDTH = 8


@dataclass(frozen=True)
class LabelWorld:
    """groups of `episodes` with `steps` labels each. strength: of the label in the first feature."""

    name: str
    groups: int
    kind: Kind
    strength: float
    episodes: int = 4
    steps: int = 1

    def labels(self, generator: np.random.Generator) -> tuple[Matrix, NDArray[np.intp]]:
        """(n,) labels and groups."""
        count = self.groups * self.episodes * self.steps
        group_of = np.repeat(np.arange(self.groups), self.episodes * self.steps)
        noise = generator.standard_normal(count)
        if self.kind == "white":
            return noise, group_of
        if self.kind == "ar":
            level = np.repeat(generator.standard_normal(self.groups * self.episodes), self.steps)
            trend = np.tile(np.linspace(-0.7, 0.7, self.steps), self.groups * self.episodes)
            return 0.7 * level + trend + 0.5 * noise, group_of
        shared = 0.8 * generator.standard_normal(self.groups)[group_of] + 0.6 * noise
        return (np.exp(0.8 * shared) if self.kind == "skewed" else shared), group_of

    def features(self, labels: Matrix, group_of: NDArray[np.intp], generator: np.random.Generator) -> Matrix:
        """(n, WIDTH) features of a network, a part of them common to a group."""
        features = generator.standard_normal((labels.size, WIDTH))
        features += 0.5 * generator.standard_normal((self.groups, WIDTH))[group_of]
        standard = (labels - labels.mean()) / labels.std()
        features[:, 0] += self.strength * standard
        features[:, 1] += 0.5 * self.strength * standard
        return features


WORLDS = (
    LabelWorld("12 white", 12, "white", 0.7),
    LabelWorld("24 white", 24, "white", 0.7),
    LabelWorld("24 group", 24, "group", 0.7),
    LabelWorld("48 group, weak", 48, "group", 0.5),
    LabelWorld("24 ar", 24, "ar", 0.7, episodes=2, steps=6),
    LabelWorld("48 ar, weak", 48, "ar", 0.4, episodes=2, steps=6),
    LabelWorld("24 group, strong", 24, "group", 3.0),
    LabelWorld("24 skewed", 24, "skewed", 0.7),
)


def draw(world: LabelWorld, seed: int) -> tuple[float, tuple[float, float], bool, bool]:
    """R² of the first network, its interval, and whether it exceeds the second one by either test."""
    generator = np.random.default_rng(seed)
    labels, group_of = world.labels(generator)
    folds = nested_folds(np.zeros(labels.size), group_of, seed, stratified_folds)
    signal_scores, reference_scores = (
        probe_site(Samples.pooled(features), labels, np.empty((labels.size, 0)), folds, "continuous").scores
        for features in (world.features(labels, group_of, generator) for _ in range(2))
    )
    deviations = squared_deviations(labels, [fold.outer for fold in folds])
    interval = explained_interval(signal_scores, deviations, group_of, SHARED_TRAINING)
    above = better_than_reference(signal_scores[None], reference_scores, group_of, seed, SHARED_PROBE)[0]
    best = better_than_best(signal_scores[None], reference_scores[None], group_of, seed, SHARED_PROBE)[0]
    return float(signal_scores.mean()), interval, bool(above < SIGNIFICANCE), bool(best < SIGNIFICANCE)


def rows(worlds: list[LabelWorld], draws: int, seed: int) -> Iterator[tuple[str, ...]]:
    """Cells of the table, a world at a time."""
    for world in worlds:
        drawn = [draw(world, derive_seed("labels", seed, world.name, number)) for number in range(draws)]
        truth = float(np.mean([score for score, *_ in drawn]))
        covered = np.mean([low <= truth <= high for _, (low, high), *_ in drawn])
        width = np.median([high - low for _, (low, high), *_ in drawn])
        reference, best = (np.mean([outcome[at] for outcome in drawn]) for at in (2, 3))
        yield world.name, f"{truth:.2f}", f"{covered:.1%}", f"{width:.2f}", f"{reference:.1%}", f"{best:.1%}"


def main() -> None:
    """Draw every world and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="beginning of a world's name")
    options = parser.parse_args()
    worlds = [world for world in WORLDS if world.name.startswith(options.only)]
    table = Table(
        "world", "R²", "covered", "width", "exceeds a control", "exceeds untrained", title="R² of labels"
    )
    with threadpool_limits(1):
        for cells in rows(worlds, options.draws, options.seed):
            table.add_row(*cells)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
