"""Success-rate intervals, the verdict `absent`, comparisons of models, and probes with missing episodes.

    python benchmarks/verdict_coverage.py [--draws 600] [--only rates;absent] [--seed 0] [--workers 1]

rates: coverage of success rates in seven kinds of worlds with 6 to 150 groups, of their means over twelve
categories, and of differences of two runs. unequal: of success rates in 96 worlds of groups of very unequal
size. absent: how often it is said where the best site has exactly the bound, and where nothing is there. models:
exchange p and Welch's interval of groups of models that do not differ; spreads: of unequal sizes and spreads;
sisters: of several checkpoints of each training. missing: retention of real nested probes with up to 60 % of one
side missing; it uses a sixtieth of the draws.
"""

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from coverage_worlds import neighbours
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.special import ndtri
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from probe_kit.hashing import derive_seed
from probe_kit.statistics.crossfit import GroupSums, SiteScores, balanced_sums, crossfit
from probe_kit.statistics.folds import fold_numbers, fold_of_groups, sums_by_group
from probe_kit.statistics.intervals import Share, difference_interval, mean_interval
from probe_kit.statistics.model_groups import exchange_p, is_exchangeable, welch_interval
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import ABSENT_BELOW, at_most, findable, is_absent
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.samples import Samples

Sizes = NDArray[np.int64]


@dataclass(frozen=True)
class Rates:
    """A kind of world of success rates.

    Attributes:
        rate: True share.
        alike: Correlation of the episodes of a group (beta-binomial).
        sizes: Episodes of G groups.
    """

    name: str
    rate: float
    alike: float
    sizes: Callable[[int], Sizes]

    def draw(self, groups: int, generator: np.random.Generator) -> tuple[NDArray[np.bool_], Sizes]:
        """(E,) outcomes and groups."""
        group_of = np.repeat(np.arange(groups), self.sizes(groups))
        if self.alike == 0:
            return generator.random(group_of.size) < self.rate, group_of
        scale = 1 / self.alike - 1
        chance = generator.beta(self.rate * scale, (1 - self.rate) * scale, groups)
        return generator.random(group_of.size) < chance[group_of], group_of


def _equal(size: int) -> Callable[[int], Sizes]:
    return lambda groups: np.full(groups, size)


def _unequal(groups: int) -> Sizes:
    return 2 * (1 + np.arange(groups) % 8)


def _dominant(groups: int) -> Sizes:
    """One group has 29 % of the episodes."""
    sizes = np.full(groups, 4)
    sizes[0] = round(0.29 / 0.71 * 4 * (groups - 1))
    return sizes


KINDS = (
    Rates("groups of four, SR .8", 0.8, 0.3, _equal(4)),
    Rates("groups of four, SR .5", 0.5, 0.3, _equal(4)),
    Rates("groups of four, SR .99", 0.99, 0.3, _equal(4)),
    Rates("independent episodes, SR .7", 0.7, 0.0, _equal(4)),
    Rates("groups that agree, SR .6", 0.6, 0.9, _equal(4)),
    Rates("groups of unequal size, SR .7", 0.7, 0.3, _unequal),
    Rates("one group with 29 %, SR .7", 0.7, 0.3, _dominant),
)
GROUPS = (6, 12, 24, 75, 150)
UNEQUAL_RATES = (0.5, 0.7, 0.9, 0.97)


def rates(draws: int, seed: int) -> Table:
    """Coverage and width of a category, of a mean of twelve and of a difference."""
    table = Table("world", *(f"{count} groups" for count in GROUPS), title="SR: category, mean of 12, difference")
    for kind in KINDS:
        table.add_row(kind.name, *(_rates(kind, count, draws, seed) for count in GROUPS))
    return table


