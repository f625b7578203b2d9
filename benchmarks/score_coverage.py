"""Coverage and width of intervals of accuracies, with trained probes of one site.

    python benchmarks/score_coverage.py [--draws 100] [--seed 0] [--full]

Groups of four episodes, or of 2 to 16, hold both sides equally often. A part `alike` of the signal's noise is
common to a group. Probes are nested as `probe-kit train` fits them. The truth is the mean accuracy over draws, so
intervals must also hold what another training set would change. Cells: coverage and median width of Wilson's
interval, and of Korn and Graubard's in brackets. `--full` adds 6 and 60 groups and more correlation. The default
takes 2 minutes.
"""

import argparse
from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.special import ndtri
from threadpoolctl import threadpool_limits

from probe_kit.hashing import derive_seed
from probe_kit.statistics.crossfit import balanced_sums
from probe_kit.statistics.folds import fold_numbers
from probe_kit.statistics.intervals import Accuracy, Share
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.samples import Samples

WIDTH = 8
ACCURACIES = (0.5, 0.65, 0.75, 0.9, 0.99, 0.9999)
"""Of a probe that knows the direction of the signal; trained ones have less."""
Limits = tuple[float, float]


def sizes_of(kind: str, groups: int) -> NDArray[np.int64]:
    """(G,) episodes of each group."""
    return np.full(groups, 4) if kind == "equal" else 2 * (1 + np.arange(groups) % 8)


def draw(groups: int, kind: str, accuracy: float, alike: float, seed: int) -> tuple[float, Limits, Limits]:
    """Accuracy of a trained probe, with Wilson's limits and Korn and Graubard's."""
    generator = np.random.default_rng(seed)
    group_of = np.repeat(np.arange(groups), sizes_of(kind, groups))
    labels = np.tile([True, False], group_of.size // 2)
    side = np.where(labels, 1.0, -1.0)
    features = generator.standard_normal((labels.size, WIDTH))
    common = generator.standard_normal(groups)[group_of]
    features[:, 0] = np.sqrt(1 - alike) * features[:, 0] + side * (np.sqrt(alike) * common + ndtri(accuracy))
    folds = nested_folds(labels, group_of, seed)
    probe = probe_site(Samples.pooled(features), labels, np.empty((labels.size, 0), np.bool_), folds)
    sums = balanced_sums(probe.decisions[None, :], labels, fold_numbers([fold.outer for fold in folds]), group_of)
    names = np.arange(groups).astype(str)
    limits = [of(names, sums.sums[0], sums.sizes).interval() for of in (Accuracy, Share)]
    return float(sums.accuracies[0]), *((one.low, one.high) for one in limits)  # type: ignore[return-value]


def rows(groups: tuple[int, ...], alike: tuple[float, ...], draws: int, seed: int) -> Iterator[tuple[str, ...]]:
    """Cells of the table, a world at a time."""
    for count, kind, shared in product(groups, ("equal", "unequal"), alike):
        cells = []
        for accuracy in ACCURACIES:
            seeds = [derive_seed("scores", seed, count, kind, accuracy, shared, number) for number in range(draws)]
            drawn = [draw(count, kind, accuracy, shared, own) for own in seeds]
            truth = float(np.mean([score for score, *_ in drawn]))
            texts = []
            for limits in ([one[1] for one in drawn], [one[2] for one in drawn]):
                covered = np.mean([low - 1e-9 <= truth <= high + 1e-9 for low, high in limits])
                texts.append(f"{covered:.0%} {np.median([high - low for low, high in limits]):.2f}")
            cells.append(f"{truth:.2f}: {texts[0]} ({texts[1]})")
        yield f"{count} {kind}, {shared:g}", *cells


def main() -> None:
    """Draw every world and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--full", action="store_true")
    options = parser.parse_args()
    groups, alike = ((6, 12, 24, 60), (0.05, 0.5, 0.9)) if options.full else ((12, 24), (0.05,))
    table = Table("groups, alike", *(f"{share:g}" for share in ACCURACIES), title="accuracy of one site")
    with threadpool_limits(1):
        for cells in rows(groups, alike, options.draws, options.seed):
            table.add_row(*cells)
    Console(width=190).print(table)


if __name__ == "__main__":
    main()
