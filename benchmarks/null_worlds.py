"""False-alarm rates: p-values and controls in worlds without signal.

    python benchmarks/null_worlds.py [--draws 2000] [--control-draws 2000] [--rival-draws 500] [--probe lda]
        [--worlds …] [--keep DIR]

Probes: two sites of six features, 39 label permutations refitted; groups of two items in both layouts. Exactness
is a matter of label permutations and folds, so a linear discriminant with the classes' prior, which names the
larger class where it sees nothing, stands for the logistic probe; `--probe nested` fits that, at a hundred times
the cost. *Shared*: features of a group and of an item that hold no answer. *Mirrored*: features that hold the
answer in a direction of the group's own. *Missing*: that share of the episodes whose correct side is right. The
rival flips items. Controls: correctness of 75 groups of four episodes at 19 sites, neighbours correlated 0.9, and
at six unlike ones, against a random-features control and an untrained network that are as accurate. Groups are
independent here; `score_coverage.py` trains the probes of such worlds. `--keep` keeps the draws of
worlds, so that the same command resumes.
"""

import argparse
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from kept_draws import kept_draws
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from probe_kit.statistics.folds import OUTER_FOLDS, Fold, grouped_folds
from probe_kit.statistics.label_permutations import flip_groups, flip_items, max_statistic_p, p_value
from probe_kit.statistics.paired_tests import better_than_best, better_than_reference
from probe_kit.train.control_features import LAYERS
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.samples import Samples

SITES, WIDTH, PERMUTATIONS = 2, 6, 39
LEVEL = 0.05
OTHER = 10**9
"""Apart from the seeds of the data."""


@dataclass(frozen=True)
class World:
    """shared, mirrored: deviations of the features that a group has in common, without and with its own answer."""

    name: str
    groups: int
    shared: float = 0.0
    mirrored: float = 0.0
    missing: float = 0.0


WORLDS = (
    World("noise, 12 groups", 12),
    World("noise, 30 groups", 30),
    World("shared, 9 groups, enumerated", 9, shared=2.0),
    World("shared, 12 groups", 12, shared=2.0),
    World("shared, 30 groups", 30, shared=2.0),
    World("mirrored, 12 groups", 12, mirrored=2.0),
    World("mirrored, 30 groups", 30, mirrored=2.0),
    World("15 % missing", 24, missing=0.15),
    World("30 % missing", 24, missing=0.30),
    World("50 % missing", 24, missing=0.50),
    World("shared, 30 % missing", 24, shared=2.0, missing=0.30),
)


def discriminant(
    features: NDArray[np.float64], columns: NDArray[np.bool_], folds: list[Fold]
) -> NDArray[np.float64]:
    """(E, K) held-out decisions of a linear discriminant with unit covariance, per column of (E, K) labels."""
    decisions = np.empty(columns.shape)
    for fold in folds:
        train, truth = features[fold.train], columns[fold.train].astype(float)
        left, right = truth.sum(axis=0), (1 - truth).sum(axis=0)
        means = (train.T @ truth / left, train.T @ (1 - truth) / right)
        weights, middle = means[0] - means[1], (means[0] + means[1]) / 2
        prior = np.log(left / right) - (weights * middle).sum(axis=0)
        decisions[fold.test] = features[fold.test] @ weights + prior
    return decisions


def p_values(world: World, seed: int, by_item: bool = False, nested: bool = False) -> tuple[float, float]:
    """The p of the first site alone, and the family-wise p of the best.

    Args:
        world: How data and noise are drawn.
        seed: Of the draw.
        by_item: Also the p values of the test by items, which preceded the one by groups.
        nested: Choose the regularisation in inner folds.
    """
    generator = np.random.default_rng(seed)
    groups = np.repeat(np.arange(world.groups), 4)
    pattern = np.tile([True, False, False, True], world.groups)
    labels = pattern ^ (generator.random(world.groups) < 0.5)[groups]
    present = labels | (generator.random(labels.size) >= world.missing)
    items = np.arange(labels.size)[present] // 2
    sign = np.where(labels, 1.0, -1.0)[:, None]
    layers = []
    for _ in range(SITES):
        of_group, group_offsets = (generator.standard_normal((world.groups, WIDTH)) for _ in range(2))
        of_item = np.repeat(generator.standard_normal((2 * world.groups, WIDTH)), 2, axis=0)
        features = generator.standard_normal((labels.size, WIDTH)) + world.shared * (of_group[groups] + of_item)
        layers.append((features + world.mirrored * sign * group_offsets[groups])[present])
    labels, groups = labels[present], groups[present]
    if by_item:
        permuted = flip_items(labels, items, PERMUTATIONS, seed + OTHER)
    else:
        permuted = flip_groups(labels, groups, PERMUTATIONS, seed + OTHER)
    if nested:
        folds = nested_folds(labels, groups, seed + OTHER)
        probes = [probe_site(Samples.pooled(layer), labels, permuted, folds) for layer in layers]
        accuracy = np.array([correctness(probe.decisions, labels).mean() for probe in probes])
        null = np.stack([probe.null for probe in probes])
    else:
        columns = np.column_stack([labels, permuted])
        outer = grouped_folds(labels, groups, OUTER_FOLDS, seed + OTHER)
        scores = np.stack([correctness(discriminant(x, columns, outer), columns).mean(axis=0) for x in layers])
        accuracy, null = scores[:, 0], scores[:, 1:]
    return float(p_value(accuracy, null)[0]), float(max_statistic_p(accuracy, null).min())


