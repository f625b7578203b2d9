"""Worlds of activations with known signal, on which the package's own probes are trained.

A group has one or more items, each in two layouts whose correct sides are opposite. Features are normal: a part is
common to the episodes of a group, a part to both streams, and neighbouring sites resemble each other. One feature
holds the side, so strongly that the best possible probe of a site has the accuracy that a world says.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.statistics.crossfit import CrossFit, SiteScores, balanced_sums, crossfit
from probe_kit.statistics.folds import fold_numbers, fold_of_groups, sums_by_group
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import SiteProbe, probe_site
from probe_kit.train.samples import Samples

WIDTH = 16
OF_GROUP, SHARED, NEIGHBOURS = 0.4, 0.4, 0.9
"""Shares of variance of groups and of what both streams hold, and the correlation of neighbouring sites."""
LARGEST = 0.5 - 1e-4


@dataclass(frozen=True)
class World:
    """A stream of the backbone and one of the expert, with the accuracy that each site allows.

    Attributes:
        top: Accuracy above chance of the best possible probe at the backbone's best site.
        retention: The expert's best as a share of it.
        sizes: Items of every group.
        sites: Of either stream.
        plateau: Whether the last 40 % of the sites are equally good, else they are around a peak.
        one_site: Only one site holds anything.
    """

    name: str
    top: float
    retention: float = 0.0
    sizes: tuple[int, ...] = (1,) * 24
    sites: int = 13
    plateau: bool = False
    one_site: bool = False

    def above(self) -> tuple[Matrix, Matrix]:
        """(S,) accuracies above chance that the sites of expert and backbone allow."""
        depth = np.linspace(0, 1, self.sites)
        shape = np.exp(-0.5 * ((depth - 0.65) / 0.2) ** 2)
        if self.plateau:
            shape = (depth >= 0.6).astype(float)
        if self.one_site:
            shape = (np.arange(self.sites) == self.sites // 2).astype(float)
        backbone = self.top * shape
        return (self.retention * backbone).clip(max=LARGEST), backbone.clip(max=LARGEST)


@dataclass(frozen=True)
class DataSet:
    """(E,) labels and groups, and (S, E, D) features of the sites of (expert, backbone)."""

    labels: NDArray[np.bool_]
    groups: NDArray[np.str_]
    features: tuple[NDArray[np.float32], NDArray[np.float32]]


def draw(world: World, seed: int) -> DataSet:
    """One data set of a world."""
    generator = np.random.default_rng(derive_seed("world", seed, world.name))
    items = np.repeat(np.arange(len(world.sizes)), world.sizes)
    first = generator.random(items.size) < 0.5
    labels, group_of = np.stack([first, ~first], axis=1).ravel(), np.repeat(items, 2)
    common = _noise(generator, world.sites, group_of)
    features = []
    for above in world.above():
        values = np.sqrt(SHARED) * common + np.sqrt(1 - SHARED) * _noise(generator, world.sites, group_of)
        values[:, :, 0] += ndtri(0.5 + above)[:, None] * np.where(labels, 1, -1)
        features.append(values.astype(np.float32))
    names = np.array([f"group-{number:04d}" for number in group_of])
    return DataSet(labels, names, (features[0], features[1]))


def _noise(generator: np.random.Generator, sites: int, group_of: NDArray[np.intp]) -> Matrix:
    """(S, E, D) standard normal values."""
    of_group = neighbours(generator.standard_normal((sites, int(group_of[-1]) + 1, WIDTH)))
    individual = neighbours(generator.standard_normal((sites, group_of.size, WIDTH)))
    values: Matrix = np.sqrt(OF_GROUP) * of_group[:, group_of] + np.sqrt(1 - OF_GROUP) * individual
    return values


def neighbours(values: Matrix) -> Matrix:
    """Values (S, …) of which every site resembles the one before it; changes `values`."""
    for site in range(1, len(values)):
        values[site] = NEIGHBOURS * values[site - 1] + np.sqrt(1 - NEIGHBOURS**2) * values[site]
    return values


def probe_streams(data: DataSet, seed: int) -> list[SiteScores]:
    """The streams of (expert, backbone) as `train_probes` and `retention` make them."""
    folds = nested_folds(data.labels, data.groups, derive_seed("folds", seed))
    fold_of = fold_numbers([fold.outer for fold in folds])
    nothing = np.empty((data.labels.size, 0), np.bool_)
    streams = []
    for features in data.features:
        probes: list[SiteProbe] = [
            probe_site(Samples.pooled(site), data.labels, nothing, folds) for site in features
        ]
        sums = balanced_sums(np.array([probe.decisions for probe in probes]), data.labels, fold_of, data.groups)
        inner = sums_by_group(np.array([probe.inner for probe in probes]), data.groups)
        streams.append(SiteScores.of(sums, inner, fold_of_groups(fold_of, data.groups), np.arange(len(features))))
    return streams


def fit(world: World, seed: int) -> CrossFit:
    """Cross-fitted scores of (expert, backbone) of one data set."""
    data = draw(world, seed)
    return crossfit(probe_streams(data, seed), np.unique(data.groups).tolist())


UNEQUAL = tuple(1 + number % 4 for number in range(24))


def few_worlds() -> Iterator[World]:
    """A dozen: silent, weak, strong and saturated streams, and few, many and unequal groups."""
    plain = World("24 groups", 0.25)
    yield replace(plain, name="6 groups, silent", top=0.0, sizes=(1,) * 6, sites=7)
    yield replace(plain, name="12 groups, silent", top=0.0, sizes=(1,) * 12)
    yield replace(plain, name="24 groups, silent", top=0.0)
    yield replace(plain, name="24 groups, silent, 40 sites", top=0.0, sites=40)
    yield replace(plain, name="60 groups, silent, 7 sites", top=0.0, sizes=(1,) * 60, sites=7)
    yield replace(plain, name="12 groups, .9, retention 0", top=0.4, sizes=(1,) * 12)
    for retention in (0.0, 0.5, 1.0):
        yield replace(plain, name=f"24 groups, .75, retention {retention:g}", retention=retention)
    yield replace(plain, name="24 groups, .9, plateaus, retention .5", top=0.4, retention=0.5, plateau=True)
    yield replace(plain, name="24 groups, saturated, retention 1", top=0.5, retention=1.0, plateau=True)
    yield replace(plain, name="24 unequal groups, .75, retention .25", retention=0.25, sizes=UNEQUAL)
    yield replace(
        plain, name="60 groups, .65, 7 sites, retention 1.3", top=0.15, retention=1.3, sizes=(1,) * 60, sites=7
    )
    yield replace(
        plain,
        name="60 groups, .75, one of 7 sites, retention 1",
        retention=1.0,
        sizes=(1,) * 60,
        sites=7,
        one_site=True,
    )


def every_world() -> Iterator[World]:
    """The whole grid: groups, accuracies, retention and sites."""
    grid = product((6, 12, 24, 60, 150), (0.0, 0.15, 0.25, 0.4, 0.5), (0.0, 0.25, 0.5, 1.0, 1.3), (7, 13, 40))
    for groups, top, retention, sites in grid:
        if top > 0 or retention == 0:
            sizes = (1,) * groups
            name = f"{groups} groups, {50 + 100 * top:g} %, retention {retention:g}, {sites} sites"
            yield World(name, top, retention, sizes, sites)
            yield World(f"{name}, unequal", top, retention, tuple(1 + n % 4 for n in range(groups)), sites)
