"""What probes claim about scores, with trained probes: intervals, limits, and what exceeds the controls.

    python benchmarks/score_coverage.py [--draws 100] [--seed 0] [--full] [--only exceeding;leaks]

accuracies: coverage and median width of Wilson's interval of one site, and of Korn and Graubard's in brackets.
Groups of four episodes, or of 2 to 16, hold both sides equally often. A part `alike` of the signal's noise is
common to a group. The truth is the mean accuracy over draws, so intervals must also hold what another training set
would change.

exceeding: how often sites that are only as accurate as `random-features` exceed it. leaks: how often sites that
hold the brightness of pictures, which gives the answer away, are shown. limits: how often an added error raises a
limit of a site or a stream. rates: coverage of success rates of very unequal groups.

Probes are nested as `probe-kit train` fits them, without label permutations: chance is tested by groups. `--full`
runs all of these, and adds 6 and 60 groups and more correlation to the accuracies. The default runs the accuracies
only, in 2 minutes.
"""

import argparse
from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.special import ndtri
from threadpoolctl import threadpool_limits

from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.statistics.crossfit import GroupSums, SiteScores, balanced_sums, crossfit
from probe_kit.statistics.folds import fold_numbers, sums_by_group
from probe_kit.statistics.intervals import Accuracy, Share
from probe_kit.statistics.paired_tests import better_than_best, better_than_reference
from probe_kit.statistics.retention import accuracy_interval
from probe_kit.statistics.share_limits import korn_graubard_limits, wilson_limits
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.control_features import LAYERS
from probe_kit.train.controls import is_informative
from probe_kit.train.crossval.nested_folds import NestedFold, nested_folds
from probe_kit.train.crossval.site_probe import SiteProbe, probe_site
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
    probe = trained(features, labels, folds)
    sums = balanced_sums(probe.decisions[None, :], labels, fold_numbers([fold.outer for fold in folds]), group_of)
    names = np.arange(groups).astype(str)
    limits = [of(names, sums.sums[0], sums.sizes).interval() for of in (Accuracy, Share)]
    return float(sums.accuracies[0]), *((interval.low, interval.high) for interval in limits)  # type: ignore[return-value]


def rows(groups: tuple[int, ...], alike: tuple[float, ...], draws: int, seed: int) -> Iterator[tuple[str, ...]]:
    """Cells of the table, a world at a time."""
    for count, kind, shared in product(groups, ("equal", "unequal"), alike):
        cells = []
        for accuracy in ACCURACIES:
            seeds = [derive_seed("scores", seed, count, kind, accuracy, shared, number) for number in range(draws)]
            drawn = [draw(count, kind, accuracy, shared, draw_seed) for draw_seed in seeds]
            truth = float(np.mean([score for score, *_ in drawn]))
            texts = []
            for limits in ([outcome[1] for outcome in drawn], [outcome[2] for outcome in drawn]):
                covered = np.mean([low - 1e-9 <= truth <= high + 1e-9 for low, high in limits])
                texts.append(f"{covered:.0%} {np.median([high - low for low, high in limits]):.2f}")
            cells.append(f"{truth:.2f}: {texts[0]} ({texts[1]})")
        yield f"{count} {kind}, {shared:g}", *cells


def trained(features: Matrix, labels: NDArray[np.bool_], folds: list[NestedFold]) -> SiteProbe:
    """The nested probe of (E, D) features, without label permutations."""
    return probe_site(Samples.pooled(features), labels, np.empty((labels.size, 0), np.bool_), folds)


# -- what exceeds the controls -------------------------------------------------------------------------------

SITES = 6
EXCEEDING = (
    (20, 1, 0.5),
    (20, 1, 0.65),
    (30, 1, 0.8),
    (16, 2, 0.75),
    (50, 1, 0.7),
    (50, 1, 0.85),
)
"""Groups, items of each, and the accuracy that each site and layer allows."""


def exceed(groups: int, items: int, accuracy: float, seed: int) -> tuple[float, bool, bool, bool]:
    """Accuracy of the sites; whether any of six, one of them, and any of six over a network's best exceeds."""
    generator = np.random.default_rng(seed)
    group_of = np.repeat(np.arange(groups), 2 * items)
    labels = np.tile([True, False], groups * items)
    folds = nested_folds(labels, group_of, seed)

    def right(count: int, alike: float) -> Matrix:
        noise = generator.standard_normal((count, labels.size, 2 * WIDTH))
        for at in range(1, count):
            noise[at] = alike * noise[at - 1] + np.sqrt(1 - alike**2) * noise[at]
        noise[:, :, 0] += ndtri(accuracy) * np.where(labels, 1, -1)
        return np.array([(trained(each, labels, folds).decisions > 0) == labels for each in noise], float)

    sites, layers, network = right(SITES, 0.9), right(LAYERS, 0.0), right(SITES, 0.9)
    p = better_than_reference(sites, layers.mean(axis=0), group_of, seed)
    alone = better_than_reference(sites[:1], layers.mean(axis=0), group_of, seed)[0]
    best = better_than_best(sites, network, group_of, seed)
    return float(sites.mean()), p.min() < SIGNIFICANCE, alone < SIGNIFICANCE, best.min() < SIGNIFICANCE


