"""The significance level, and the margin around one half that guessing can reach."""

from math import ceil, sqrt
from statistics import NormalDist

from probe_kit.errors import UsageError

SIGNIFICANCE = 0.05
"""The p-value below which a result is called evidence; intervals cover one minus it."""


def detectable(items: int, power: float = 0.8) -> float:
    """Return the accuracy at which a share `power` of suites with so many items flag a baseline as above chance.

    The test is one-sided at 0.05, with an item as one trial: its two layouts are one question.

    Raises:
        UsageError: Without items.
    """
    if items < 1:
        raise UsageError(f"{items} items show nothing; expected at least one")
    reach = NormalDist().inv_cdf(1 - SIGNIFICANCE) + NormalDist().inv_cdf(power)
    return min(1.0, 0.5 + reach * sqrt(0.25 / items))


def chance_margin(n: float, alpha: float = SIGNIFICANCE) -> float:
    """Return Δ: how far a success rate over `n` trials may lie from 0.5 by guessing alone, at level `alpha`."""
    if n < 1:
        raise UsageError(f"the margin around chance needs at least one trial, got n={n}")
    return NormalDist().inv_cdf(1 - alpha / 2) * sqrt(0.25 / n)


def items_for_width(width: float) -> int:
    """Return the items per category with which a 95 % interval of a rate near one half is at most `width` wide.

    Items that share a picture and are answered alike count as fewer.

    Raises:
        UsageError: If the width is not between 0 and 1.
    """
    if not 0 < width < 1:
        raise UsageError(f"an interval {width} wide; expected a share between 0 and 1")
    return ceil((NormalDist().inv_cdf(0.975) / width) ** 2)
