"""Bias, spread, coverage and width of scores and retention of trained probes: a category and a mean of twelve.

    python benchmarks/retention_coverage.py [--draws 120] [--full] [--only NAME;NAME] [--seed 0] [--workers 2]

Probes are trained by the package's solver on drawn activations (`coverage_worlds`). The truth of a world is the
mean of the scores over its draws, and one half for a stream that holds nothing. Retention has two coverages: over
all intervals, of which those without limits cover by saying nothing, and over those with limits. `open` is the
share without limits. Means of twelve are made of the same draws, which are shuffled into twelves again and again.
`--full` covers the grid of groups, accuracies, retention and sites; it takes days. `--only` takes beginnings of
names.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import batched

import numpy as np
from coverage_worlds import World, every_world, few_worlds, fit
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from probe_kit.retention.estimators import Rate
from probe_kit.statistics.crossfit import CrossFit
from probe_kit.statistics.intervals import Interval
from probe_kit.statistics.retention import Scores, accuracy_interval, retention

SHUFFLES = 20
STREAMS = ("action", "backbone")


@dataclass(frozen=True)
class Study:
    """The fits of one world."""

    world: World
    fits: list[CrossFit]

    @property
    def above(self) -> NDArray[np.float64]:
        """(N, 2) scores above chance of (action, backbone)."""
        return np.array([fit.above for fit in self.fits])

    @property
    def truth(self) -> NDArray[np.float64]:
        """(2,) scores above chance that the fits estimate."""
        holds = [above.any() for above in self.world.above()]
        truth: NDArray[np.float64] = np.where(holds, self.above.mean(axis=0), 0.0)
        return truth


def study(world: World, draws: int, seed: int, pool: ProcessPoolExecutor) -> Study:
    """`draws` data sets of a world."""
    return Study(world, list(pool.map(partial(_fit, world), range(seed * draws, (seed + 1) * draws), chunksize=4)))


def _fit(world: World, seed: int) -> CrossFit:
    with threadpool_limits(1):
        return fit(world, seed)


def twelves(count: int) -> Iterator[tuple[int, ...]]:
    """Draws put together by twelve, in many ways."""
    generator = np.random.default_rng(0)
    for _ in range(SHUFFLES):
        yield from batched(generator.permutation(count)[: count // 12 * 12].tolist(), 12)


def covered(intervals: Sequence[Interval], truth: float) -> str:
    """Coverage of all intervals, of those with limits, the share without, and the median width."""
    bounded = [interval for interval in intervals if interval.bounded]
    every = np.mean([not interval.bounded or interval.low <= truth <= interval.high for interval in intervals])
    if not bounded:
        return f"{every:.1%}, all open"
    coverage = np.mean([interval.low <= truth <= interval.high for interval in bounded])
    width = np.median([interval.high - interval.low for interval in bounded])
    return f"{every:.1%}, {coverage:.1%}, {1 - len(bounded) / len(intervals):.0%}, {width:.2f}"


def share_covered(intervals: Sequence[Interval], truth: float) -> str:
    """Coverage and median width of intervals that always have limits."""
    share = np.mean([interval.low <= truth <= interval.high for interval in intervals])
    return f"{share:.1%} {np.median([interval.high - interval.low for interval in intervals]):.2f}"


def score_rows(sampled: Study) -> Iterator[tuple[str, ...]]:
    """A row per stream: truth, bias, spread over draws against the claimed, coverage."""
    scores = [Scores.of(fit) for fit in sampled.fits]
    for row, stream in enumerate(STREAMS):
        rates = [Rate(0.5 + float(fit.above[row]), accuracy_interval(fit, row)) for fit in sampled.fits]
        means = [Rate.mean([rates[at] for at in positions]) for positions in twelves(len(rates))]
        truth, above = float(sampled.truth[row]), sampled.above[:, row]
        bias = "" if truth else f"{100 * above.mean():+.1f} ± {100 * above.std(ddof=1) / len(above) ** 0.5:.1f}"
        claimed = np.sqrt(np.mean([category_scores.covariance[row, row] for category_scores in scores]))
        yield (
            sampled.world.name,
            stream,
            f"{50 + 100 * truth:.1f}",
            bias,
            f"{100 * above.std(ddof=1):.1f}",
            f"{100 * claimed:.1f}",
            share_covered([rate.interval for rate in rates], 0.5 + truth),
            share_covered([mean.interval for mean in means], 0.5 + truth),
        )


def retention_row(sampled: Study) -> tuple[str, ...] | None:
    """Retention of a category and of a mean of twelve; None without a backbone."""
    if not sampled.truth[1]:
        return None
    ratio = float(sampled.truth[0] / sampled.truth[1])
    scores = [Scores.of(fit) for fit in sampled.fits]
    means = [Scores.mean([scores[at] for at in positions]) for positions in twelves(len(scores))]
    each, mean = ([retention(part_scores).interval for part_scores in part] for part in (scores, means))
    return sampled.world.name, f"{ratio:.2f}", covered(each, ratio), covered(mean, ratio)


def main() -> None:
    """Run every world and print its rows as it ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=120, help="data sets per world, a multiple of 12")
    parser.add_argument("--full", action="store_true", help="the whole grid of worlds")
    parser.add_argument("--only", default="", help="beginnings of names of worlds, separated by semicolons")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    console = Console(width=150)
    of_scores = Table(
        "world", "stream", "true %", "bias of nothing", "sd", "claimed", "category: covered, width", "mean of 12",
        title="scores",
    )  # fmt: skip
    of_retention = Table(
        "world", "true", "category: covered, with limits, open, width", "mean of 12", title="retention"
    )
    worlds = every_world() if arguments.full else few_worlds()
    with ProcessPoolExecutor(arguments.workers) as pool:
        for world in worlds:
            if not world.name.startswith(tuple(arguments.only.split(";"))):
                continue
            sampled = study(world, arguments.draws, arguments.seed, pool)
            for row in score_rows(sampled):
                of_scores.add_row(*row)
                console.print("  ".join(row), style="dim", highlight=False)
            if (row := retention_row(sampled)) is not None:
                of_retention.add_row(*row)
                console.print("  ".join(row), style="dim", highlight=False)
    console.print(of_scores, of_retention)


if __name__ == "__main__":
    main()
