"""VLM minus VLA: what a VLM says of the first frames, against what a policy does in the same episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

from probe_kit.retention.behaviour.success_rate import success_share, units_of
from probe_kit.retention.behaviour.vlm_answers import ask_of
from probe_kit.retention.compare.common_items import CommonItems, common_items, wording_of
from probe_kit.retention.compare.source_weights import Relation, grew_from
from probe_kit.retention.estimators.stream_scores import Limits, Rate, limits
from probe_kit.retention.rows.row import MEAN
from probe_kit.statistics.multiple_testing import corrected
from probe_kit.statistics.paired_tests import flip_p
from probe_kit.train.data.run_reader import RunReader, seed_text_of

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class VlmVlaDifference:
    """Share right of a VLM run minus success rate of a policy run, in one category or over all (`mean`).

    paired: whether both are of the same episodes, those that the two runs have in common, whose groups are then
    drawn together. n_items: items of these, of of_items that either run has. same_frames: whether every one of
    these began with the same frame; None where a run has no hashes. p: exact, signs of whole groups
    flipped, of all items at once in the row `mean`; None unless paired. p_holm: over the categories of all pairs
    of the table, or over the pairs in rows `mean`. source: whether the policy's network grew from the weights that
    were asked; `unknown` where cards do not say. n_groups: independent groups of items that `p` rests on.
    """

    asked: str
    acted: str
    category: str
    paired: bool
    same_frames: bool | None
    n_items: int
    accuracy: float
    sr: float
    difference: float
    difference_ci: Limits
    p: float | None = None
    p_holm: float | None = None
    source: Relation = "unknown"
    of_items: int | None = None
    n_groups: int | None = None


def vlm_vla_differences(
    runs: Sequence[RunReader],
    names: Mapping[str, str] | None = None,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> list[VlmVlaDifference]:
    """Every VLM run minus every acting one that it can be compared with, per category and over all of them.

    A policy whose network grew from weights that were asked is not compared with VLMs of other weights.
    names: what runs are called, by their location; by default their labels. pairs: locations of the VLM runs and
    policy runs that are compared instead. Runs as `retention` reads them.
    """
    called = names or {str(run.location): run.label for run in runs}
    asked = [run for run in runs if ask_of(run) is not None]
    acted = [run for run in runs if ask_of(run) is None]
    found: list[VlmVlaDifference] = []
    for vlm, policy, source in _chosen(asked, acted, pairs):
        found += [replace(row, source=source) for row in _pair(vlm, policy, called)]
    p_holm = corrected(found, lambda row: row.p, lambda row: row.category == MEAN)
    return [replace(row, p_holm=p) for row, p in zip(found, p_holm, strict=True)]


def _chosen(
    asked: Sequence[RunReader], acted: Sequence[RunReader], pairs: Sequence[tuple[str, str]] | None
) -> list[tuple[RunReader, RunReader, Relation]]:
    """The pairs that are compared, VLM by VLM."""
    related = [(vlm, policy, grew_from(policy, vlm)) for vlm, policy in product(asked, acted)]
    if pairs is not None:
        return [one for one in related if (str(one[0].location), str(one[1].location)) in pairs]
    grown = {id(policy) for _, policy, source in related if source == "yes"}
    return [pair for pair in related if pair[2] != "no" or id(pair[1]) not in grown]


def _pair(vlm: RunReader, policy: RunReader, called: Mapping[str, str]) -> list[VlmVlaDifference]:
    there = dict(list(policy.episodes.groupby("category", sort=False)))
    items = common_items([vlm, policy]) if wording_of(vlm) == wording_of(policy) else {}
    pairs = [
        _Episodes.of(str(category), here, there[category], items.get(str(category)))
        for category, here in vlm.episodes.groupby("category", sort=False)
        if category in there
    ]
    if not pairs:
        return []
    found = [_compare(pair, (vlm, policy), called) for pair in pairs]
    return [*(row for row, _ in found), _mean(pairs, [row for row, _ in found], [gap for _, gap in found])]


@dataclass(frozen=True)
class _Episodes:
    """The episodes of a category that are compared: those in common, or all of both where there are none."""

    category: str
    here: "pd.DataFrame"
    there: "pd.DataFrame"
    of_items: int | None

    @classmethod
    def of(
        cls, category: str, here: "pd.DataFrame", there: "pd.DataFrame", common: CommonItems | None
    ) -> "_Episodes":
        if common is None or not common.n_items:
            return cls(category, here, there, None)
        return cls(category, common.select(here), common.select(there), common.of_items)

    @property
    def paired(self) -> bool:
        return self.of_items is not None


def _compare(
    pair: _Episodes, runs: tuple[RunReader, RunReader], called: Mapping[str, str]
) -> tuple[VlmVlaDifference, Rate]:
    vlm, policy = runs
    seed_texts = seed_text_of(vlm), seed_text_of(vlm if pair.paired else policy)
    accuracy, sr = (
        Rate.pooled([success_share(frame, seed_text)])
        for frame, seed_text in zip((pair.here, pair.there), seed_texts, strict=True)
    )
    gap = accuracy.minus(sr)
    row = VlmVlaDifference(
        asked=called[str(vlm.location)],
        acted=called[str(policy.location)],
        category=pair.category,
        paired=pair.paired,
        same_frames=_same_frames(pair.here, pair.there),
        n_items=int(pair.here["item_id"].nunique()),
        accuracy=accuracy.value,
        sr=sr.value,
        difference=gap.value,
        difference_ci=limits(gap.interval),
        p=_p(pair.here, pair.there) if pair.paired else None,
        of_items=pair.of_items,
        n_groups=len(set(units_of(pair.here))) if pair.paired else None,
    )
    return row, gap


def _p(here: "pd.DataFrame", there: "pd.DataFrame") -> float:
    ordered = there.set_index("episode_id").loc[here["episode_id"]]
    known, used = ((frame["outcome"] == "correct").to_numpy(bool) for frame in (here, ordered))
    return flip_p(known, used, units_of(here))


def _same_frames(here: "pd.DataFrame", there: "pd.DataFrame") -> bool | None:
    column = "first_frame_sha256"
    if column not in here or column not in there:
        return None
    both = here[["episode_id", column]].merge(there[["episode_id", column]], on="episode_id")
    return bool(len(both) and (both[f"{column}_x"] == both[f"{column}_y"]).all())


def _mean(pairs: Sequence[_Episodes], rows: Sequence[VlmVlaDifference], gaps: Sequence[Rate]) -> VlmVlaDifference:
    import pandas as pd

    gap = Rate.mean(gaps)
    paired = all(row.paired for row in rows)
    known = [row.of_items for row in rows if row.of_items is not None]
    return replace(
        rows[0],
        category=MEAN,
        paired=paired,
        same_frames=None if None in (own := {row.same_frames for row in rows}) else own == {True},
        n_items=sum(row.n_items for row in rows),
        accuracy=sum(row.accuracy for row in rows) / len(rows),
        sr=sum(row.sr for row in rows) / len(rows),
        difference=gap.value,
        difference_ci=limits(gap.interval),
        p=_p(pd.concat([one.here for one in pairs]), pd.concat([one.there for one in pairs])) if paired else None,
        of_items=sum(known) if len(known) == len(rows) else None,
        n_groups=sum(row.n_groups or 0 for row in rows) if paired else None,
    )