def exceeding(draws: int, seed: int) -> Table:
    """Shares of draws in which sites that are no better than a control exceed it."""
    columns = ("groups, items, possible", "accuracy", "any of six sites", "one site", "an equal network")
    table = Table(*columns, title=f"exceeds without being better, {draws} draws")
    for world in EXCEEDING:
        drawn = [exceed(*world, derive_seed("exceeding", seed, *world, number)) for number in range(draws)]
        accuracy, *shares = np.mean(drawn, axis=0)
        name = f"{world[0]}, {world[1]}, {world[2]:g}"
        table.add_row(name, f"{accuracy:.2f}", *(f"{share:.1%}" for share in shares))
    return table


PIXELS = 16
LEAKS = ((20, 0.7), (20, 1.5), (50, 0.5), (50, 1.0), (50, 1.8))
"""Groups, and how much brighter the correct picture is, in standard deviations of a picture's brightness."""


def leak(groups: int, brighter: float, seed: int) -> tuple[float, float, float, bool, bool, bool]:
    """Accuracies of sites, layers and `pixels`; whether `pixels` is asked, and sites are shown, or would be."""
    generator = np.random.default_rng(seed)
    group_of, labels = np.repeat(np.arange(groups), 2), np.tile([True, False], groups)
    folds = nested_folds(labels, group_of, seed)
    pictures = 2 * generator.standard_normal((groups, 2, PIXELS)) + generator.standard_normal((groups, 2, 1))
    pictures[:, 0] += brighter
    both = np.stack([pictures.reshape(groups, -1), pictures[:, ::-1].reshape(groups, -1)], axis=1)
    pixels = both.reshape(2 * groups, -1)
    brightness = pixels.reshape(-1, 2, PIXELS).mean(axis=2)

    def probed(features: Matrix) -> SiteProbe:
        return trained(features, labels, folds)

    def layer() -> Matrix:
        weights = generator.standard_normal((2 * PIXELS, 2 * PIXELS)) / np.sqrt(2 * PIXELS)
        return np.tanh((pixels - pixels.mean(axis=0)) / pixels.std(axis=0) @ weights)

    noise = [0.1 * generator.standard_normal(brightness.shape) for _ in range(SITES)]
    sites = np.array([(probed(brightness + each).decisions > 0) == labels for each in noise], float)
    layers = np.array([(probed(layer()).decisions > 0) == labels for _ in range(LAYERS)], float)
    control = probed(pixels)
    right = ((control.decisions > 0) == labels).astype(float)
    is_tested = is_informative(sums_by_group(control.inner, group_of), labels, group_of)
    best = int(sites.mean(axis=1).argmax())
    exceeds = better_than_reference(sites, layers.mean(axis=0), group_of, seed)[best] < SIGNIFICANCE
    is_shown = exceeds and (
        not is_tested or better_than_reference(sites, right, group_of, seed)[best] < SIGNIFICANCE
    )
    return float(sites.mean()), float(layers.mean()), float(right.mean()), is_tested, is_shown, exceeds


def leaks(draws: int, seed: int) -> Table:
    """Shares of draws in which a leak of the pictures alone is shown."""
    columns = ("groups, brighter", "sites", "layers", "pixels", "asks pixels", "shown", "without pixels")
    table = Table(*columns, title=f"a leak of the pictures, {draws} draws")
    for world in LEAKS:
        drawn = [leak(*world, derive_seed("leaks", seed, *world, number)) for number in range(draws)]
        means = np.mean(drawn, axis=0)
        accuracies, shares = means[:3], means[3:]
        cells = (*(f"{share:.2f}" for share in accuracies), *(f"{share:.1%}" for share in shares))
        table.add_row(f"{world[0]}, {world[1]:g}", *cells)
    return table


# -- limits that never rise ----------------------------------------------------------------------------------

PATTERNS: dict[str, Callable[[Matrix, Matrix, np.random.Generator], int]] = {
    "spread": lambda errors, sizes, _: int(np.argmin(np.where(errors < sizes, errors, np.inf))),
    "drawn": lambda errors, sizes, generator: int(generator.choice(np.flatnonzero(errors < sizes))),
    "group by group": lambda errors, sizes, _: int(np.argmax(errors < sizes)),
}
LIMITED = ((10, 6), (16, 4), (30, 2), (14, 0))
"""Groups and their episodes; 0: of 1 to 7 episodes."""


def errors_one_by_one(sizes: Matrix, pattern: str, generator: np.random.Generator) -> Matrix:
    """(E + 1, G) errors of every group, from none to all."""
    steps = [np.zeros(sizes.size)]
    while steps[-1].sum() < sizes.sum():
        at = PATTERNS[pattern](steps[-1], sizes, generator)
        steps.append(steps[-1] + (np.arange(sizes.size) == at))
    return np.array(steps)


