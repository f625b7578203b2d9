"""Two sides on the same episodes: which is right more often, by one exact test over groups of items."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.retention.behaviour.success_rate import shares_of, units_of
from probe_kit.statistics.paired_tests import flip_gains_p

if TYPE_CHECKING:
    import pandas as pd

_FINEST = 1000
"""Parts that an outcome is counted in, where several last steps or several runs make shares of it."""


@dataclass(frozen=True)
class Gains:
    """p: exact and two-sided, of both sides being right equally often, whole groups of items turned together.

    n_groups: groups that it rests on. more, fewer: episodes in which the first side is right more, and less.
    """

    p: float
    n_groups: int
    more: int
    fewer: int

    @classmethod
    def of(cls, first: "Sequence[pd.DataFrame]", second: "Sequence[pd.DataFrame]") -> "Gains | None":
        """Return the test of tables of episodes, each of one run and category; runs of a side count by their mean.

        None unless every run of both sides has the same episodes.
        """
        sides = [_of_side(tables) for tables in (first, second)]
        if None in sides:
            return None
        (mine, units), (theirs, _) = (side for side in sides if side is not None)
        if not mine or set(mine) != set(theirs):
            return None
        gains = [mine[episode] - theirs[episode] for episode in mine]
        # The exact test counts in whole units, as coarse as the gains allow: its time grows with their number.
        scale = min(_FINEST, lcm(*(gain.denominator for gain in gains)))
        scaled: NDArray[np.int64] = np.array([round(gain * scale) for gain in gains])
        groups = [units[episode] for episode in mine]
        more, fewer = int((scaled > 0).sum()), int((scaled < 0).sum())
        return cls(flip_gains_p(scaled, groups), len(set(groups)), more, fewer)


def _of_side(tables: "Sequence[pd.DataFrame]") -> tuple[dict[str, Fraction], dict[str, str]] | None:
    """Per episode how much of it was right, averaged over runs, and its group; None if runs differ in episodes."""
    by_episode: dict[str, list[Fraction]] = {}
    units: dict[str, str] = {}
    for table in tables:
        names = table["item_id"].astype(str) + ":" + table["layout"].astype(str)
        for name, share, unit in zip(names, shares_of(table, "correct"), units_of(table), strict=True):
            by_episode.setdefault(name, []).append(Fraction(float(share)).limit_denominator(_FINEST))
            units[name] = unit
    runs = {len(shares) for shares in by_episode.values()}
    if len(runs) > 1:
        return None
    return {name: sum(shares, Fraction(0)) / len(shares) for name, shares in by_episode.items()}, units
