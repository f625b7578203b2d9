"""Power of probes against controls with trained probes, beside what `probe-kit power` simulates.

    python benchmarks/power_trained.py [--items 24,40] [--accuracies 0.65,0.75,0.9] [--draws 100] [--full]

A draw has groups of two items in both layouts, seven sites of which two hold the answer, seven of an untrained
network and five layers of random features without it. All are nested probes as `probe-kit train` fits them. The
strength of the signal is set so that these two sites have the stated held-out accuracy in the mean over draws.
Columns: share of draws in which a site exceeds the mean of the five layers, the best of them, and the untrained
network, trained and simulated. `--full` uses 100 items and 300 draws too. 24 items take half a second a draw.
"""

import argparse
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from probe_kit.hashing import derive_seed
from probe_kit.statistics.paired_tests import better_than_best, better_than_reference
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.control_features import LAYERS
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.power import ALIKE, NEIGHBOURS, simulate
from probe_kit.train.samples import Samples

SITES, CARRIERS, WIDTH = 7, (3, 4), 16
Right = NDArray[np.bool_]


class Experiment:
    """The items of one draw. A part of the signal is common to a group, neighbouring sites are correlated."""

    def __init__(self, items: int, seed: int) -> None:
        self.generator, self.seed = np.random.default_rng(seed), seed
        self.groups, self.labels = np.repeat(np.arange(items // 2), 4), np.tile([True, False], items)
        self.folds = nested_folds(self.labels, self.groups, seed)
        self.side = np.where(self.labels, 1.0, -1.0)

    def sites(self, strengths: list[float]) -> Right:
        """(S, E) whether each held-out decision of the probe of each site is right."""
        noise = np.stack([self._noise() for _ in strengths])
        for at in range(1, len(strengths)):
            noise[at] = NEIGHBOURS * noise[at - 1] + np.sqrt(1 - NEIGHBOURS**2) * noise[at]
        noise[:, :, 0] += np.array(strengths)[:, None] * self.side
        return np.stack([self._right(features) for features in noise])

    def _noise(self) -> NDArray[np.float64]:
        features = self.generator.standard_normal((self.labels.size, WIDTH))
        of_group = self.generator.standard_normal(self.groups[-1] + 1)[self.groups]
        features[:, 0] = np.sqrt(1 - ALIKE) * features[:, 0] + np.sqrt(ALIKE) * self.side * of_group
        return features

    def _right(self, features: NDArray[np.float64]) -> Right:
        nothing = np.empty((self.labels.size, 0), np.bool_)
        decisions = probe_site(Samples.pooled(features), self.labels, nothing, self.folds).decisions
        right: Right = (decisions > 0) == self.labels
        return right


def draw(items: int, strength: float, seed: int) -> tuple[float, float, float, float]:
    """Held-out accuracy of the signal, and p against the mean layer, the best layer and the untrained network."""
    experiment = Experiment(items, seed)
    scores = experiment.sites([strength if at in CARRIERS else 0.0 for at in range(SITES)])
    untrained, layers = (experiment.sites([0.0] * count) for count in (SITES, LAYERS))
    groups, best = experiment.groups, layers[layers.sum(axis=1).argmax()].astype(float)
    return (
        float(scores[list(CARRIERS)].mean()),
        float(better_than_reference(scores, layers.mean(axis=0), groups, seed).min()),
        float(better_than_reference(scores, best, groups, seed).min()),
        float(better_than_best(scores, untrained, groups, seed).min()),
    )


def strength_for(items: int, accuracy: float, seed: int, draws: int = 12) -> float:
    """Strength at which a site has this held-out accuracy in the mean, by bisection."""
    low, high = 0.0, 4.0
    for step in range(7):
        middle = (low + high) / 2
        seeds = [derive_seed("strength", seed, items, accuracy, step, number) for number in range(draws)]
        reached = np.mean([Experiment(items, draw_seed).sites([middle]).mean() for draw_seed in seeds])
        low, high = (middle, high) if reached < accuracy else (low, middle)
    return (low + high) / 2


def rows(counts: list[int], accuracies: list[float], draws: int, seed: int) -> Iterator[tuple[str, ...]]:
    """Cells of the table, a number of items and an accuracy at a time."""
    for items in counts:
        for accuracy in accuracies:
            strength = strength_for(items, accuracy, seed)
            seeds = [derive_seed("power", seed, items, accuracy, number) for number in range(draws)]
            drawn = np.array([draw(items, strength, draw_seed) for draw_seed in seeds])
            simulated = simulate(items, accuracy - 0.5, SITES, 200)
            mean, best, untrained = (drawn[:, 1:] < SIGNIFICANCE).mean(axis=0)
            yield (
                str(items),
                f"{accuracy:g} ({drawn[:, 0].mean():.2f})",
                f"{mean:.0%} ({simulated.random_features:.0%})",
                f"{best:.0%}",
                f"{untrained:.0%} ({simulated.untrained:.0%})",
            )


def main() -> None:
    """Draw and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--items", default="24,40")
    parser.add_argument("--accuracies", default="0.65,0.75,0.9")
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--full", action="store_true")
    options = parser.parse_args()
    counts = [int(count) for count in options.items.split(",")]
    accuracies = [float(share) for share in options.accuracies.split(",")]
    counts, draws = (sorted({*counts, 100}), 300) if options.full else (counts, options.draws)
    columns = ("items", "accuracy (reached)", "mean of five (simulated)", "best of five", "untrained (simulated)")
    table = Table(*columns, title="share of draws in which a signal is shown")
    with threadpool_limits(1):
        for cells in rows(counts, accuracies, draws, options.seed):
            table.add_row(*cells)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
