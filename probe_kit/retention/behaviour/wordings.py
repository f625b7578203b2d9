"""Wordings of one run against each other: the same items, layouts and seeds, asked in other words.

It separates not knowing from not being able: who places the cube by "the left picture" and not by what the picture
shows can act and does not know.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.retention.behaviour.success_rate import units_of
from probe_kit.statistics.mcnemar import grouped_sign_p, sign_p
from probe_kit.statistics.multiple_testing import corrected

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

EVERY = "all"
"""Category of the row over the episodes of all categories."""


@dataclass(frozen=True)
class WordingPair:
    """Two wordings of one category of a run, on the episodes that were played in both.

    n_episodes: so many. sr, other_sr: shares that were right. only, only_other: how many were right in one alone.
    p: McNemar's exact two-sided p over episodes. p_groups: the same with groups of items that share pictures as
    the unit, which is the one to trust where there are twins. p_holm: that, corrected over the categories and
    pairs of wordings of all runs of the table, or over the rows `all`.
    """

    run: str
    label: str
    category: str
    wording: str
    other: str
    n_episodes: int
    sr: float
    other_sr: float
    only: int
    only_other: int
    p: float
    p_groups: float
    p_holm: float


def wording_pairs(episodes: "pd.DataFrame", wordings: Sequence[str], run: str, label: str) -> list[WordingPair]:
    """Every two wordings of a run, per category and, if there are several, over all of them.

    episodes: of all wordings, with the columns of `Run.episodes`. A pair of which nothing was played in both is
    left out.
    """
    by_category = [(str(name), table) for name, table in episodes.groupby("category", sort=False)]
    if len(by_category) > 1:
        by_category.append((EVERY, episodes))
    return correct_wordings(
        [
            _pair(table, wording, other, run, label, category)
            for category, table in by_category
            for wording, other in combinations(wordings, 2)
            if _in_both(table, wording, other).any()
        ]
    )


def correct_wordings(pairs: Sequence[WordingPair]) -> list[WordingPair]:
    """The same pairs, which stand in one table, with `p_holm` over the lot."""
    found = corrected(pairs, lambda pair: pair.p_groups, lambda pair: pair.category == EVERY)
    return [replace(pair, p_holm=p) for pair, p in zip(pairs, found, strict=True) if p is not None]


def _in_both(table: "pd.DataFrame", wording: str, other: str) -> "NDArray[np.bool_]":
    """(E,) episodes in `wording` that were played in `other` too."""
    keys = _keys(table)
    there = set(keys[table["wording"] == other])
    return ((table["wording"] == wording) & keys.isin(there)).to_numpy()


def _keys(table: "pd.DataFrame") -> "pd.Series[str]":
    return table["item_id"].astype(str) + ":" + table["layout"].astype(str)


def _pair(table: "pd.DataFrame", wording: str, other: str, run: str, label: str, category: str) -> WordingPair:
    first = table[_in_both(table, wording, other)]
    second = table[table["wording"] == other]
    right_there = dict(zip(_keys(second), second["outcome"] == "correct", strict=True))
    right = np.asarray(first["outcome"] == "correct", int)
    right_other = np.asarray(_keys(first).map(right_there), int)
    difference = right - right_other
    only, only_other = int((difference > 0).sum()), int((difference < 0).sum())
    p_groups = grouped_sign_p(difference, units_of(first))
    return WordingPair(
        run=run,
        label=label,
        category=category,
        wording=wording,
        other=other,
        n_episodes=len(first),
        sr=float(right.mean()),
        other_sr=float(right_other.mean()),
        only=only,
        only_other=only_other,
        p=sign_p(only, only_other),
        p_groups=p_groups,
        p_holm=p_groups,
    )
