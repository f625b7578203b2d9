"""The probing problem of a category: which episodes, which labels, which folds, which relabellings."""

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import TooFewGroupsError
from probe_kit.identity import derive_seed
from probe_kit.train.permutation import exchange_items, flip_items
from probe_kit.train.probe import NestedFold, SiteProbe, nested_folds, probe_site
from probe_kit.train.samples import Samples
from probe_kit.train.scores import chance_level
from probe_kit.train.settings import ProbeSettings
from probe_kit.train.targets import target_labels

if TYPE_CHECKING:
    import pandas as pd


POOLED = "all"
"""Category that holds the episodes of all categories."""


@dataclass(frozen=True)
class CategoryProblem:
    """What all sites of a category share: which episodes, their labels, folds and relabellings.

    rows: (E,) positions in the run's episode table. labels: (E,). relabellings: (E, P). token_permutations: how
    many of them are fitted where every token is a sample.
    """

    rows: NDArray[np.intp]
    labels: NDArray[np.bool_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    episodes: NDArray[np.str_]
    folds: list[NestedFold]
    relabellings: NDArray[np.bool_]
    token_permutations: int

    def probe(self, samples: Samples) -> SiteProbe:
        """Probe one site; `samples` are those of all the run's episodes."""
        drawn = self.relabellings if samples.pools else self.relabellings[:, : self.token_permutations]
        return probe_site(samples.of(self.rows), self.labels, drawn, self.folds)


def category_problem(episodes: "pd.DataFrame", category: str, settings: ProbeSettings) -> CategoryProblem:
    """The probing problem of one category, or of all episodes for `POOLED`. Raises TooFewGroupsError."""
    defined = target_labels(episodes, settings.target, settings.seed)
    chosen = (episodes["category"] == category).to_numpy() | (category == POOLED)
    rows = np.flatnonzero(chosen & (defined >= 0))
    table, labels = episodes.iloc[rows], defined[rows] == 1
    groups = table["group_id"].to_numpy(dtype=str)
    if settings.target != "chosen" and chance_level(labels) > 0.5:
        warnings.warn(
            f"category {category!r}: classes are not balanced, chance is {chance_level(labels):.3f}; "
            "expected 0.5 with both layouts of every item. Episodes are missing from the run.",
            stacklevel=3,
        )
    try:
        folds = nested_folds(labels, groups, derive_seed("folds", settings.seed, category))
    except TooFewGroupsError as error:
        raise TooFewGroupsError(f"category {category!r}, target {settings.target!r}: {error}") from error
    return CategoryProblem(
        rows=rows,
        labels=labels,
        items=table["item_id"].to_numpy(dtype=str),
        groups=groups,
        episodes=table["episode_id"].to_numpy(dtype=str),
        folds=folds,
        relabellings=_relabel(table, labels, category, settings, folds),
        token_permutations=settings.token_permutations,
    )


def _relabel(
    table: "pd.DataFrame",
    labels: NDArray[np.bool_],
    category: str,
    settings: ProbeSettings,
    folds: list[NestedFold],
) -> NDArray[np.bool_]:
    """(E, P) relabellings, without those that leave a training fold with a single class: they have no probe."""
    seed = derive_seed("relabelling", settings.seed, category)
    count = max(settings.permutations, settings.token_permutations)
    if settings.target == "chosen":
        drawn = exchange_items(labels, table["item_id"], table["layout"], count, seed)
    else:
        drawn = flip_items(labels, table["item_id"], count, seed)
    shares = np.array([drawn[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    return drawn[:, ((shares > 0) & (shares < 1)).all(axis=0)]
