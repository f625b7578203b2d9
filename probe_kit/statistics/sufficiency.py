"""Verdicts on a stream, and the conclusions that a number of groups is enough for."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from itertools import count
from math import ceil, inf, isinf, sqrt
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._system.types import Matrix
from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap
from probe_kit.statistics.crossfit import CHANCE, FEWEST_GROUPS, GroupSums
from probe_kit.statistics.folds import OUTER_FOLDS
from probe_kit.statistics.label_permutations import possible_flips, smallest_p
from probe_kit.statistics.paired_tests import smallest_flip_p
from probe_kit.statistics.share_limits import effective_episodes, group_shares, korn_graubard_limits
from probe_kit.statistics.significance import SIGNIFICANCE

# -- verdicts on a stream ------------------------------------------------------------------------------------

Verdict = Literal["shown", "not shown", "absent"]

ABSENT_BELOW = 0.65
"""Accuracy below which the best site counts as no signal."""
POWER = 0.8
"""Share of experiments that must find an accuracy, so that it can be called absent where it is not found."""
FEWEST_PERMUTATIONS = 20
"""Number of permutations below which there is no 95 % point."""


def at_most(sites: GroupSums) -> float:
    """Return the highest of all sites' own one-sided 95 % upper limits of accuracy (Korn and Graubard).

    The truly best site is one of them, and below its own limit in 95 % of experiments. So the number is an upper
    limit of the best site's accuracy, whatever the number of sites.

    Raises:
        TooFewGroupsError: For one group.
    """
    if sites.n_groups < 2:
        raise TooFewGroupsError(
            f"{plural(sites.n_groups, 'independent group')} of items set no limit; expected two or more"
        )
    return float(korn_graubard_limits(sites.sums, sites.sizes, SIGNIFICANCE)[1].max())


def findable(sites: GroupSums, threshold: float) -> float:
    """Return the least accuracy of a site that a share `POWER` of such experiments finds above chance.

    The accuracy b solves b − threshold = z √(b (1 − b) / n). Here n is the median of the sites' effective
    episodes, min(s (1 − s) / v, E), and z the quantile of `POWER`. Infinite without a threshold.

    Args:
        sites: Correct decisions of a stream's sites.
        threshold: Accuracy that the best site of a stream must exceed, see `permuted_threshold`.
    """
    if not threshold < 1:
        return inf
    counting, agree = effective_episodes(*group_shares(sites.sums, sites.sizes), sites.n_episodes)
    counting = counting[~agree]
    k = NormalDist().inv_cdf(POWER) ** 2 / float(np.median(counting) if counting.size else sites.n_episodes)
    half = (2 * threshold + k) / 2
    return (half + sqrt(max(0.0, half**2 - (1 + k) * threshold**2))) / (1 + k)


def permuted_threshold(null: Matrix) -> float:
    """Return the 95 % point of the best of (S, P) permuted accuracies; infinite with too few permutations."""
    if null.shape[1] < FEWEST_PERMUTATIONS:
        return inf
    return float(np.percentile(null.max(axis=0), 100 * (1 - SIGNIFICANCE)))


def is_absent(most: float, least: float, absent_below: float = ABSENT_BELOW) -> bool:
    """Whether the best site is below a bound at most, and the experiment would have found it at the bound.

    Args:
        most: Upper limit of the best site's accuracy, as `at_most` gives it.
        least: Least accuracy that would be found, as `findable` gives it.
        absent_below: The bound, an accuracy.
    """
    return most < absent_below and least <= absent_below


def verdict(signal: bool, most: float, least: float, absent_below: float = ABSENT_BELOW) -> Verdict:
    """Return the verdict: `shown`, `absent` as `is_absent` says, else `not shown`.

    An accuracy that is absent is one of a linear probe of so many items: with more items, a probe may have more.

    Args:
        signal: Whether the stream is above chance, family-wise, and better than every control that was run.
        most: Upper limit of the best site's accuracy, as `at_most` gives it.
        least: Least accuracy that would be found, as `findable` gives it.
        absent_below: Accuracy below which the best site counts as no signal.
    """
    if signal:
        return "shown"
    return "absent" if is_absent(most, least, absent_below) else "not shown"


# -- numbers of groups ---------------------------------------------------------------------------------------

GROUPS_FOR_PROBES = OUTER_FOLDS
"""The fewest groups of a category that `train` accepts."""
GROUPS_FOR_RETENTION = FEWEST_GROUPS
"""The fewest groups with cross-fitted scores."""
SMALLEST_EFFECT_OF_INTEREST = 0.25
"""Net share of episodes below which a category is not acted on, and an edit or erasure is without effect."""


def probe_command(location: object, groups: Mapping[Any, int]) -> str:
    """Return the command that fits probes of the categories with enough groups; empty where none has enough.

    Args:
        location: Location of the run, as it is.
        groups: Number of independent groups by category.
    """
    enough = [name for name, count in groups.items() if count >= GROUPS_FOR_PROBES]
    if not enough:
        return ""
    option = "" if len(enough) == len(groups) else f" --categories {as_argument(','.join(enough))}"
    return f"probe-kit train {as_argument(location)}{option}"


def least_probe_p(groups: int) -> float:
    """Return the smallest p that label permutations of so many groups can give, with enough permutations."""
    return smallest_p(possible_flips(groups))


def groups_for_signal() -> int:
    """Return the fewest groups with which a probe can be significant."""
    return _fewest(lambda groups: least_probe_p(groups) < SIGNIFICANCE, GROUPS_FOR_PROBES)


def groups_for_interventions() -> int:
    """Return the fewest groups with which an effect can be beyond chance."""
    return _fewest(lambda groups: smallest_flip_p(groups) < SIGNIFICANCE, 1)


@cache
def groups_for_not_used() -> int:
    """Return the fewest groups with which an image swap can find *not used* in episodes that never follow."""
    return _fewest(lambda groups: _net_limit_of_none(groups) < SMALLEST_EFFECT_OF_INTEREST, 2)


def groups_to_decide(groups: int, effects: Sequence[tuple[float, float, float]]) -> float:
    """Return about how many groups tell *used* from *not used*, if the effects stay as these groups measured them.

    *Not used* takes all effects below their sizes, *used* takes one of them above. A width is taken to fall with
    the root of the number of groups. Without any interval, it is the fewest groups with which something can be
    *not used*. Infinite for an effect at its bound.

    Args:
        groups: Number of groups that were measured.
        effects: Each measure, the width of its interval, and the size below which it does not matter.
    """
    if all(isinf(width) for _, width, _ in effects):
        return max(groups_for_not_used(), groups + 1)
    below, above = 0.0, inf
    for effect, width, bound in effects:
        gap = bound - abs(effect)
        times = (width / 2 / gap) ** 2 if gap else inf
        below, above = (max(below, times), above) if gap > 0 else (inf, min(above, times))
    times, fewest = min((below, groups_for_not_used()), (above, groups_for_interventions()))
    return max(times * groups, fewest, groups + 1)


def items_for_absence(items: int, groups: int, episodes: int) -> int:
    """Return the fewest items with which a stream that knows nothing can be called absent, at best.

    More groups are taken to be of the same size as the measured ones.

    Args:
        items: Number of items that were measured.
        groups: Number of groups of these items.
        episodes: Number of episodes of these items.
    """
    return ceil(groups_for_absence(round(episodes / groups)) * items / groups)


def _net_limit_of_none(groups: int) -> float:
    """Return how far from zero the interval of a net follow rate reaches if no episode follows."""
    low, high = group_bootstrap(np.zeros((groups, 1)), np.arange(groups), 0, bounds=GAINS)
    return float(max(-low[0], high[0]))


@lru_cache
def groups_for_absence(episodes: int) -> int:
    """Return the fewest groups of so many episodes with which a stream that knows nothing can be called absent.

    That is at best: for a single site that is right in half of the episodes. These differ as much within groups as
    between them. `probe-kit power` simulates how often it happens.
    """
    return _fewest(lambda groups: _limit_at_chance(groups, episodes) < ABSENT_BELOW, GROUPS_FOR_RETENTION)


def _limit_at_chance(groups: int, episodes: int) -> float:
    """Return the larger of `at_most` and `findable` of one site that is right in half of the episodes.

    Groups vary as episodes do. Half of them lie a standard deviation above one half, half of them as far below.
    """
    sizes = np.full(groups, float(episodes))
    around = np.resize([1.0, -1.0], groups) * np.sqrt(episodes * CHANCE * (1 - CHANCE))
    site = GroupSums((sizes * CHANCE + around - around.mean())[None, :], sizes)
    chance = NormalDist(CHANCE, sqrt(CHANCE * (1 - CHANCE) / site.n_episodes))
    return max(at_most(site), findable(site, chance.inv_cdf(1 - SIGNIFICANCE)))


def _fewest(enough: Callable[[int], bool], start: int) -> int:
    return next(groups for groups in count(start) if enough(groups))
