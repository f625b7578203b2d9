"""Items that several runs have in common: equal in id and content, whatever suites they were selected from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING

from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    import pandas as pd

MANY = 0.8
"""Share of items in common below which groups of runs are not paired."""
OWN_WORDS = "knowledge"
"""The wording of a run in the items' own words."""
_CONTENT = "item_content_sha256"
EpisodeKey = tuple[str, str, str]
"""Item, layout and content of the item."""


@dataclass(frozen=True)
class CommonItems:
    """The episodes of one category that several runs have in common.

    episodes: (item, layout) of them. n_items: items of them. of_items: items of any of the runs.
    is_complete: whether every run has these episodes and no others.
    """

    episodes: frozenset[tuple[str, str]]
    n_items: int
    of_items: int
    is_complete: bool

    def select(self, episodes: "pd.DataFrame") -> "pd.DataFrame":
        """The rows of a table of episodes that are among these, with their index."""
        keys = zip(episodes["item_id"].astype(str), episodes["layout"].astype(str), strict=True)
        return episodes[[key in self.episodes for key in keys]]

    @property
    def is_many(self) -> bool:
        """Whether at least 80 % of the items are in common, and so worth leaving out the others."""
        return self.n_items >= MANY * self.of_items


def common_items(runs: Sequence[RunReader]) -> dict[str, CommonItems]:
    """Return by category that all runs have the episodes in common, of which there may be none.

    Items are the same where id and content hash are equal. Runs of one suite need no hashes. Nothing is in common
    of runs of several suites if one of them holds no hashes, as arrays do.
    """
    by_content = all(has_item_content(run) for run in runs)
    if not by_content and len({run.suite for run in runs}) > 1:
        return {}
    episodes = [_episodes(run.episodes, by_content) for run in runs]
    shared = [name for name in episodes[0] if all(name in of_run for of_run in episodes)]
    return {name: _common([of_run[name] for of_run in episodes]) for name in shared}


def has_item_content(run: RunReader) -> bool:
    """Whether a run says what each of its items holds."""
    return _CONTENT in run.episodes and not bool(run.episodes[_CONTENT].isna().any())


def wording_of(run: RunReader) -> str:
    """The wordings of a run's episodes, comma-separated."""
    wordings = run.episodes["wording"].unique() if "wording" in run.episodes else [OWN_WORDS]
    return ", ".join(map(str, wordings))


def _common(of_runs: Sequence[frozenset[EpisodeKey]]) -> CommonItems:
    common = reduce(frozenset.intersection, of_runs)
    every = reduce(frozenset.union, of_runs)
    return CommonItems(
        frozenset((item, layout) for item, layout, _ in common),
        len({item for item, _, _ in common}),
        len({(item, content) for item, _, content in every}),
        all(episodes == common for episodes in of_runs),
    )


def _episodes(episodes: "pd.DataFrame", by_content: bool) -> Mapping[str, frozenset[EpisodeKey]]:
    return {
        str(name): frozenset(
            zip(
                table["item_id"].astype(str),
                table["layout"].astype(str),
                table[_CONTENT].astype(str) if by_content else [""] * len(table),
                strict=True,
            )
        )
        for name, table in episodes.groupby("category", sort=False)
    }
