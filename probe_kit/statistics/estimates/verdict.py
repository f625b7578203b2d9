"""Verdicts on a stream: shown, not shown, or absent below a stated bound for a linear probe of so many items."""

from math import inf, sqrt
from statistics import NormalDist
from typing import Literal

import numpy as np

from probe_kit._system.counting import counted
from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.estimates.balanced import GroupSums, Matrix
from probe_kit.statistics.estimates.shares import effective_episodes, group_shares, share_interval
from probe_kit.statistics.significance import SIGNIFICANCE

Verdict = Literal["shown", "not shown", "absent"]

ABSENT_BELOW = 0.65
"""Accuracy below which the best site counts as nothing."""
POWER = 0.8
"""Share of experiments that must find an accuracy for it to be called absent where they do not."""
FEWEST_PERMUTATIONS = 20
"""Fewer have no 95 % point."""


def at_most(sites: GroupSums) -> float:
    """The highest of all sites' own one-sided 95 % upper limits of accuracy (Korn and Graubard).

    The truly best site is one of them, and below its own limit in 95 % of experiments. So the number is an upper
    limit of the best site's accuracy, whatever the number of sites. Raises TooFewGroupsError for one group.
    """
    if sites.n_groups < 2:
        raise TooFewGroupsError(
            f"{counted(sites.n_groups, 'independent group')} of items set no limit; expected two or more"
        )
    shares, variances = group_shares(sites.sums, sites.sizes)
    _, high = share_interval(
        shares, variances, sites.n_groups, sites.n_episodes, sites.n_groups - 1, tail=SIGNIFICANCE
    )
    return float(high.max())


def findable(sites: GroupSums, threshold: float) -> float:
    """The least accuracy of a site that a share `POWER` of such experiments finds above chance.

    threshold: what the best site of a stream must exceed, see `permuted_threshold`. The accuracy b solves
    b − threshold = z √(b (1 − b) / n), with n the median of the sites' effective episodes, min(s (1 − s) / v, E),
    and z the quantile of `POWER`. Infinite without a threshold.
    """
    if not threshold < 1:
        return inf
    _, counting, agree = effective_episodes(*group_shares(sites.sums, sites.sizes), sites.n_episodes)
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

    most: as `at_most` gives it. least: as `findable` gives it.
    """
    return most < absent_below and least <= absent_below


def verdict(signal: bool, most: float, least: float, absent_below: float = ABSENT_BELOW) -> Verdict:
    """Return the verdict: `shown`, `absent` as `is_absent` says, else `not shown`.

    signal: above chance family-wise and better than every control that was run. What is absent is an accuracy that
    a linear probe of so many items has: with more items a probe may have more.
    """
    if signal:
        return "shown"
    return "absent" if is_absent(most, least, absent_below) else "not shown"
