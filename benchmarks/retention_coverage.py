"""Coverage and width of intervals of retention and accuracies: a category, a mean of twelve, and differences.

    python benchmarks/retention_coverage.py [--draws 240] [--random 30] [--only NAME;NAME] [--seed 0] [--workers 1]

The truth of a world is the mean of the cross-fitted scores over its draws: what they estimate. An interval without
limits counts as covered; the column `open` says how many there are. Means of twelve are made of the same draws:
all of them are shuffled into twelves again and again, so that `draws` / 12 means share nothing. `--only` takes
beginnings of worlds or of sections: `random`, `mixed` (means of twelve different random worlds), `unpaired` and
`paired` (differences of two runs on other and on the same items).
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from coverage_worlds import LIMITS, World, own_worlds, random_world, sample
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from probe_kit.hashing import derive_seed
from probe_kit.statistics.estimates.crossfit import CrossFit, crossfit
from probe_kit.statistics.estimates.retention import retention, retention_difference
from probe_kit.statistics.estimates.scores import Scores, accuracy_interval
from probe_kit.statistics.fieller import Interval

SHUFFLES = 20
GATE = 0.92
Covered = tuple[float, float]
"""Share of intervals that hold the truth, and their median width."""


@dataclass(frozen=True)
class Study:
    """The fits of one world, with the scores above chance that they estimate."""

    world: World
    fits: list[CrossFit]

    @property
    def truth(self) -> NDArray[np.float64]:
        """(2,) of (expert, backbone)."""
        above = np.mean([fit.above for fit in self.fits], axis=0)
        if self.world.retention == 0 and not self.world.same:
            above[0] = 0.0
        return above

    @property
    def ratio(self) -> float:
        """True retention."""
        return float(self.truth[0] / self.truth[1])


def study(world: World, draws: int, seed: int) -> Study:
    """`draws` data sets of a world."""
    seeds = [derive_seed("coverage", seed, world.name, number) for number in range(draws)]
    with threadpool_limits(1):
        fits = [crossfit(sample(world, np.random.default_rng(one)), derive_seed("halvings", one)) for one in seeds]
    return Study(world, fits)


def covered(intervals: Sequence[Interval], truths: Sequence[float]) -> Covered:
    """Coverage and median width; widths of those that have limits."""
    held = [one.low <= truth <= one.high for one, truth in zip(intervals, truths, strict=True)]
    widths = [one.high - one.low for one in intervals if one.bounded]
    return float(np.mean(held)), float(np.median(widths)) if widths else float("inf")


def twelves(count: int, seed: int) -> list[NDArray[np.intp]]:
    """Draws put together by twelve, in many ways."""
    generator = np.random.default_rng(seed)
    orders = [generator.permutation(count) for _ in range(SHUFFLES)]
    return [order[start : start + 12] for order in orders for start in range(0, count - 11, 12)]


def row_of(found: Study, seed: int) -> tuple[list[str], list[float]]:
    """What the table says of a world, and the coverages of category and mean."""
    scores = [Scores.of(fit) for fit in found.fits]
    means = [Scores.mean([scores[at] for at in chosen]) for chosen in twelves(len(scores), seed)]
    intervals = [retention(one).interval for one in scores]
    of_one = covered(intervals, [found.ratio] * len(intervals))
    of_mean = covered([retention(one).interval for one in means], [found.ratio] * len(means))
    accuracies = []
    for row in (1, 0):
        true = 0.5 + found.truth[row]
        each = covered([accuracy_interval(fit, row) for fit in found.fits], [true] * len(scores))
        mean = covered([one.accuracy_interval(row) for one in means], [true] * len(means))
        accuracies.append(f"{each[0]:.1%} {each[1]:.2f}, mean {mean[0]:.1%}")
    open_ = np.mean([not interval.bounded for interval in intervals])
    texts = [f"{found.ratio:.2f}", *(f"{share:.1%} {width:.2f}" for share, width in (of_one, of_mean))]
    return [found.world.name, *texts, f"{open_:.0%}", *accuracies], [of_one[0], of_mean[0]]


def table_of(title: str, studies: Sequence[Study], draws: int, seed: int) -> Table:
    """A row per world, and the least coverages without the documented limits."""
    table = Table("world", "truth", "category", "mean of 12", "open", "backbone", "action", title=title)
    least = []
    for found in studies:
        texts, coverages = row_of(found, seed)
        table.add_row(*texts)
        if not found.world.name.startswith(LIMITS):
            least.append(coverages)
    if least:
        lowest = np.min(least, axis=0)
        bound = GATE - 2 * np.sqrt(0.95 * 0.05 / draws)
        table.add_row("least", "", f"{lowest[0]:.1%}", f"{lowest[1]:.1%}", "", f"gate {bound:.1%}", "")
    return table


def mixed(studies: Sequence[Study], count: int, seed: int) -> str:
    """Means of twelve different worlds: ratio of the means, true and estimated."""
    generator, intervals, truths = np.random.default_rng(seed), [], []
    for _ in range(count):
        chosen = [studies[at] for at in generator.permutation(len(studies))[:12]]
        truth = np.sum([one.truth for one in chosen], axis=0)
        for _ in range(20):
            scores = [Scores.of(one.fits[generator.integers(len(one.fits))]) for one in chosen]
            intervals.append(retention(Scores.mean(scores)).interval)
            truths.append(float(truth[0] / truth[1]))
    share, width = covered(intervals, truths)
    return f"mixed: means of twelve different random worlds: covered {share:.1%}, width {width:.2f}"


def paired(first: World, second: World, draws: int, seed: int) -> str:
    """Differences of two runs on the same items, for a category and for a mean of twelve."""
    pairs = []
    for number in range(draws):
        one = derive_seed("paired", seed, first.name, second.name, number)
        generator = np.random.default_rng(one)
        common = generator.standard_normal(sum(first.sizes))
        streams = [stream for world in (first, second) for stream in sample(world, generator, common)]
        halves = derive_seed("halvings", one)
        pairs.append((crossfit(streams[:2], halves), crossfit(streams[2:], halves)))
    return f"paired: {first.name} minus {second.name}: " + _differences(pairs, True, seed)


def unpaired(first: Study, second: Study, seed: int) -> str:
    """Differences of two runs on other items."""
    return f"unpaired: {first.world.name} minus {second.world.name}: " + _differences(
        list(zip(first.fits, second.fits, strict=True)), False, seed
    )


def _differences(pairs: Sequence[tuple[CrossFit, CrossFit]], same: bool, seed: int) -> str:
    above = np.mean([[a.above, b.above] for a, b in pairs], axis=0)
    truth = float(above[0, 0] / above[0, 1] - above[1, 0] / above[1, 1])
    one, mean = [], []
    for a, b in pairs:
        one.append(
            retention_difference(Scores.of(a), Scores.of(b), a.covariance_with(b) if same else None).interval
        )
    for chosen in twelves(len(pairs), seed):
        sides = [Scores.mean([Scores.of(pairs[at][side]) for at in chosen]) for side in (0, 1)]
        between = np.sum([pairs[at][0].covariance_with(pairs[at][1]) for at in chosen], axis=0) / 144
        mean.append(retention_difference(sides[0], sides[1], between if same else None).interval)
    of_one, of_mean = covered(one, [truth] * len(one)), covered(mean, [truth] * len(mean))
    texts = [f"{share:.1%} {width:.2f}" for share, width in (of_one, of_mean)]
    return f"true {truth:+.2f}, category {texts[0]}, mean of 12 {texts[1]}"


PAIRS = tuple(
    (
        replace(one, name=f"{one.name} {one.retention:g}"),
        replace(one, name=f"{one.name} {other:g}", retention=other),
    )
    for one, other in (
        (World("40 groups", 0.3, 0.8, sizes=(4,) * 40), 0.4),
        (World("30 groups", 0.3, 0.5, sizes=(4,) * 30), 0.5),
        (World("12 groups", 0.4, 0.9, sizes=(4,) * 12), 0.3),
    )
)


def main() -> None:
    """Run every section and print it as it ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=240, help="data sets per world, a multiple of 12")
    parser.add_argument("--random", type=int, default=30, help="number of random worlds")
    parser.add_argument("--only", default="", help="beginnings of worlds or sections, separated by semicolons")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    asked = parser.parse_args()
    names, console = tuple(asked.only.split(";")), Console(width=170)
    own = [world for world in own_worlds() if world.name.startswith(names)]
    drawn = [random_world(1000 * asked.seed + number) for number in range(asked.random)]
    wanted = [section.startswith(names) for section in ("random", "mixed", "unpaired", "paired")]
    with ProcessPoolExecutor(asked.workers) as pool:
        one_study = partial(study, draws=asked.draws, seed=asked.seed)
        if own:
            console.print(table_of("own worlds", list(pool.map(one_study, own)), asked.draws, asked.seed))
        if any(wanted[:3]):
            found = list(pool.map(one_study, drawn))
            console.print(table_of("random worlds", found, asked.draws, asked.seed))
            if len(found) >= 12:
                console.print(mixed(found, 20, asked.seed), highlight=False)
            for first, second in zip(found[::3], found[1::3], strict=False):
                console.print(unpaired(first, second, asked.seed), highlight=False)
        for line in pool.map(partial(_paired, draws=asked.draws, seed=asked.seed), PAIRS if wanted[3] else ()):
            console.print(line, highlight=False)


def _paired(pair: tuple[World, World], draws: int, seed: int) -> str:
    with threadpool_limits(1):
        return paired(*pair, draws, seed)


if __name__ == "__main__":
    main()
