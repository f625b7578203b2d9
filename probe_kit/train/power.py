"""The power of probes and controls for a number of items, for planning and for results."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, sqrt
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.statistics.crossfit import GroupSums
from probe_kit.statistics.folds import OUTER_FOLDS
from probe_kit.statistics.paired_tests import better_than_best, better_than_reference
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import at_most, findable, is_absent
from probe_kit.train.control_features import LAYERS

NEIGHBOURS, ALIKE = 0.9, 0.3
"""Assumed correlation of neighbouring sites, and of the episodes of one group."""
ITEMS_PER_GROUP, LAYOUTS = 2, 2
"""Numbers of the built suites: an item and its counterpart share pictures, and each is played in both layouts."""
FEWEST_ITEMS, MOST_ITEMS = OUTER_FOLDS * ITEMS_PER_GROUP, 1000
"""Limits between which the number of items is searched."""
SEEDS = 5
"""Parts of a simulation, each with a limit of chance of its own; their spread is the error of the whole."""
NULL_DRAWS, POOL = 4000, 40_000
"""Experiments without signal per seed, and the groups that they are made of."""
NO_PROBES = 1.0
"""Factor of differences from controls: simulated groups train no probes of each other.

Those of trained probes spread more, and are tested with a factor. Both together detect about as much as the
simulation (`benchmarks/power_trained.py`).
"""
_NUMBERS_IN_MEMORY = 200_000
"""The most random numbers that are held at once."""


@dataclass(frozen=True)
class Power:
    """The share of experiments that detect a signal of `above` over chance, family-wise, with so many items.

    Attributes:
        items: Number of items per category.
        above: Accuracy of the sites with signal minus 0.5.
        chance: Share that detects it against label permutations.
        random_features: Share that detects it against a control that is right half of the time; a better control
            takes more items.
        untrained: Share that detects it against an untrained network that is right half of the time; a better one
            takes more items.
        absent: Share of experiments in which a stream without any signal is called absent.
        spread: Standard error of the four, the largest, measured over `SEEDS` seeds.
    """

    items: int
    above: float
    chance: float
    random_features: float
    untrained: float
    absent: float
    spread: float

    @property
    def least(self) -> float:
        """The share of experiments in which the weakest of the three tests detects the signal."""
        return min(self.chance, self.random_features, self.untrained)


def simulate(items: int, above: float, sites: int = 19, draws: int = 400, seed: int = 0) -> Power:
    """Return the power by the simulated correctness of `draws` experiments.

    A third of the sites carry the signal, at least one.

    Raises:
        UsageError: For fewer than 10 items, no site, fewer than `SEEDS` draws, or an impossible signal.
    """
    if items < FEWEST_ITEMS:
        raise UsageError(
            f"{items} items make fewer than {OUTER_FOLDS} groups; no probe is fitted. Expected {FEWEST_ITEMS} or "
            "more."
        )
    if not 0 <= above <= 0.5:
        raise UsageError(f"a signal of {above} above chance; expected a share from 0 to 0.5")
    if sites < 1 or draws < SEEDS:
        raise UsageError(f"{sites} sites and {draws} experiments; expected at least 1 and {SEEDS}")
    signal = np.zeros(sites)
    signal[_carriers(sites)] = above
    parts = np.array([_part(items, signal, -(-draws // SEEDS), SEEDS * seed + part) for part in range(SEEDS)])
    chance, random_features, untrained, absent = parts.mean(axis=0).tolist()
    spread = float((parts.std(axis=0, ddof=1) / sqrt(SEEDS)).max())
    return Power(items, above, chance, random_features, untrained, absent, spread)


def items_needed(
    above: float, power: float, sites: int = 19, draws: int = 400, seed: int = 0
) -> tuple[Power, int] | None:
    """Return the power of the fewest items at which all three tests reach `power`; None beyond `MOST_ITEMS`.

    The second value is the resolution: so many items fewer were tried, and reach it less often; see `fewest`.
    Raises as `simulate`.
    """
    tried: dict[int, Power] = {}

    def reaches(items: int) -> bool:
        tried[items] = simulate(items, above, sites, draws, seed)
        return tried[items].least >= power

    needed = fewest(reaches, FEWEST_ITEMS, MOST_ITEMS)
    return None if needed is None else (tried[needed[0]], needed[1])


def fewest(reaches: Callable[[int], bool], low: int, high: int) -> tuple[int, int] | None:
    """Return the smallest even number from `low` to `high` that reaches a goal, and the resolution.

    None if no number does. The range is halved until it is as wide as the resolution: a group of items, and above
    200 of them 2 %. A simulated power is noisy and rises in steps. Where one of the next two larger numbers fails,
    the search resumes above it, so that the goal is reached at three numbers in a row.
    """
    answers: dict[int, bool] = {}

    def does(items: int) -> bool:
        if items not in answers:
            answers[items] = reaches(items)
        return answers[items]

    below, above = low - ITEMS_PER_GROUP, low
    while not does(above):
        if above >= high:
            return None
        below, above = above, min(2 * above, high)
    while True:
        step = _resolution(above)
        while above - below > step:
            middle = below + max(step, (above - below) // 2 // step * step)
            below, above = (below, middle) if does(middle) else (middle, above)
            step = _resolution(above)
        failing = [items for items in (above + step, above + 2 * step) if items <= high and not does(items)]
        if not failing:
            return above, above - below
        below, above = failing[-1], failing[-1] + step
        while not does(above):
            if above >= high:
                return None
            below, above = above, min(above + step, high)


def _resolution(items: int) -> int:
    """Return the size of a group of items, and above 200 items about 2 % of them."""
    return max(1, items // 50 // ITEMS_PER_GROUP) * ITEMS_PER_GROUP


def _carriers(sites: int) -> slice:
    """Return a third of the sites, at least one, around 0.6 of the depth."""
    count = max(1, round(sites / 3))
    first = min(max(0, round(0.6 * (sites - 1) - (count - 1) / 2)), sites - count)
    return slice(first, first + count)


def _part(items: int, signal: NDArray[np.float64], draws: int, seed: int) -> tuple[float, float, float, float]:
    """Return the shares of `draws` experiments with a limit of chance of their own.

    The first three are the shares in which each test detects the signal. The last is the share in which an
    untrained network without signal is called absent.
    """
    generator = np.random.default_rng([seed, items, signal.size])
    groups = np.repeat(np.arange(items // ITEMS_PER_GROUP), ITEMS_PER_GROUP * LAYOUTS)
    nothing = np.zeros(signal.size)
    limit = _limit(items // ITEMS_PER_GROUP, signal.size, seed)
    detected = []
    for draw in range(draws):
        right, untrained = _right(generator, signal, groups), _right(generator, nothing, groups)
        reference = _right(generator, np.zeros(LAYERS), groups).mean(axis=0)
        detected.append(
            (
                right.mean(axis=1).max() > limit,
                better_than_reference(right, reference, groups, draw, NO_PROBES).min() < SIGNIFICANCE,
                better_than_best(right, untrained, groups, draw, NO_PROBES).min() < SIGNIFICANCE,
                is_absent(at_most(_group_sums(untrained)), findable(_group_sums(untrained), limit)),
            )
        )
    chance, random_features, beaten, absent = np.mean(detected, axis=0).tolist()
    return chance, random_features, beaten, absent


def _group_sums(right: NDArray[np.bool_]) -> GroupSums:
    """Return the sums of (S, E) correctness over whole groups."""
    size = ITEMS_PER_GROUP * LAYOUTS
    sums = right.reshape(len(right), -1, size).sum(axis=2).astype(np.float64)
    return GroupSums(sums, np.full(sums.shape[1], float(size)))


@lru_cache(maxsize=256)
def _limit(groups: int, sites: int, seed: int) -> float:
    """Return the accuracy that the best of `sites` without signal exceeds in a share `SIGNIFICANCE` at most.

    Groups are drawn from a pool and its complement, so that every site is right in one half of the pool exactly.
    """
    generator = np.random.default_rng([seed, groups, sites, 1])
    pool = _pool(sites, seed)
    at_once = max(1, _NUMBERS_IN_MEMORY // (groups * sites))
    best = [
        pool[generator.integers(len(pool), size=(min(at_once, NULL_DRAWS - start), groups))]
        .sum(axis=1, dtype=np.int64)
        .max(axis=1)
        for start in range(0, NULL_DRAWS, at_once)
    ]
    exceeded = np.sort(np.concatenate(best))[::-1][ceil(SIGNIFICANCE * NULL_DRAWS) - 1]
    return float(exceeded) / (groups * ITEMS_PER_GROUP * LAYOUTS)


@lru_cache(maxsize=SEEDS)
def _pool(sites: int, seed: int) -> NDArray[np.int8]:
    """Return the number of episodes that each site gets right in groups without signal, (2 POOL, S)."""
    size = ITEMS_PER_GROUP * LAYOUTS
    generator = np.random.default_rng([seed, sites, 2])
    drawn = []
    for _ in range(POOL // 2000):
        right = _right(generator, np.zeros(sites), np.repeat(np.arange(2000), size))
        drawn.append(right.reshape(sites, -1, size).sum(axis=2, dtype=np.int8).T)
    right_of_group = np.concatenate(drawn)
    return np.concatenate([right_of_group, np.int8(size) - right_of_group])


def _right(
    generator: np.random.Generator, above: NDArray[np.float64], groups: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return the correctness (S, E) of sites that are right in a share 0.5 + `above` of the episodes."""
    of_group = generator.standard_normal((above.size, int(groups[-1]) + 1))[:, groups]
    of_episode = generator.standard_normal((above.size, groups.size))
    values = sqrt(ALIKE) * of_group + sqrt(1 - ALIKE) * of_episode
    for site in range(1, above.size):
        values[site] = NEIGHBOURS * values[site - 1] + sqrt(1 - NEIGHBOURS**2) * values[site]
    limits = np.array([NormalDist().inv_cdf(min(0.5 + share, 1 - 1e-9)) for share in above.tolist()])
    right: NDArray[np.bool_] = values < limits[:, None]
    return right
