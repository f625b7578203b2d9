"""Limits of a difference of two runs on the same items, written out by hand."""

import numpy as np
import pandas as pd

from probe_kit.statistics.share_limits import korn_graubard_limits


def mover(mine: pd.DataFrame, theirs: pd.DataFrame) -> tuple[float, float]:
    """Limits of a difference from those of its parts and their correlation over groups (Zou and Donner).

    Its variance is at least that of runs that agree in all groups, as some groups may be unseen.
    """
    means, rests, variances = [], [], []
    for table in (mine, theirs):
        by_group = (table["outcome"] == "correct").groupby(table["group_id"]).agg(["sum", "size"])
        E, G, s = by_group["size"].sum(), len(by_group), (table["outcome"] == "correct").mean()
        residual = by_group["sum"] - s * by_group["size"]
        variance = (residual**2).sum() * G / (G - 1) / E**2
        # The limits of one share have tests of their own in `tests/statistics`.
        sums, sizes = (by_group[name].to_numpy(float) for name in ("sum", "size"))
        low, high = korn_graubard_limits(sums[None], sizes)
        means.append((s, float(low[0]), float(high[0])))
        rests.append(residual / E)
        variances.append(variance)
    (a, a_low, a_high), (b, b_low, b_high) = means
    shared = (rests[0] * rests[1]).sum() * G / (G - 1)
    shared = min(shared, max(0, (sum(variances) - 2 / ((G + 1) * (G + 2))) / 2))
    rho = shared / np.sqrt(variances[0] * variances[1])
    below = np.sqrt((a - a_low) ** 2 + (b_high - b) ** 2 - 2 * rho * (a - a_low) * (b_high - b))
    above = np.sqrt((a_high - a) ** 2 + (b - b_low) ** 2 - 2 * rho * (a_high - a) * (b - b_low))
    return a - b - below, a - b + above