def limits(draws: int, seed: int) -> Table:
    """How many added errors raise a limit of a site or of a stream whose sites have the same errors."""
    table = Table("groups", "errors", "site: steps that rise", "stream: steps that rise", title="limits")
    for (groups, size), pattern in product(LIMITED, PATTERNS):
        sizes = np.full(groups, float(size)) if size else 1.0 + np.arange(groups) % 7
        site, stream = [], []
        for number in range(max(1, draws // 25)):
            generator = np.random.default_rng(derive_seed("limits", seed, groups, size, pattern, number))
            right = sizes - errors_one_by_one(sizes, pattern, generator)
            site.append(np.diff(wilson_limits(right, sizes), axis=1).max(axis=0))
            stream.append(np.diff(_limits_of_streams(right, sizes, 3 + number % 11), axis=0).max(axis=1))
        cells = [_rises(np.concatenate(steps)) for steps in (site, stream)]
        table.add_row(f"{groups} of {size or '1 to 7'}", pattern, *cells)
    return table


def _rises(steps: Matrix) -> str:
    largest = max(0.0, 100 * float(steps.max()))
    return f"{(steps > 1e-9).sum()} of {steps.size}, largest {largest:.1f} points"


def _limits_of_streams(right: Matrix, sizes: Matrix, sites: int) -> Matrix:
    """(N, 2) limits of streams of tied sites, of (N, G) right decisions."""
    fold_of, names = np.arange(sizes.size) % 5, [f"g{number:03d}" for number in range(sizes.size)]
    bounds = []
    for sums in right:
        scores = GroupSums(np.repeat(sums[None], sites, axis=0), sizes)
        inner = np.where(fold_of == np.arange(5)[:, None], 0.0, scores.sums[:, None, :])
        interval = accuracy_interval(crossfit([SiteScores.of(scores, inner, fold_of, np.arange(sites))], names), 0)
        bounds.append((interval.low, interval.high))
    return np.array(bounds)


# -- success rates of very unequal groups --------------------------------------------------------------------

RATES = (0.02, 0.05, 0.2, 0.5, 0.9)
UNEQUAL: dict[str, Callable[[int, np.random.Generator], Matrix]] = {
    "Pareto, 2 to 40": lambda groups, generator: np.minimum(40, np.ceil(2 * generator.random(groups) ** -0.8)),
    "2 to 24, few large": lambda groups, _: 2 * np.ceil(12 * np.exp(-3 * np.linspace(0, 1, groups))),
    "one of 30, else 2": lambda groups, _: np.append(np.full(groups - 1, 2.0), 30.0),
}


def rates(draws: int, seed: int) -> Table:
    """Least coverage and mean width of success rates over 18 to 120 groups, answered alike or not."""
    table = Table("groups of", *(f"SR {rate:g}" for rate in RATES), title="SR of very unequal groups")
    for name, sizes_of_kind in UNEQUAL.items():
        cells = []
        for rate in RATES:
            covered, widths = [], []
            for groups, alike in product((18, 30, 60, 120), (0.0, 0.5, 1.0)):
                generator = np.random.default_rng(derive_seed("rates", seed, name, rate, groups, alike))
                sizes = sizes_of_kind(groups, generator)
                chance = np.full((10 * draws, groups), rate)
                if alike:
                    odds = (1 / alike - 1) or 1e-9
                    chance = generator.beta(rate * odds, (1 - rate) * odds, chance.shape)
                hits = generator.binomial(sizes.astype(np.int64), chance).astype(float)
                low, high = korn_graubard_limits(hits, sizes)
                covered.append(np.mean((low <= rate) & (rate <= high)))
                widths.append(np.median(high - low))
            cells.append(f"{min(covered):.1%} {np.mean(widths):.2f}")
        table.add_row(name, *cells)
    return table


PARTS = {"exceeding": exceeding, "leaks": leaks, "limits": limits, "rates": rates}


def main() -> None:
    """Draw every world and print the tables as they end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--only", default="", help="tables, separated by semicolons")
    options = parser.parse_args()
    names = options.only.split(";") if options.only else ["accuracies", *(PARTS if options.full else ())]
    console = Console(width=190)
    with threadpool_limits(1):
        for name in names:
            if name != "accuracies":
                console.print(PARTS[name](options.draws, options.seed))
                continue
            groups, alike = ((6, 12, 24, 60), (0.05, 0.5, 0.9)) if options.full else ((12, 24), (0.05,))
            title = "accuracy of one site"
            table = Table("groups, alike", *(f"{share:g}" for share in ACCURACIES), title=title)
            for cells in rows(groups, alike, options.draws, options.seed):
                table.add_row(*cells)
            console.print(table)


if __name__ == "__main__":
    main()
