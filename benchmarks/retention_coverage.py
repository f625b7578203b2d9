"""Coverage of bounded and area retention, for one category and for the mean of twelve, and of perfect categories.

    python benchmarks/retention_coverage.py [--draws 240] [--shuffles 20] [--perfect-draws 1000] [--first-seed 0]
        [--worlds …]

Means of twelve are made of the same draws: all of them are shuffled into twelves again and again, so that
`draws` / 12 means that share nothing stand behind each coverage, put together in many ways. Perfect: 12 groups of
twins in both layouts, every layer of a plateau always right.

Cells: correctness of two layouts of every item at 19 backbone and 10 × 18 expert sites, neighbours correlated,
items 0.3, streams 0.25. The truth of `bounded` is the ratio of the best sites' true accuracies above chance,
that of `area` the ratio of their means over all sites. The last ten worlds took no part in any choice made in
the package.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from probe_kit.retention.estimators.bootstrap_draws import Estimate, average, retention_draws
from probe_kit.retention.estimators.combined import area_fit, bounded_fit
from probe_kit.retention.estimators.cross_fit import Crossfit, GroupScores, crossfit
from rich.console import Console
from scipy.special import ndtri
from threadpoolctl import threadpool_limits

from probe_kit.hooks.contract.sites import Site
from probe_kit.retention.estimators.retention import retention_interval

LAYERS, ITERATIONS = 19, 10
PLACES = (
    [Site("backbone", layer) for layer in range(LAYERS)],
    [Site("expert", layer, iteration=step) for step in range(ITERATIONS) for layer in range(LAYERS - 1)],
)
DEPTH = np.linspace(0, 1, LAYERS)
Matrix = NDArray[np.float64]
Shape = Callable[[Matrix], Matrix]


def bump(centre: float, width: float) -> Shape:
    """A peak of height 1."""
    return lambda depth: np.exp(-0.5 * ((depth - centre) / width) ** 2)


def plateau(start: float) -> Shape:
    """0 before `start`, then 1."""
    return lambda depth: (depth >= start).astype(float)


@dataclass(frozen=True)
class World:
    """top: best backbone accuracy above chance; retention: the expert's share of it, grown over iterations."""

    name: str
    top: float
    retention: float
    backbone: Shape
    expert: Shape
    growth: tuple[float, float] = (0.8, 1.0)
    items: int = 150
    neighbours: float = 0.9
    of_group: int = 1

    def above(self) -> tuple[Matrix, Matrix]:
        """True accuracy above chance: (19,) of the backbone, (180,) of the expert."""
        growth = np.linspace(*self.growth, ITERATIONS)[:, None]
        expert = self.retention * self.top * growth * self.expert(DEPTH[1:])
        return self.top * self.backbone(DEPTH), expert.ravel()

    def truth(self) -> tuple[float, float]:
        """Ratio of maxima, and of means."""
        backbone, expert = self.above()
        return float(expert.max() / backbone.max()), float(expert.mean() / backbone.mean())


TUNING = tuple(
    World(f"{strength}, {shape}, {retention:.2f}", top, retention, bump(2 / 3, width), bump(2 / 3, width))
    for strength, top in (("strong", 0.25), ("weak", 0.12))
    for shape, width in (("broad", 0.35), ("narrow", 0.15))
    for retention in (0.25, 0.5, 0.8, 1.0)
)[:15]
OWN = (
    World("plateaus", 0.3, 0.6, plateau(0.4), plateau(0.5)),
    World("early backbone, late expert", 0.25, 0.5, bump(0.3, 0.2), bump(0.9, 0.2)),
    World("expert falls over iterations", 0.3, 0.7, bump(0.6, 0.3), bump(0.4, 0.3), growth=(1.0, 0.2)),
    World("expert rises from nothing", 0.3, 0.7, bump(0.6, 0.3), bump(0.8, 0.2), growth=(0.0, 1.0)),
    World("60 items", 0.25, 0.6, bump(0.6, 0.3), bump(0.6, 0.3), items=60),
    World("neighbours 0.3", 0.25, 0.6, bump(0.6, 0.3), bump(0.6, 0.3), neighbours=0.3),
    World("two layers wide", 0.3, 0.5, bump(0.6, 0.07), bump(0.6, 0.07)),
    World("very strong", 0.45, 0.9, bump(0.7, 0.3), bump(0.7, 0.3)),
    World("expert twice as narrow", 0.3, 0.8, bump(0.6, 0.3), bump(0.6, 0.12)),
    World("expert better than backbone", 0.2, 1.2, bump(0.6, 0.3), bump(0.6, 0.3)),
)


PERFECT = tuple(
    World(
        f"top {0.5 + top:.2f}, kept {kept:.2f}", top, kept, plateau(0.4), plateau(0.4), (1.0, 1.0), 24, of_group=2
    )
    for top in (0.5, 0.47)
    for kept in (1.0, 0.5)
)


def correlated(generator: np.random.Generator, cells: int, columns: int, neighbours: float) -> Matrix:
    """(cells, columns) normal values, those of neighbouring cells correlated."""
    values = generator.standard_normal((cells, columns))
    for cell in range(1, cells):
        values[cell] = neighbours * values[cell - 1] + np.sqrt(1 - neighbours**2) * values[cell]
    return values


