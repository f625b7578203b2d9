"""Retention in worlds with known truth: bias, coverage and false-alarm rate.

    python benchmarks/retention_null.py [--draws 500] [--rival-draws 100] [--first-seed 0]
    python benchmarks/retention_null.py --probe-draws 2000 --keep DIR

Cells: correctness of 300 episodes (150 items) at 19 backbone and 180 expert sites, neighbours correlated 0.9,
items 0.3, streams 0.25. The rivals are percentile bootstraps over items that choose sites anew in each of 100
resamples, by the same estimate on the first of those draws. In one of them the copies of an item stay in one half,
as they must; in the other they are items of their own and can be on both sides of a choice. Probes: real nested
probes on features without signal, all 99 relabellings refitted; with `--probe-draws` they alone are run, and
with `--keep` the same command resumes.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kept_draws import kept_draws
from numpy.typing import NDArray
from probe_kit.retention.estimators.bootstrap_draws import Estimate, average, retention_draws
from probe_kit.retention.estimators.cross_fit import REPEATS, GroupScores, crossfit, held_out_scores, random_halves
from rich.console import Console
from rich.table import Table
from scipy.special import ndtri
from scipy.stats import binomtest

from probe_kit.retention.estimators.retention import retention_interval
from probe_kit.statistics.fieller import Interval
from probe_kit.statistics.label_permutations import flip_items, max_statistic_p, pointwise_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.metrics import correctness
from probe_kit.train.crossval.site_probe import nested_folds, probe_site
from probe_kit.train.data.samples import Samples

LAYERS, ITERATIONS, ITEMS = 19, 10, 150
RETENTIONS = (0.0, 0.25, 0.5, 0.8, 1.0)
NEEDLE = "strong, needle"
Correct = NDArray[np.bool_]


@dataclass(frozen=True)
class World:
    """A true state of affairs. top: best backbone accuracy above chance; width of the peak, in depth."""

    name: str
    top: float
    width: float
    retention: float


@dataclass(frozen=True)
class Rival:
    """A bootstrap's coverage and median width, and our median width on the same draws."""

    coverage: float
    width: float
    own_width: float


@dataclass(frozen=True)
class Study:
    """What was measured over many draws of one world."""

    world: World
    plain: float
    debiased: float
    coverage: float
    unbounded: float
    width: float
    rivals: list[Rival]

    def width_ratio(self, rival: int) -> float:
        """Median width over the rival's, both on the rival's draws."""
        return self.rivals[rival].own_width / self.rivals[rival].width


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


def study(world: World, draws: int, rival_draws: int, first_seed: int) -> Study:
    """Plain and debiased retention of `draws` data sets, and the rivals' intervals on the first of them."""
    items = np.repeat(np.arange(ITEMS), 2)
    plain, debiased, intervals = [], [], []
    rivals: tuple[list[Interval], list[Interval]] = ([], [])
    for number, seed in enumerate(range(first_seed, first_seed + draws)):
        generator = np.random.default_rng(seed)
        backbone, expert = (GroupScores.of(part, items) for part in draw(world, generator))
        plain.append((best_mean(expert) - 0.5) / (best_mean(backbone) - 0.5))
        fit = crossfit(backbone, expert, 0.5, seed)
        debiased.append(np.divide(fit.expert, fit.backbone))
        intervals.append(retention_interval(fit))
        if number < rival_draws:
            for found, together in zip(rivals, (True, False), strict=True):
                found.append(reselecting_interval(backbone, expert, generator, together))
    own_width = median_width(intervals[:rival_draws])
    return Study(
        world,
        plain=float(np.median(plain)),
        debiased=float(np.median(debiased)),
        coverage=coverage(intervals, world.retention),
        unbounded=float(np.mean([not interval.bounded for interval in intervals])),
        width=median_width(intervals),
        rivals=[Rival(coverage(found, world.retention), median_width(found), own_width) for found in rivals],
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
            average([estimate(world, generator, category) for category in range(4)]).centred for world in worlds
        )
        covered.append([covers(mean, 0.8), covers(mean - other, 0.3)])
    of_mean, of_difference = np.mean(covered, axis=0)
    return float(of_mean), float(of_difference)


def estimate(world: World, generator: np.random.Generator, category: int) -> Estimate:
    """Debiased retention of one data set, with draws that belong to `category`."""
    items = np.repeat(np.arange(ITEMS), 2)
    fit = crossfit(*(GroupScores.of(part, items) for part in draw(world, generator)), 0.5, category)
    drawn = retention_draws(fit, 0.5, category)
    return Estimate(fit.expert / fit.backbone, drawn, category)


def covers(estimated: Estimate, truth: float) -> bool:
    """Whether the interval holds the truth; one without limits does."""
    low, high = estimated.ci
    return low is None or high is None or low <= truth <= high


def best_mean(scores: GroupScores) -> np.float64:
    """Accuracy of the best site."""
    best: np.float64 = scores.sums.sum(axis=1).max() / scores.sizes.sum()
    return best


def reselecting_interval(
    backbone: GroupScores, expert: GroupScores, generator: np.random.Generator, together: bool
) -> Interval:
    """Percentile bootstrap over items that chooses sites anew in each of 100 resamples.

    together: whether all copies of an item are in one half.
    """
    ratios = []
    for _ in range(100):
        times = generator.multinomial(ITEMS, np.full(ITEMS, 1 / ITEMS))
        kept = np.arange(ITEMS) if together else np.repeat(np.arange(ITEMS), times)
        weight = times if together else np.ones(ITEMS)
        splits = random_halves(generator, np.flatnonzero(weight[: kept.size]), kept.size, REPEATS)
        above = [
            held_out_scores(GroupScores(part.sums[:, kept] * weight, part.sizes[kept] * weight), splits).sum()
            / (REPEATS * part.sizes[kept] @ weight)
            - 0.5
            for part in (expert, backbone)
        ]
        ratios.append(np.divide(*above))
    low, high = np.percentile(ratios, [2.5, 97.5])
    return Interval(float(low), float(high))


