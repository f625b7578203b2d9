"""How much can be seen with so many items? Power of probes and controls, for planning and beside their results."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, sqrt
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.statistics.paired_bootstrap import better_than_best, better_than_reference
from probe_kit.statistics.significance import SIGNIFICANCE

NEIGHBOURS, ALIKE = 0.9, 0.3
"""Assumed correlation of neighbouring sites, and of the episodes of one group."""
ITEMS_PER_GROUP, LAYOUTS = 2, 2


@dataclass(frozen=True)
class Power:
    """Share of experiments in which a signal of `above` over chance is seen, family-wise, with so many items.

    chance: against relabellings. binding, twin: against a control that is right half of the time; it takes more if
    the control is better than that.
    """

    items: int
    above: float
    chance: float
    binding: float
    twin: float


def simulate(items: int, above: float, sites: int = 19, draws: int = 200, seed: int = 0) -> Power:
    """Power by simulated correctness of `draws` experiments.

    A third of the sites carry the signal. Raises UsageError for fewer than 10 items or an impossible signal.
    """
    if items < 5 * ITEMS_PER_GROUP:
        raise UsageError(f"{items} items make fewer than 5 groups; no probe is fitted. Expected 10 or more.")
    if not 0 <= above <= 0.5:
        raise UsageError(f"a signal of {above} above chance; expected a share from 0 to 0.5")
    generator = np.random.default_rng(seed)
    groups = np.repeat(np.arange(items // ITEMS_PER_GROUP), ITEMS_PER_GROUP * LAYOUTS)
    signal = np.where(np.abs(np.arange(sites) - 0.6 * sites) <= sites / 6, above, 0.0)
    nothing = np.zeros(sites)
    null = [_right(generator, nothing, groups).mean(axis=1).max() for _ in range(max(draws, 400))]
    limit = float(np.quantile(null, 1 - SIGNIFICANCE))
    seen = []
    for draw in range(draws):
        here, twin = _right(generator, signal, groups), _right(generator, nothing, groups)
        layers = _right(generator, np.zeros(5), groups)
        reference = layers[layers.sum(axis=1).argmax()].astype(float)
        seen.append(
            (
                here.mean(axis=1).max() > limit,
                better_than_reference(here, reference, groups, draw).min() < SIGNIFICANCE,
                better_than_best(here, twin, groups, draw).min() < SIGNIFICANCE,
            )
        )
    chance, binding, beaten = np.mean(seen, axis=0)
    return Power(items, above, float(chance), float(binding), float(beaten))


def items_for_width(width: float) -> int:
    """Items per category for which a 95 % interval of a rate near one half is at most `width` wide.

    Items that share a picture and are answered alike count as fewer. Raises UsageError for no width.
    """
    if not 0 < width < 1:
        raise UsageError(f"an interval {width} wide; expected a share between 0 and 1")
    return ceil((NormalDist().inv_cdf(0.975) / width) ** 2)


def items_needed(above: float, power: float, grid: Sequence[int], sites: int = 19, draws: int = 200) -> int | None:
    """The first number of items of an ascending `grid` at which all three tests reach `power`, None if none."""
    for items in grid:
        found = simulate(items, above, sites, draws)
        if min(found.chance, found.binding, found.twin) >= power:
            return items
    return None


def _right(
    generator: np.random.Generator, above: NDArray[np.float64], groups: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """(S, E) correctness of sites that are right in a share 0.5 + `above` of the episodes."""
    of_group = generator.standard_normal((above.size, int(groups[-1]) + 1))[:, groups]
    own = generator.standard_normal((above.size, groups.size))
    values = sqrt(ALIKE) * of_group + sqrt(1 - ALIKE) * own
    for site in range(1, above.size):
        values[site] = NEIGHBOURS * values[site - 1] + sqrt(1 - NEIGHBOURS**2) * values[site]
    limits = np.array([NormalDist().inv_cdf(min(0.5 + share, 1 - 1e-9)) for share in above.tolist()])
    right: NDArray[np.bool_] = values < limits[:, None]
    return right