def correlated(
    generator: np.random.Generator, sites: int, accuracy: float, neighbours: float = 0.9
) -> NDArray[np.bool_]:
    """(sites, 300) correctness; episodes of a group are correlated 0.3."""
    from scipy.special import ndtri

    of_group = np.repeat(generator.standard_normal((sites, 75)), 4, axis=1)
    values = np.sqrt(0.3) * of_group + np.sqrt(0.7) * generator.standard_normal((sites, 300))
    for site in range(1, sites):
        values[site] = neighbours * values[site - 1] + np.sqrt(1 - neighbours**2) * values[site]
    right: NDArray[np.bool_] = values < ndtri(accuracy)
    return right


def control_alarms(accuracy: float, draws: int, sites: int, neighbours: float) -> tuple[float, float]:
    """How often any of the sites exceeds an equally accurate random-features control, and untrained network."""
    groups, alarms = np.repeat(np.arange(75), 4), []
    for seed in range(draws):
        generator = np.random.default_rng(seed)
        site_scores, other_scores = (correlated(generator, sites, accuracy, neighbours) for _ in range(2))
        layers = [correlated(generator, 1, accuracy)[0] for _ in range(LAYERS)]
        reference = np.mean(layers, axis=0)
        alarms.append(
            [
                better_than_reference(site_scores, reference, groups, seed + OTHER).min() < LEVEL,
                better_than_best(site_scores, other_scores, groups, seed + OTHER).min() < LEVEL,
            ]
        )
    random_features, untrained = np.mean(alarms, axis=0)
    return float(random_features), float(untrained)


def main() -> None:
    """Run all worlds and print them as they end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--control-draws", type=int, default=2000)
    parser.add_argument("--rival-draws", type=int, default=500)
    parser.add_argument("--probe", choices=("lda", "nested"), default="lda")
    parser.add_argument("--worlds", default="", help="beginnings of names, separated by semicolons; default all")
    parser.add_argument("--keep", type=Path, help="a folder that keeps draws, to go on after a stop")
    arguments = parser.parse_args()
    console = Console(width=110)
    with threadpool_limits(1):
        accuracies = (0.5, 0.6, 0.8) if arguments.control_draws else ()
        controls = Table(
            "sites",
            "accuracy",
            "random-features",
            "untrained",
            title=f"false alarms, {arguments.control_draws} draws",
        )
        for accuracy, (sites, neighbours) in product(accuracies, ((19, 0.9), (6, 0.0))):
            random_features, untrained = control_alarms(accuracy, arguments.control_draws, sites, neighbours)
            controls.add_row(str(sites), f"{accuracy:.1f}", f"{random_features:.1%}", f"{untrained:.1%}")
        if accuracies:
            console.print(controls)
        names = tuple(arguments.worlds.split(";"))
        for world in (world for world in WORLDS if world.name.startswith(names)):
            nested, seeds = arguments.probe == "nested", range(arguments.draws)
            name = f"{arguments.probe} {world.name}"
            alarms = kept_draws(arguments.keep, name, seeds, partial(p_values, world, nested=nested)) <= LEVEL
            rivals = seeds[: arguments.rival_draws]
            rival = np.mean([p_values(world, seed, True, nested)[0] <= LEVEL for seed in rivals] or [np.nan])
            hits = alarms.sum(axis=0)
            above = min(binomtest(int(n), len(alarms), LEVEL, alternative="greater").pvalue for n in hits)
            console.print(
                f"{world.name:30} p ≤ 0.05: site {alarms[:, 0].mean():5.1%}, family {alarms[:, 1].mean():5.1%}; "
                f"more than 5 %? p = {above:.3f}; flips of items {rival:6.1%}",
                highlight=False,
            )


if __name__ == "__main__":
    main()