def _rates(kind: Rates, groups: int, draws: int, seed: int) -> str:
    generator = np.random.default_rng(derive_seed("rates", seed, kind.name, groups))
    shares = [Share.of(*kind.draw(groups, generator)) for _ in range(draws)]
    limits = [share.interval() for share in shares]
    coverage = np.mean([interval.low <= kind.rate <= interval.high for interval in limits])
    width = np.median([interval.high - interval.low for interval in limits])
    means, gaps = [], []
    for _ in range(draws):
        positions = generator.permutation(draws)[:12]
        mean = mean_interval([shares[at].value for at in positions], [limits[at] for at in positions])
        means.append(mean.low <= kind.rate <= mean.high)
        a, b = positions[:2]
        gap = difference_interval(shares[a].value, limits[a], shares[b].value, limits[b])
        gaps.append(gap.low <= 0 <= gap.high)
    return f"{coverage:.1%} {width:.2f}, {np.mean(means):.1%}, {np.mean(gaps):.1%}"


def _steep(groups: int) -> Sizes:
    """A few groups have most of the episodes: 40 of the largest, 2 of the smallest."""
    return 2 * np.ceil(20 * np.exp(-3 * np.linspace(0, 1, groups))).astype(np.int64)


def unequal(draws: int, seed: int) -> Table:
    """Least and mean coverage, and median width, by rate and sizes; over 6 to 75 groups and two correlations."""
    sizes = {"2 to 16 episodes": _unequal, "one group with 29 %": _dominant, "2 to 40, few large": _steep}
    table = Table(
        "groups of", *(f"SR {rate:g}" for rate in UNEQUAL_RATES), title="SR of unequal groups: 96 worlds"
    )
    for name, size in sizes.items():
        cells = []
        for rate in UNEQUAL_RATES:
            shares, widths = [], []
            for alike, groups in product((0.1, 0.5), (6, 12, 24, 75)):
                generator = np.random.default_rng(derive_seed("unequal", seed, name, rate, alike, groups))
                kind = Rates(name, rate, alike, size)
                limits = [Share.of(*kind.draw(groups, generator)).interval() for _ in range(draws)]
                shares.append(np.mean([interval.low <= rate <= interval.high for interval in limits]))
                widths.append(np.median([interval.high - interval.low for interval in limits]))
            cells.append(f"{min(shares):.1%}, {np.mean(shares):.1%}, {np.mean(widths):.2f}")
        table.add_row(name, *cells)
    return table


SITES = (1, 4, 19, 180)
OF_GROUP = 0.3


def draw_right(
    above: NDArray[np.float64], group_of: NDArray[np.intp], generator: np.random.Generator
) -> NDArray[np.bool_]:
    """(S, E) correctness of sites with (S,) accuracies above chance; neighbours and groups are alike."""
    of_group, individual = (
        neighbours(generator.standard_normal((above.size, count)))
        for count in (int(group_of[-1]) + 1, group_of.size)
    )
    values = np.sqrt(OF_GROUP) * of_group[:, group_of] + np.sqrt(1 - OF_GROUP) * individual
    right: NDArray[np.bool_] = values < ndtri(0.5 + above)[:, None]
    return right


