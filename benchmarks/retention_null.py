"""What retention says where the truth is known: bias, coverage, and how often silence is called signal.

    python benchmarks/retention_null.py [--draws 500]

Cells: correctness of 300 episodes (150 items) at 19 backbone and 180 expert sites, neighbours correlated 0.9,
items 0.3, streams 0.25. The rival interval is a percentile bootstrap over items that repeats the whole cross-fit,
choosing sites anew, in every resample. Probes: real nested probes on features without signal, all 99 relabellings
refitted.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.special import ndtri, stdtrit

from probe_kit.retention.crossfit import GroupScores, crossfit
from probe_kit.retention.estimates import Estimate, average, retention_draws
from probe_kit.retention.fieller import Interval, fieller_interval
from probe_kit.train.permutation import family_p, flip_items
from probe_kit.train.probe import nested_folds, probe_site
from probe_kit.train.samples import Samples
from probe_kit.train.scores import correctness

LAYERS, ITERATIONS, ITEMS = 19, 10, 150
RETENTIONS = (0.0, 0.25, 0.5, 0.8, 1.0)
Correct = NDArray[np.bool_]


@dataclass(frozen=True)
class World:
    """A true state of affairs. top: best backbone accuracy above chance; width of the peak, in depth."""

    name: str
    top: float
    width: float
    retention: float


@dataclass(frozen=True)
class Study:
    """What was measured over many draws of one world."""

    world: World
    plain: float
    debiased: float
    coverage: float
    unbounded: float
    width: float
    reselecting_width: float


def correlated(generator: np.random.Generator, cells: int, episodes: int) -> NDArray[np.float64]:
    """(cells, episodes) normal values, neighbouring cells correlated 0.9."""
    values = generator.standard_normal((cells, episodes))
    for cell in range(1, cells):
        values[cell] = 0.9 * values[cell - 1] + np.sqrt(1 - 0.81) * values[cell]
    return values


def draw(world: World, generator: np.random.Generator) -> tuple[Correct, Correct]:
    """Correctness of backbone (19, E) and expert (180, E)."""
    depth = np.linspace(0, 1, LAYERS)
    shape = np.exp(-0.5 * ((depth - 12 / 18) / world.width) ** 2)
    growth = np.linspace(0.8, 1.0, ITERATIONS)[:, None]
    above = (world.top * shape, (world.retention * world.top * growth * shape[1:]).ravel())
    shared = generator.standard_normal(2 * ITEMS)

    def stream(cells: int) -> NDArray[np.float64]:
        of_item = np.repeat(correlated(generator, cells, ITEMS), 2, axis=1)
        own = np.sqrt(0.3) * of_item + np.sqrt(0.7) * correlated(generator, cells, 2 * ITEMS)
        return 0.5 * shared + np.sqrt(0.75) * own

    backbone, expert = (stream(len(part)) < ndtri(0.5 + part)[:, None] for part in above)
    return backbone, expert


def study(world: World, draws: int) -> Study:
    """Plain and debiased retention of `draws` data sets."""
    items = np.repeat(np.arange(ITEMS), 2)
    plain, debiased, intervals, reselecting = [], [], [], []
    for seed in range(draws):
        generator = np.random.default_rng(seed)
        backbone, expert = (GroupScores.of(part, items) for part in draw(world, generator))
        plain.append((best_mean(expert) - 0.5) / (best_mean(backbone) - 0.5))
        fit = crossfit(backbone, expert, 0.5, seed)
        debiased.append(np.divide(fit.expert, fit.backbone))
        quantile = float(stdtrit(ITEMS - 1, 0.975))
        intervals.append(fieller_interval(fit.expert, fit.backbone, fit.covariance, quantile))
        if seed < draws // 50:
            reselecting.append(width(reselecting_interval(backbone, expert, generator)))
    return Study(
        world,
        plain=float(np.median(plain)),
        debiased=float(np.median(debiased)),
        coverage=float(np.mean([interval.low <= world.retention <= interval.high for interval in intervals])),
        unbounded=float(np.mean([not interval.bounded for interval in intervals])),
        width=float(np.median([width(interval) for interval in intervals])),
        reselecting_width=float(np.median(reselecting)),
    )


def joined_coverage(draws: int) -> tuple[float, float]:
    """How often the intervals of a mean over four categories, and of a difference of two such means, cover.

    True retentions 0.8 and 0.5, backbone strong and broad.
    """
    worlds = [World("", 0.25, 0.35, retention) for retention in (0.8, 0.5)]
    covered = []
    for seed in range(draws):
        generator = np.random.default_rng(seed)
        mean, other = (
            average([estimate(world, generator, category) for category in range(4)]) for world in worlds
        )
        covered.append([covers(mean, 0.8), covers(mean - other, 0.3)])
    of_mean, of_difference = np.mean(covered, axis=0)
    return float(of_mean), float(of_difference)


def estimate(world: World, generator: np.random.Generator, category: int) -> Estimate:
    """Debiased retention of one data set, with draws that belong to `category`."""
    items = np.repeat(np.arange(ITEMS), 2)
    fit = crossfit(*(GroupScores.of(part, items) for part in draw(world, generator)), 0.5, category)
    drawn = retention_draws(fit.held_out, np.full(ITEMS, 2), 0.5, category)
    return Estimate(fit.expert / fit.backbone, drawn, category)


def covers(estimated: Estimate, truth: float) -> bool:
    """Whether the interval holds the truth; one without limits does."""
    low, high = estimated.ci
    return low is None or high is None or low <= truth <= high


def best_mean(scores: GroupScores) -> np.float64:
    """Accuracy of the best site."""
    best: np.float64 = scores.sums.sum(axis=1).max() / scores.sizes.sum()
    return best


def reselecting_interval(backbone: GroupScores, expert: GroupScores, generator: np.random.Generator) -> Interval:
    """Percentile bootstrap over items that chooses sites anew in each of 100 resamples."""
    ratios = []
    for resample in range(100):
        drawn = generator.integers(ITEMS, size=ITEMS)
        again = (GroupScores(part.sums[:, drawn], part.sizes[drawn]) for part in (backbone, expert))
        fit = crossfit(*again, 0.5, resample)
        ratios.append(np.divide(fit.expert, fit.backbone))
    low, high = np.percentile(ratios, [2.5, 97.5])
    return Interval(float(low), float(high))


def width(interval: Interval) -> float:
    """Length of an interval."""
    return interval.high - interval.low


def false_alarms(draws: int) -> float:
    """Share of data sets without signal whose best of four backbone sites gets a family-wise p below 0.05."""
    items, labels = np.repeat(np.arange(24), 2), np.tile([True, False], 24)
    alarms = 0
    for seed in range(draws):
        generator = np.random.default_rng(seed)
        layers = correlated(generator, 4, 48 * 12).reshape(4, 48, 12)
        relabellings = flip_items(labels, items, 99, seed)
        folds = nested_folds(labels, items, seed)
        probes = [probe_site(Samples.pooled(layer), labels, relabellings, folds) for layer in layers]
        accuracy = np.array([correctness(probe.decisions, labels).mean() for probe in probes])
        alarms += bool((family_p(accuracy, np.stack([probe.null for probe in probes])) < 0.05).any())
    return alarms / draws


@np.errstate(divide="ignore", invalid="ignore")  # a dead backbone can score exactly chance
def main() -> None:
    """Run both studies and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500)
    draws = parser.parse_args().draws
    worlds = [World("dead", 0.0, 0.35, 0.0)]
    worlds += [
        World(f"{strength}, {shape}", top, peak, retention)
        for strength, top in (("strong", 0.25), ("weak", 0.12))
        for shape, peak in (("broad", 0.35), ("narrow", 0.15))
        for retention in RETENTIONS
    ]
    table = Table(
        "backbone", "true", "plain", "debiased", "coverage", "unbounded", "width", "reselecting width",
        title=f"Retention over {draws} draws: medians, nominal 95 % intervals",
    )  # fmt: skip
    planted = []
    for world in worlds:
        found = study(world, draws)
        planted += [found.coverage] * (world.top > 0)
        table.add_row(
            world.name,
            f"{world.retention:.2f}" if world.top else "–",
            f"{found.plain:.2f}",
            f"{found.debiased:.2f}",
            f"{found.coverage:.1%}" if world.top else "–",
            f"{found.unbounded:.0%}",
            f"{found.width:.2f}",
            f"{found.reselecting_width:.2f}",
        )
    console = Console(width=120)
    console.print(table)
    console.print(
        f"coverage over the {len(planted)} worlds: mean {np.mean(planted):.1%}, least {min(planted):.1%}"
    )
    mean, difference = joined_coverage(draws)
    console.print(f"bootstrap over four categories: mean covers {mean:.1%}, difference of groups {difference:.1%}")
    alarms = false_alarms(draws)
    console.print(f"no signal, real probes: family-wise error {alarms:.1%}, so n/a in {1 - alarms:.1%} of draws")


if __name__ == "__main__":
    main()