def coverage(intervals: list[Interval], truth: float) -> float:
    """Share of intervals that hold the truth."""
    return float(np.mean([interval.low <= truth <= interval.high for interval in intervals]))


def median_width(intervals: list[Interval]) -> float:
    """Median length of intervals."""
    return float(np.median([interval.high - interval.low for interval in intervals]))


def false_alarm(seed: int) -> tuple[float, float]:
    """p of the first of four backbone sites without signal, and the least family-wise p of all four."""
    items, labels = np.repeat(np.arange(24), 2), np.tile([True, False], 24)
    layers = correlated(np.random.default_rng(seed), 4, 48 * 12).reshape(4, 48, 12)
    relabellings = flip_items(labels, items, 99, seed)
    folds = nested_folds(labels, items, seed)
    probes = [probe_site(Samples.pooled(layer), labels, relabellings, folds) for layer in layers]
    accuracy = np.array([correctness(probe.decisions, labels).mean() for probe in probes])
    null = np.stack([probe.null for probe in probes])
    return float(pointwise_p(accuracy, null)[0]), float(max_statistic_p(accuracy, null).min())


def false_alarms(draws: int, keep: Path | None) -> str:
    """How often real probes on features without signal get p below 0.05, at one site and family-wise."""
    p = kept_draws(keep, "retention_null probes", range(draws), false_alarm)
    alarms = (p < SIGNIFICANCE).sum(axis=0)
    above = min(binomtest(int(n), draws, SIGNIFICANCE, alternative="greater").pvalue for n in alarms)
    site, family = alarms / draws
    return (
        f"no signal, real probes, {draws} draws: one site {site:.1%}, family-wise error {family:.1%}, so n/a in "
        f"{1 - family:.1%}; more than 5 %? p = {above:.3f}"
    )


def table_of(studies: list[Study], draws: int) -> Table:
    """One row per world."""
    table = Table(
        "backbone", "true", "plain", "debiased", "coverage", "unbounded", "width", "/ rival", "its coverage",
        "/ copies apart", "its coverage", title=f"Retention over {draws} draws: medians, nominal 95 % intervals",
    )  # fmt: skip
    for column in table.columns:
        column.no_wrap = True
    for one in studies:
        planted = one.world.top > 0
        table.add_row(
            one.world.name,
            f"{one.world.retention:.2f}" if planted else "–",
            f"{one.plain:.2f}",
            f"{one.debiased:.2f}",
            f"{one.coverage:.1%}" if planted else "–",
            f"{one.unbounded:.0%}",
            f"{one.width:.2f}",
            *(
                cell
                for number, rival in enumerate(one.rivals)
                for cell in (f"{one.width_ratio(number):.2f}", f"{rival.coverage:.0%}" if planted else "–")
            ),
        )
    return table


def verdicts(planted: list[Study]) -> list[str]:
    """Coverage and width over all worlds with a signal."""
    covered = [one.coverage for one in planted]
    lines = [f"coverage over the {len(planted)} worlds: mean {np.mean(covered):.1%}, least {min(covered):.1%}"]
    for number, name in enumerate(("copies together", "copies apart")):
        ratios = [one.width_ratio(number) for one in planted]
        theirs = [one.rivals[number].coverage for one in planted]
        lines.append(
            f"width / that of the re-selecting bootstrap, {name}: median {np.median(ratios):.2f}, most "
            f"{max(ratios):.2f}; its coverage: mean {np.mean(theirs):.1%}, least {min(theirs):.1%}"
        )
    return lines


@np.errstate(divide="ignore", invalid="ignore")  # a dead backbone can score exactly chance
def main() -> None:
    """Run both studies and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--rival-draws", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=0, help="of the draws; others are other data")
    parser.add_argument("--probe-draws", type=int, help="only the real probes, so many draws")
    parser.add_argument("--keep", type=Path, help="a folder that keeps draws of probes, to go on after a stop")
    arguments = parser.parse_args()
    if arguments.probe_draws is not None:
        print(false_alarms(arguments.probe_draws, arguments.keep))
        return
    draws = arguments.draws
    worlds = [World("dead", 0.0, 0.35, 0.0)]
    worlds += [
        World(f"{strength}, {shape}", top, peak, retention)
        for strength, top in (("strong", 0.25), ("weak", 0.12))
        for shape, peak in (("broad", 0.35), ("narrow", 0.15))
        for retention in RETENTIONS
    ]
    console = Console(width=140)
    # Beyond the grid: a peak of one layer, which half of the data often misses.
    worlds += [World(NEEDLE, 0.25, 0.05, retention) for retention in RETENTIONS]
    found = []
    for world in worlds:
        found.append(study(world, draws, arguments.rival_draws, arguments.first_seed))
        console.print(f"{world.name} {world.retention:.2f}: covered {found[-1].coverage:.1%}", highlight=False)
    console.print(table_of(found, draws))
    console.print(*verdicts([one for one in found if one.world.top > 0 and one.world.name != NEEDLE]), sep="\n")
    console.print(
        "Beyond the grid, peaks of one layer:",
        *verdicts([one for one in found if one.world.name == NEEDLE]),
        sep="\n",
    )
    mean, difference = joined_coverage(draws)
    console.print(f"bootstrap over four categories: mean covers {mean:.1%}, difference of groups {difference:.1%}")
    console.print(false_alarms(draws, arguments.keep), highlight=False)


if __name__ == "__main__":
    main()
