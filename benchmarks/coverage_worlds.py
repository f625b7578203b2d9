"""Simulated correctness of a backbone and an action expert, with known shape, correlation and retention.

Correctness is probit: an episode is right at a site where a normal value lies below the quantile of the site's
accuracy. The value has a part common to both streams, a part common to the episodes of a group, and a part of its
own; the last two are correlated between neighbouring sites.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.crossfit import Stream

LAYERS, ITERATIONS = 19, 10
DEPTH = np.linspace(0, 1, LAYERS)
EXPERT_LAYERS = np.tile(np.arange(LAYERS - 1), ITERATIONS)
EXPERT_ITERATIONS = np.repeat(np.arange(ITERATIONS), LAYERS - 1)
TRUTHS = (0.0, 0.1, 0.25, 0.5, 0.8, 1.0, 1.3)
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Bump:
    """A peak of height 1."""

    centre: float
    width: float

    def __call__(self, depth: Matrix) -> Matrix:
        """(L,) at (L,) depths."""
        height: Matrix = np.exp(-0.5 * ((depth - self.centre) / self.width) ** 2)
        return height


@dataclass(frozen=True)
class Plateau:
    """0 before `start`, then 1."""

    start: float

    def __call__(self, depth: Matrix) -> Matrix:
        """(L,) at (L,) depths."""
        return (depth >= self.start).astype(float)


Shape = Bump | Plateau
BROAD, NARROW = Bump(0.65, 0.25), Bump(0.65, 0.08)


@dataclass(frozen=True)
class World:
    """top: best backbone accuracy above chance; retention: the expert's best as a share of it.

    growth: of the expert from the first to the last iteration. sizes: episodes of every group. of_group, shared,
    neighbours: shares of variance common to a group and to both streams, and correlation of neighbouring sites.
    one_cell: a single cell of the expert has all. same: the expert has the backbone's features. empty, wrong:
    share of groups in which the expert is at chance, or never right. missing: share of episodes.
    """

    name: str
    top: float
    retention: float
    backbone: Shape = BROAD
    expert: Shape = BROAD
    growth: tuple[float, float] = (0.8, 1.0)
    sizes: tuple[int, ...] = (4,) * 75
    of_group: float = 0.3
    shared: float = 0.25
    neighbours: float = 0.9
    one_cell: bool = False
    same: bool = False
    empty: float = 0.0
    wrong: float = 0.0
    missing: float = 0.0

    def above(self) -> tuple[Matrix, Matrix]:
        """True accuracy above chance: (19,) of the backbone, (180,) of the expert."""
        growth = np.linspace(*self.growth, ITERATIONS)[:, None]
        expert = (growth * self.expert(DEPTH[1:])).ravel()
        if self.one_cell:
            expert = (np.arange(expert.size) == 105).astype(float)
        return self.top * self.backbone(DEPTH), (self.top * self.retention * expert).clip(max=0.5)


def sample(world: World, generator: np.random.Generator, common: Matrix | None = None) -> list[Stream]:
    """(expert, backbone) of one data set.

    common: (E,) normal values of the episodes, given to several runs of the same items; drawn by default.
    """
    sizes = np.array(world.sizes)
    groups = np.repeat(np.arange(sizes.size), sizes)
    shared = generator.standard_normal(groups.size) if common is None else common
    above = world.above()
    backbone = draw_right(world, above[0], shared, groups, generator)
    expert = backbone if world.same else draw_right(world, above[1], shared, groups, generator)
    other = generator.random(sizes.size)[groups]
    coins = generator.random(expert.shape) < 0.5
    expert = np.where(other < world.empty, coins, np.where(other < world.empty + world.wrong, False, expert))
    kept = generator.random(groups.size) >= world.missing
    kept[np.unique(groups, return_index=True)[1]] = True
    return [_stream(expert[:, kept], groups[kept], world.same), _stream(backbone[:, kept], groups[kept], True)]


def draw_right(
    world: World, above: Matrix, shared: Matrix, groups: NDArray[np.intp], generator: np.random.Generator
) -> NDArray[np.bool_]:
    """(S, E) correctness of sites with (S,) accuracies above chance. shared: (E,) common to all streams."""
    of_group = _neighbours(generator.standard_normal((above.size, int(groups[-1]) + 1)), world.neighbours)[
        :, groups
    ]
    own = _neighbours(generator.standard_normal((above.size, groups.size)), world.neighbours)
    inner = np.sqrt(world.of_group) * of_group + np.sqrt(1 - world.of_group) * own
    right: NDArray[np.bool_] = (
        np.sqrt(world.shared) * shared + np.sqrt(1 - world.shared) * inner < ndtri(0.5 + above)[:, None]
    )
    return right


def _neighbours(values: Matrix, correlation: float) -> Matrix:
    rest = np.sqrt(1 - correlation**2)
    for site in range(1, len(values)):
        values[site] = correlation * values[site - 1] + rest * values[site]
    return values


def _stream(right: NDArray[np.bool_], groups: NDArray[np.intp], once: bool) -> Stream:
    sums = np.zeros((groups[-1] + 1, len(right)))
    np.add.at(sums, groups, right.T.astype(float))
    scores = GroupSums(sums.T.copy(), np.bincount(groups).astype(float))
    return Stream.of(scores, np.arange(LAYERS)) if once else Stream.of(scores, EXPERT_LAYERS, EXPERT_ITERATIONS)


def own_worlds() -> Iterator[World]:
    """Those of the design: every truth, few and many groups, narrow and broad peaks, and the hard cases."""
    plain = World("75 groups", 0.30, 0.5)
    twelve = replace(plain, top=0.40, sizes=(4,) * 12)
    for truth in TRUTHS:
        yield replace(plain, name=f"75 groups, {truth:g}", retention=truth)
        yield replace(plain, name=f"75 groups, narrow, {truth:g}", retention=truth, backbone=NARROW, expert=NARROW)
    for truth in (0.0, 0.25, 0.5, 0.9, 1.0):
        yield replace(twelve, name=f"12 groups, {truth:g}", retention=truth)
    for truth in (0.0, 0.5, 1.0):
        yield replace(plain, name=f"24 groups, {truth:g}", retention=truth, sizes=(4,) * 24)
        yield replace(plain, name=f"150 groups of two, {truth:g}", top=0.25, retention=truth, sizes=(2,) * 150)
    sure = replace(twelve, top=0.5, backbone=Plateau(0.4), expert=Plateau(0.4), growth=(1.0, 1.0))
    yield replace(sure, name="12 perfect groups, 1", retention=1.0)
    yield replace(sure, name="12 nearly perfect groups, 0.97", top=0.49, retention=0.98)
    yield replace(sure, name="same features, perfect, 12 groups", retention=1.0, same=True)
    yield replace(twelve, name="same features, 12 groups", retention=1.0, same=True)
    yield replace(sure, name="12 groups, a fifth empty in the expert", retention=1.0, empty=0.2)
    yield replace(plain, name="plateaus, 0.6", retention=0.6, backbone=Plateau(0.4), expert=Plateau(0.5))
    yield replace(twelve, name="plateaus, 12 groups, 0.5", backbone=Plateau(0.4), expert=Plateau(0.5))
    yield replace(plain, name="late expert, 0.7", retention=0.7, backbone=Bump(0.3, 0.2), expert=Bump(0.9, 0.2))
    yield replace(plain, name="expert falls over iterations, 0.7", retention=0.7, growth=(1.0, 0.2))
    yield replace(plain, name="expert rises from nothing, 0.7", retention=0.7, growth=(0.0, 1.0))
    yield replace(plain, name="narrow expert, 0.8", retention=0.8, expert=Bump(0.6, 0.12))
    yield replace(plain, name="weak backbone, 0.5", top=0.12)
    yield replace(plain, name="neighbours 0.3, 0.6", retention=0.6, neighbours=0.3)
    yield replace(plain, name="one group has 30 % of episodes, 0.5", sizes=(68,) + (4,) * 39)
    yield replace(plain, name="groups of 1 to 8 items, 0.5", sizes=tuple(2 * (1 + n % 8) for n in range(50)))
    yield replace(plain, name="a fifth of episodes missing, 0.5", missing=0.2)
    yield replace(sure, name="24 groups, 8 % wrong in the expert, 1", retention=1.0, sizes=(4,) * 24, wrong=0.08)
    yield replace(plain, name="one cell of 180, 0.6", retention=0.6, one_cell=True)


LIMITS = ("24 groups, 8 % wrong", "one cell of 180")
"""Worlds in which intervals are known to cover less."""


def random_world(seed: int) -> World:
    """Any heights, widths, places, retention, groups, sizes and correlations."""
    generator = np.random.default_rng([seed, 35])
    groups = int(np.exp(generator.uniform(np.log(12), np.log(150))))
    most = int(generator.integers(1, 5))
    shapes: list[Shape] = [
        Plateau(generator.uniform(0.2, 0.7))
        if generator.random() < 0.2
        else Bump(generator.uniform(0.2, 0.9), np.exp(generator.uniform(np.log(0.08), np.log(0.5))))
        for _ in range(2)
    ]
    top, retention = generator.uniform(0.15, 0.45), generator.choice(TRUTHS)
    growth = (generator.uniform(0, 1), 1.0) if generator.random() < 0.7 else (1.0, generator.uniform(0, 1))
    return World(
        f"random {seed}, {retention:g}",
        top,
        float(retention),
        shapes[0],
        shapes[1],
        growth,
        tuple(2 * generator.integers(1, most + 1, groups)),
        generator.uniform(0, 0.6),
        generator.uniform(0, 0.6),
        generator.uniform(0.3, 0.97),
    )
