"""Verdicts on a stream: shown, not shown, or absent below a stated bound."""

from typing import Literal

from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.shares import group_shares, share_interval
from probe_kit.statistics.significance import SIGNIFICANCE

Verdict = Literal["shown", "not shown", "absent"]

ABSENT_BELOW = 0.65
"""Accuracy below which the best site counts as nothing."""


def at_most(sites: GroupSums) -> float:
    """The highest of all sites' own one-sided 95 % upper limits of accuracy (Korn and Graubard).

    The truly best site is one of them, and below its own limit in 95 % of experiments. So the number is an upper
    limit of the best site's accuracy, whatever the number of sites. Raises TooFewGroupsError for one group.
    """
    if sites.n_groups < 2:
        raise TooFewGroupsError(f"{sites.n_groups} independent groups of items set no limit; expected two or more")
    shares, variances = group_shares(sites.sums, sites.sizes)
    _, high = share_interval(
        shares, variances, sites.n_groups, sites.n_episodes, sites.n_groups - 1, tail=SIGNIFICANCE
    )
    return float(high.max())


def verdict(signal: bool, most: float, absent_below: float = ABSENT_BELOW) -> Verdict:
    """What was found: `shown`, `absent` where the best site is below `absent_below` at most, else `not shown`.

    signal: above chance family-wise and better than every control that was run. most: as `at_most` gives it.
    """
    if signal:
        return "shown"
    return "absent" if most < absent_below else "not shown"