def draw(world: World, generator: np.random.Generator) -> tuple[GroupScores, GroupScores]:
    """Backbone and expert of one data set, its groups of `of_group` items each."""
    shared = generator.standard_normal(2 * world.items)
    found = []
    for above in world.above():
        of_item = np.repeat(correlated(generator, above.size, world.items, world.neighbours), 2, axis=1)
        own = correlated(generator, above.size, 2 * world.items, world.neighbours)
        values = 0.5 * shared + np.sqrt(0.75) * (np.sqrt(0.3) * of_item + np.sqrt(0.7) * own)
        groups = np.arange(2 * world.items) // (2 * world.of_group)
        found.append(GroupScores.of(values < ndtri(0.5 + above)[:, None], groups))
    return found[0], found[1]


def fits(world: World, seed: int) -> tuple[Crossfit, Crossfit]:
    """Bounded and area fit of one data set."""
    backbone, expert = draw(world, np.random.default_rng(seed))
    return bounded_fit(backbone, expert, PLACES, 0.5, seed), area_fit(backbone, expert, 0.5)


def study(world: World, draws: int, shuffles: int, first_seed: int) -> str:
    """Median and coverage of both estimates over `draws` data sets, and of their means by twelve."""
    found = [fits(world, first_seed + number) for number in range(draws)]
    parts = [f"{world.name:30}"]
    for name, truth, of_kind in zip(("bounded", "area"), world.truth(), zip(*found, strict=True), strict=True):
        covered, median, width = coverage(of_kind, truth)
        of_twelve, mean = mean_coverage(of_kind, truth, shuffles, first_seed)
        parts.append(
            f"{name} true {truth:.2f} median {median:.2f} covered {covered:5.1%} width {width:.2f}; twelve: mean "
            f"{mean:.2f} covered {of_twelve:5.1%}"
        )
    return "  ".join(parts)


def coverage(of_kind: Sequence[Crossfit], truth: float) -> tuple[float, float, float]:
    """Share of intervals that hold the truth, median estimate, median width."""
    intervals = [retention_interval(fit) for fit in of_kind]
    covered = np.mean([interval.low <= truth <= interval.high for interval in intervals])
    median = np.median([fit.expert / fit.backbone for fit in of_kind])
    return float(covered), float(median), float(np.median([one.high - one.low for one in intervals]))


def mean_coverage(of_kind: Sequence[Crossfit], truth: float, shuffles: int, seed: int) -> tuple[float, float]:
    """Share of intervals of means by twelve that hold the truth, and the mean of all estimates."""
    estimates = [
        Estimate(fit.expert / fit.backbone, retention_draws(fit, 0.5, number), number, fit.sizes.size)
        for number, fit in enumerate(of_kind)
    ]
    generator, covered = np.random.default_rng(seed), []
    for _ in range(shuffles):
        order = generator.permutation(len(estimates))
        twelves = [order[start : start + 12] for start in range(0, len(order) - 11, 12)]
        covered += [_covers(average([estimates[at] for at in twelve]), truth) for twelve in twelves]
    return float(np.mean(covered)), float(np.mean([estimate.value for estimate in estimates]))


def perfect(world: World, draws: int, first_seed: int) -> str:
    """Coverage of debiased, bounded and area retention where all groups of the backbone agree, or nearly so."""
    found: dict[str, list[Crossfit]] = {"debiased": [], "bounded": [], "area": []}
    for seed in range(first_seed, first_seed + draws):
        backbone, expert = draw(world, np.random.default_rng(seed))
        found["debiased"].append(crossfit(backbone, expert, 0.5, seed))
        found["bounded"].append(bounded_fit(backbone, expert, PLACES, 0.5, seed))
        found["area"].append(area_fit(backbone, expert, 0.5))
    truth = world.truth()
    parts = [f"perfect, 12 groups: {world.name:22}"]
    for name, of_kind in found.items():
        covered, median, width = coverage(of_kind, truth[name == "area"])
        parts.append(
            f"{name} true {truth[name == 'area']:.2f} median {median:.2f} covered {covered:5.1%} width {width:.2f}"
        )
    return "  ".join(parts)


def _covers(mean: Estimate, truth: float) -> bool:
    low, high = mean.centred.ci
    return low is None or high is None or low <= truth <= high


def main() -> None:
    """Run both studies and print each world as it ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=240, help="a multiple of 12")
    parser.add_argument("--shuffles", type=int, default=20)
    parser.add_argument("--perfect-draws", type=int, default=1000)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--worlds", default="", help="beginnings of names, separated by semicolons; default all")
    asked = parser.parse_args()
    console = Console(width=220)
    with threadpool_limits(1):
        for world in PERFECT if asked.perfect_draws else ():
            console.print(perfect(world, asked.perfect_draws, asked.first_seed), highlight=False)
        console.print(f"one category and means of twelve, {asked.draws} draws")
        names = tuple(asked.worlds.split(";"))
        for world in (world for world in (*OWN, *TUNING) if world.name.startswith(names)):
            console.print(study(world, asked.draws, asked.shuffles, asked.first_seed), highlight=False)


if __name__ == "__main__":
    main()
