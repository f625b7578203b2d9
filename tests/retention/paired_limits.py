"""Limits of a difference of two runs on the same items, written out by hand."""

import numpy as np
import pandas as pd
from scipy import stats


def mover(mine: pd.DataFrame, theirs: pd.DataFrame) -> tuple[float, float]:
    """Limits of a difference from those of its parts and their correlation over groups (Zou and Donner).

    Its variance is at least that of runs that agree in all groups, as some groups may be unseen.
    """
    found, rests, variances = [], [], []
    for table in (mine, theirs):
        by_group = (table["outcome"] == "correct").groupby(table["group_id"]).agg(["sum", "size"])
        E, G, s = by_group["size"].sum(), len(by_group), (table["outcome"] == "correct").mean()
        rest = by_group["sum"] - s * by_group["size"]
        variance = (rest**2).sum() * G / (G - 1) / E**2
        df = E**2 / (by_group["size"] ** 2).sum() - 1
        n = min(s * (1 - s) / variance, E) * (stats.t.ppf(0.975, E - 1) / stats.t.ppf(0.975, df)) ** 2
        limits = stats.beta.ppf([0.025, 0.975], [s * n, s * n + 1], [n - s * n + 1, n - s * n])
        perfect = 0.025 ** (1 / G)  # no share is better known than where all groups agree
        found.append((s, min(limits[0], perfect), max(limits[1], 1 - perfect)))
        rests.append(rest / E)
        variances.append(variance)
    (a, a_low, a_high), (b, b_low, b_high) = found
    shared = (rests[0] * rests[1]).sum() * G / (G - 1)
    shared = min(shared, max(0, (sum(variances) - 2 / ((G + 1) * (G + 2))) / 2))
    rho = shared / np.sqrt(variances[0] * variances[1])
    below = np.sqrt((a - a_low) ** 2 + (b_high - b) ** 2 - 2 * rho * (a - a_low) * (b_high - b))
    above = np.sqrt((a_high - a) ** 2 + (b - b_low) ** 2 - 2 * rho * (a_high - a) * (b - b_low))
    return a - b - below, a - b + above
