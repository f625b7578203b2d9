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
    bounded = [one for one in intervals if one.bounded]
    every = np.mean([not one.bounded or one.low <= truth <= one.high for one in intervals])
    if not bounded:
        return f"{every:.1%}, all open"
    held = np.mean([one.low <= truth <= one.high for one in bounded])
    width = np.median([one.high - one.low for one in bounded])
    return f"{every:.1%}, {held:.1%}, {1 - len(bounded) / len(intervals):.0%}, {width:.2f}"


def held(intervals: Sequence[Interval], truth: float) -> str:
    """Coverage and median width of intervals that always have limits."""
    share = np.mean([one.low <= truth <= one.high for one in intervals])
    return f"{share:.1%} {np.median([one.high - one.low for one in intervals]):.2f}"


def score_rows(found: Study) -> Iterator[tuple[str, ...]]:
    """A row per stream: truth, bias, spread over draws against the claimed, coverage."""
    scores = [Scores.of(fit) for fit in found.fits]
    for row, stream in enumerate(STREAMS):
        rates = [Rate(0.5 + float(fit.above[row]), accuracy_interval(fit, row)) for fit in found.fits]
        means = [Rate.mean([rates[at] for at in chosen]) for chosen in twelves(len(rates))]
        truth, above = float(found.truth[row]), found.above[:, row]
        bias = "" if truth else f"{100 * above.mean():+.1f} ± {100 * above.std(ddof=1) / len(above) ** 0.5:.1f}"
        claimed = np.sqrt(np.mean([one.covariance[row, row] for one in scores]))
        yield (
            found.world.name,
            stream,
            f"{50 + 100 * truth:.1f}",
            bias,
            f"{100 * above.std(ddof=1):.1f}",
            f"{100 * claimed:.1f}",
            held([rate.interval for rate in rates], 0.5 + truth),
            held([mean.interval for mean in means], 0.5 + truth),
        )


def retention_row(found: Study) -> tuple[str, ...] | None:
    """Retention of a category and of a mean of twelve; None without a backbone."""
    if not found.truth[1]:
        return None
    ratio = float(found.truth[0] / found.truth[1])
    scores = [Scores.of(fit) for fit in found.fits]
    means = [Scores.mean([scores[at] for at in chosen]) for chosen in twelves(len(scores))]
    each, mean = ([retention(one).interval for one in part] for part in (scores, means))
    return found.world.name, f"{ratio:.2f}", covered(each, ratio), covered(mean, ratio)


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
            found = study(world, arguments.draws, arguments.seed, pool)
            for row in score_rows(found):
                of_scores.add_row(*row)
                console.print("  ".join(row), style="dim", highlight=False)
            if (row := retention_row(found)) is not None:
                of_retention.add_row(*row)
                console.print("  ".join(row), style="dim", highlight=False)
    console.print(of_scores, of_retention)


if __name__ == "__main__":
    main()