def absent(draws: int, seed: int) -> Table:
    """How often `absent` is said: wrongly at the bound, where one site or all have it, and rightly of nothing."""
    title = f"absent below {ABSENT_BELOW}: share of experiments"
    table = Table("sites", "groups", "one site at the bound", "all sites at the bound", "nothing", title=title)
    for sites in SITES:
        for groups in (24, 40, 75, 150):
            cells = []
            generator = np.random.default_rng(derive_seed("absent threshold", seed, sites, groups))
            best = [
                _sites(np.full(sites, 0.5), groups, generator).accuracies.max() for _ in range(max(draws, 200))
            ]
            threshold = float(np.quantile(best, 1 - SIGNIFICANCE))
            for name in ("one", "all", "nothing"):
                above = np.zeros(sites)
                above[slice(None) if name == "all" else slice(sites // 2, sites // 2 + 1)] = ABSENT_BELOW - 0.5
                generator = np.random.default_rng(derive_seed("absent", seed, sites, groups, name))
                shares = 0.5 + (np.zeros(sites) if name == "nothing" else above)
                drawn = (_sites(shares, groups, generator) for _ in range(draws))
                declared_absent = [is_absent(at_most(outcome), findable(outcome, threshold)) for outcome in drawn]
                cells.append(f"{np.mean(declared_absent):.1%}")
            table.add_row(str(sites), str(groups), *cells)
    return table


def _sites(shares: NDArray[np.float64], groups: int, generator: np.random.Generator) -> GroupSums:
    """Groups of four episodes; neighbouring sites are correlated."""
    group_of = np.repeat(np.arange(groups), 4)
    right = draw_right(shares - 0.5, group_of, generator)
    return GroupSums(right.reshape(shares.size, groups, 4).sum(axis=2).astype(float), np.full(groups, 4.0))


def models(draws: int, seed: int) -> Table:
    """False alarms of the exact p and of Welch's interval where two groups of models do not differ."""
    table = Table(
        "models", "p ≤ .05", "smallest p", "Welch without 0", title="groups of models that do not differ"
    )
    for count in (3, 4, 5, 6):
        generator = np.random.default_rng(derive_seed("models", seed, count))
        # Between models 0.08, and what the items of each add.
        values = 0.5 + generator.normal(0, np.hypot(0.08, 0.03), (draws, 2, count))
        p = [exchange_p(*pair) for pair in values]
        out = [not interval.low <= 0 <= interval.high for interval in (welch_interval(*pair) for pair in values)]
        alarms = np.mean([result.p <= SIGNIFICANCE for result in p])
        table.add_row(f"{count} + {count}", f"{alarms:.1%}", f"{p[0].smallest:.3f}", f"{np.mean(out):.1%}")
    return table


SPREADS = ((3, 9, 1), (3, 9, 3), (4, 8, 3), (3, 6, 5), (2, 8, 3), (2, 12, 5), (4, 4, 5), (6, 6, 3), (6, 6, 5))


def spreads(draws: int, seed: int) -> Table:
    """Two groups of equal means: the first has fewer models, and a spread so many times as large."""
    columns = ("models", "spread", "p ≤ .05 if shown always", "p ≤ .05 as shown", "Welch without 0")
    table = Table(*columns, title="groups of models of unequal size and spread")
    for few, many, spread in SPREADS:
        generator = np.random.default_rng(derive_seed("spreads", seed, few, many, spread))
        pairs = [(generator.normal(0, 0.08 * spread, few), generator.normal(0, 0.08, many)) for _ in range(draws)]
        small = np.array([exchange_p(*pair).p <= SIGNIFICANCE for pair in pairs])
        exchangeable = np.array([is_exchangeable(*pair) for pair in pairs])
        out = [not interval.low <= 0 <= interval.high for interval in (welch_interval(*pair) for pair in pairs)]
        shares = (f"{share:.1%}" for share in (small.mean(), (small & exchangeable).mean(), np.mean(out)))
        table.add_row(f"{few} + {many}", f"× {spread}", *shares)
    return table


def sisters(draws: int, seed: int) -> Table:
    """Two groups of trainings with three checkpoints each: false alarms of each checkpoint, and of their means."""
    table = Table("trainings", "p ≤ .05, each checkpoint", "p ≤ .05, means", title="sister checkpoints")
    for count in (2, 4, 6):
        generator = np.random.default_rng(derive_seed("sisters", seed, count))
        alarms = []
        for _ in range(draws):
            models = generator.normal(0, 0.08, (2, count, 1)) + generator.normal(0, 0.03, (2, count, 3))
            each, mean = models.reshape(2, -1), models.mean(axis=2)
            alarms.append([exchange_p(*values).p <= SIGNIFICANCE for values in (each, mean)])
        table.add_row(f"{count} + {count}", *(f"{share:.1%}" for share in np.mean(alarms, axis=0)))
    return table


MISSING = (0.0, 0.1, 0.25, 0.4, 0.6)
WIDTH, PAIRS = 16, 150


def missing(draws: int, seed: int) -> Table:
    """Retention by real nested probes of one network, with more and more episodes of the left side missing."""
    table = Table(
        "left missing", "backbone", "action", "ratio of the means", "±", title="missing episodes of one side"
    )
    above = np.array([_probed(derive_seed("missing", seed, number)) for number in range(draws)])
    for column, share in enumerate(MISSING):
        scores = above[:, column]
        expert, backbone = scores.mean(axis=0)
        each = (scores[:, 0] - expert / backbone * scores[:, 1]) / backbone
        error = each.std(ddof=1) / np.sqrt(draws) if draws > 1 else np.nan
        numbers = (backbone, expert, expert / backbone, error)
        table.add_row(f"{share:.0%}", *(f"{number:.3f}" for number in numbers))
    return table


def _probed(seed: int) -> NDArray[np.float64]:
    """(len(MISSING), 2) scores above chance of (expert, backbone) on the same items."""
    generator = np.random.default_rng(seed)
    groups = np.repeat(np.arange(PAIRS), 4)
    labels = np.tile([True, False], 2 * PAIRS)
    drawn = generator.random(labels.size)
    features = [_features(labels, strength, generator) for strength in (0.20, 0.32, 0.26, 0.50, 0.75, 0.6)]
    fits = []
    for share in MISSING:
        present = ~labels | (drawn >= share)
        folds = nested_folds(labels[present], groups[present], seed=0)
        fold_of = fold_numbers([fold.outer for fold in folds])
        nothing = np.empty((fold_of.size, 0), np.bool_)
        probes = [
            probe_site(Samples.pooled(site_features[present]), labels[present], nothing, folds)
            for site_features in features
        ]
        decisions, inner = (
            np.array([getattr(probe, part) for probe in probes]) for part in ("decisions", "inner")
        )
        sums = balanced_sums(decisions, labels[present], fold_of, groups[present])
        by_group, fold_of_group = sums_by_group(inner, groups[present]), fold_of_groups(fold_of, groups[present])
        streams = [
            SiteScores.of(sums.only(rows), by_group[rows], fold_of_group, [0, 1, 2])
            for rows in ([0, 1, 2], [3, 4, 5])
        ]
        fits.append(crossfit(streams, np.unique(groups[present]).astype(str).tolist()).above)
    return np.array(fits)


def _features(labels: NDArray[np.bool_], strength: float, generator: np.random.Generator) -> NDArray[np.float64]:
    values = generator.standard_normal((labels.size, WIDTH))
    values[:, 0] += strength * np.where(labels, 1, -1)
    return values


SECTIONS: dict[str, Callable[[int, int], Table]] = {
    "rates": rates,
    "unequal": unequal,
    "absent": absent,
    "models": models,
    "spreads": spreads,
    "sisters": sisters,
    "missing": missing,
}


def _run(name: str, draws: int, seed: int) -> Table:
    with threadpool_limits(1):
        return SECTIONS[name](max(2, draws // 60) if name == "missing" else draws, seed)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the sections and print each as it ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=600)
    parser.add_argument("--only", default=";".join(SECTIONS), help="sections, separated by semicolons")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    console = Console(width=170)
    error = binomtest(round(0.95 * options.draws), options.draws).proportion_ci()
    console.print(f"{options.draws} draws: 95 % is known to {error.low:.1%} … {error.high:.1%}", highlight=False)
    with ProcessPoolExecutor(options.workers) as pool:
        for table in pool.map(partial(_run, draws=options.draws, seed=options.seed), options.only.split(";")):
            console.print(table)


if __name__ == "__main__":
    main()
