"""The probing problem of a category: episodes, labels, folds, label permutations."""

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError
from probe_kit.hashing import derive_seed
from probe_kit.statistics.estimates.balanced import balanced_sums
from probe_kit.statistics.estimates.shares import Accuracy
from probe_kit.statistics.folds import fold_numbers, fold_units, stratified_folds
from probe_kit.statistics.label_permutations import exchange_groups, flip_groups, smallest_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.metrics import chance_level
from probe_kit.train.crossval.site_probe import NestedFold, SiteProbe, nested_folds, probe_site
from probe_kit.train.data.labels import target_labels
from probe_kit.train.data.samples import Samples
from probe_kit.train.settings import ProbeSettings

if TYPE_CHECKING:
    import pandas as pd


POOLED = "all"
"""Category that holds the episodes of all categories."""

MOST_OF_ONE_SIDE = 0.75
"""Share of episodes with the same correct side above which a category is refused; it is 0.5 if none is missing."""


@dataclass(frozen=True)
class CategoryProblem:
    """What all sites of a category share: which episodes, their labels, folds and label permutations.

    rows: (E,) positions in the run's episode table. labels: (E,). permuted_labels: (E, P).
    token_permutations: how many of them are fitted where every token is a sample.
    """

    rows: NDArray[np.intp]
    labels: NDArray[np.bool_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    episodes: NDArray[np.str_]
    folds: list[NestedFold]
    permuted_labels: NDArray[np.bool_]
    token_permutations: int

    @cached_property
    def fold_of(self) -> NDArray[np.int64]:
        """(E,) outer fold that tests an episode."""
        return fold_numbers([fold.outer for fold in self.folds])

    def probe(self, samples: Samples) -> SiteProbe:
        """Probe one site; `samples` are those of all the run's episodes."""
        drawn = self.permuted_labels if samples.pools else self.permuted_labels[:, : self.token_permutations]
        return self.fit(samples.of(self.rows), drawn)

    def fit(self, samples: Samples, permuted_labels: NDArray[np.bool_]) -> SiteProbe:
        """Probe the samples of this category's episodes, and again for every column of (E, P) permuted labels."""
        return probe_site(samples, self.labels, permuted_labels, self.folds)

    def accuracy(self, decisions: NDArray[np.float64]) -> Accuracy:
        """Held-out accuracy of probes, balanced between the sides, groups of items as the unit.

        decisions: (E,) of one probe, or (K, E) of several, whose mean accuracy it is.
        """
        sums = balanced_sums(np.atleast_2d(decisions), self.labels, self.fold_of, self.groups)
        return Accuracy(np.unique(self.groups), sums.sums.mean(axis=0), sums.sizes)


def category_problem(episodes: "pd.DataFrame", category: str, settings: ProbeSettings) -> CategoryProblem:
    """The probing problem of one category, or of all episodes for `POOLED`.

    Raises TooFewGroupsError, UnbalancedEpisodesError and, for concept folds without concepts, UsageError.
    """
    defined = target_labels(episodes, settings.target, settings.seed)
    chosen = (episodes["category"] == category).to_numpy() | (category == POOLED)
    if settings.incomplete == "drop":
        chosen &= _complete(episodes)
    rows = np.flatnonzero(chosen & (defined >= 0))
    table, labels = episodes.iloc[rows], defined[rows] == 1
    groups = fold_units(table, settings.folds)
    if settings.call > 0 and groups.size == 0:
        raise TooFewGroupsError(f"category {category!r}: {_reached(0, settings.call)}")
    if settings.target != "chosen":
        _check_balance(labels, category, settings.call)
    try:
        folds = _folds(table, labels, groups, derive_seed("folds", settings.seed, category), settings)
    except TooFewGroupsError as error:
        if settings.call > 0:
            seen = f"{_reached(labels.size, settings.call)}: {np.unique(groups).size} independent groups of items"
            raise TooFewGroupsError(f"category {category!r}: {seen}, too few for folds") from error
        raise TooFewGroupsError(f"category {category!r}, target {settings.target!r}: {error}") from error
    permuted_labels = _permute_labels(table, labels, groups, category, settings, folds)
    _check_power(permuted_labels.shape[1], category, settings)
    return CategoryProblem(
        rows=rows,
        labels=labels,
        items=table["item_id"].to_numpy(dtype=str),
        groups=groups,
        episodes=table["episode_id"].to_numpy(dtype=str),
        folds=folds,
        permuted_labels=permuted_labels,
        token_permutations=settings.token_permutations,
    )


def _folds(
    table: "pd.DataFrame", labels: NDArray[np.bool_], groups: NDArray[np.str_], seed: int, settings: ProbeSettings
) -> list[NestedFold]:
    """Return folds that are balanced by side, for `chosen` by layout.

    Groups exchange their chosen sides, so folds that knew the real ones would make them easier than any exchange.
    Raises TooFewGroupsError as `nested_folds` does, and for a training side with a single class.
    """
    if settings.target != "chosen":
        return nested_folds(labels, groups, seed)
    folds = nested_folds(table["layout"].to_numpy(dtype=str), groups, seed, stratified_folds)
    shares = [labels[inner.train].mean() for fold in folds for inner in fold.inner]
    if min(shares) == 0 or max(shares) == 1:
        raise TooFewGroupsError(
            f"{labels.sum()} of {labels.size} episodes chose the left side, and a training fold holds one side "
            "only; expected both in several groups. Extract more items of this category"
        )
    return folds


def _complete(episodes: "pd.DataFrame") -> NDArray[np.bool_]:
    """(E,) whether all layouts that the run has are there of an episode's item."""
    layouts = episodes.groupby("item_id")["layout"].transform("nunique")
    complete: NDArray[np.bool_] = (layouts == episodes["layout"].nunique()).to_numpy()
    return complete


def _check_balance(labels: NDArray[np.bool_], category: str, call: int) -> None:
    """Warn of sides that are not equally often correct; raise UnbalancedEpisodesError if one nearly always is."""
    share = chance_level(labels) if labels.size else 0.5
    if share == 0.5:
        return
    why = "Episodes are missing from the run" if call == 0 else _reached(labels.size, call)
    seen = (
        f"category {category!r}: classes are not balanced, chance is {share:.3f}; expected 0.5 with both layouts "
        f"of every item. {why}."
    )
    pair = "leave out the other layout of their items (--incomplete drop, incomplete='drop')."
    if share > MOST_OF_ONE_SIDE:
        instead = "Extract the missing episodes again" if call == 0 else "Probe an earlier inference (--call)"
        raise UnbalancedEpisodesError(
            f"{seen} Beyond {MOST_OF_ONE_SIDE} nothing is left to be read. {instead}, or {pair}"
        )
    warnings.warn(f"{seen} Leave out the other layout of their items with incomplete='drop'.", stacklevel=4)


def _reached(episodes: int, call: int) -> str:
    """Why there are no more of them at a later inference."""
    number = {0: "no episode", 1: "only 1 episode"}.get(episodes, f"only {episodes} episodes")
    return f"{number} got as far as captured inference {call}, counted from 0, and the others ended before"


def _check_power(count: int, category: str, settings: ProbeSettings) -> None:
    """Warn where the groups allow no result to be significant."""
    if count < settings.permutations and (least := smallest_p(count)) >= SIGNIFICANCE:
        warnings.warn(
            f"category {category!r}: its groups allow {count} label permutations, the smallest possible p is "
            f"{least:.3f}: nothing can be below {SIGNIFICANCE}. Extract more items.",
            stacklevel=4,
        )


def _permute_labels(
    table: "pd.DataFrame",
    labels: NDArray[np.bool_],
    groups: NDArray[np.str_],
    category: str,
    settings: ProbeSettings,
    folds: list[NestedFold],
) -> NDArray[np.bool_]:
    """(E, P) permuted labels, without those that leave a training fold with a single class: they have no probe."""
    seed = derive_seed("relabelling", settings.seed, category)
    count = max(settings.permutations, settings.token_permutations)
    if settings.target == "chosen":
        drawn = exchange_groups(labels, groups, table["item_id"], table["layout"], count, seed)
    else:
        drawn = flip_groups(labels, groups, count, seed)
    shares = np.array([drawn[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    return drawn[:, ((shares > 0) & (shares < 1)).all(axis=0)]
