"""The success rate of a policy, whether it differs from guessing, and on which side the policy errs."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.env.scoring.outcome import SENSITIVITY_RADII, success_at
from probe_kit.errors import UsageError
from probe_kit.runs.layout import CAPTURE_ONLY
from probe_kit.runs.reader import check_several_wordings
from probe_kit.statistics.estimates.shares import Share
from probe_kit.statistics.paired_tests import heads_p
from probe_kit.statistics.significance import chance_margin

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


class Regime(StrEnum):
    """The three readings of a success rate: how far knowledge reaches the action."""

    KNOWLEDGE = "evidence of usable knowledge"
    NO_RELIABLE_KNOWLEDGE = "no reliable usable knowledge"
    FAILURE = "instruction or perceptual failure"


@dataclass(frozen=True)
class PairedItems:
    """Items that ran in both layouts, by how many of the two were right.

    both, one, none: numbers of items. both_wrong: items that chose the wrong picture twice, part of `none`.
    p: exact one-sided p of groups with more of `both` against groups with more of `both_wrong`. A side bias of any
    strength makes them equally likely, and items that share a picture count once.
    """

    both: int
    one: int
    none: int
    both_wrong: int
    p: float


@dataclass(frozen=True, kw_only=True)
class SuccessRate:
    """Outcomes of the episodes of one category (or of any table of episodes); rates are shares, 0 to 1.

    n_groups: independent groups of items. ci: 95 % interval of `sr`, groups of items as the unit
    (`Share.interval`). sr_original, sr_swapped: per layout, and layout_mean their mean. sr_left, sr_right: per
    side of the correct picture. share_wrong, share_outside: ended on the other picture, or on neither.
    share_never_moved: share that ended where it started, a failed grasp; part of share_outside, None if it was not
    recorded. share_invalid_action: share of
    inferences that put out no action, None for a policy that cannot tell. chance_margin_episodes: half-width of
    the band around 0.5 that guessing explains, for N = episodes (the paper's); chance_margin_items: the same for
    N = items; chance_margin: for as many items as count, fewer where items of a group answer alike, and what
    `regime` is judged by. reason: why that regime, or why there is no rate. side_preference: share placed left
    among episodes placed in a zone. normalised_score: only of a mean over categories. A rate over no episodes is
    None, and so is every rate of a model that did not act.
    """

    n_episodes: int
    n_items: int
    n_groups: int | None = None
    sr: float | None = None
    ci: tuple[float | None, float | None] | None = None
    sr_original: float | None = None
    sr_swapped: float | None = None
    layout_mean: float | None = None
    sr_left: float | None = None
    sr_right: float | None = None
    share_wrong: float | None = None
    share_outside: float | None = None
    share_never_moved: float | None = None
    share_invalid_action: float | None = None
    chance_margin_episodes: float | None = None
    chance_margin_items: float | None = None
    chance_margin: float | None = None
    regime: Regime | None = None
    reason: str = ""
    side_preference: float | None = None
    normalised_score: float | None = None
    paired: PairedItems | None = None


def regime(
    sr: float, margin: float, share_wrong: float, share_outside: float, answers: bool = False
) -> tuple[Regime, str]:
    """The regime of a success rate, and why in a few words. answers: it is one of answers, `oob` one not read."""
    share = "accuracy" if answers else "SR"
    if sr > 0.5 + margin:
        return Regime.KNOWLEDGE, f"{share} {sr:.3f} is above 0.5 + Δ = {0.5 + margin:.3f}"
    if sr >= 0.5 - margin:
        return Regime.NO_RELIABLE_KNOWLEDGE, f"{share} {sr:.3f} is within 0.5 ± Δ = {margin:.3f}"
    nowhere = "no answer could be read in" if answers else "the cube ends outside both zones in"
    cause = (
        f"{nowhere} {share_outside:.0%} of episodes"
        if share_outside >= share_wrong
        else f"the wrong picture is chosen in {share_wrong:.0%} of episodes"
    )
    return Regime.FAILURE, f"{share} {sr:.3f} is below 0.5 − Δ = {0.5 - margin:.3f}: {cause}"


def normalised_score(success_rates: Sequence[float]) -> float:
    """Mean success rate over categories on a scale where guessing is 0 and perfection 100."""
    if not success_rates:
        raise UsageError("the normalised score needs the success rate of at least one category")
    return (100 * fmean(success_rates) - 50) / 50 * 100


def capture_only(episodes: "pd.DataFrame") -> bool:
    """Whether the model of these episodes only captured: it did not act, and there is no success rate.

    Episodes without a column `outcome`, such as those of arrays of your own, do not say so.
    """
    if episodes.empty or "outcome" not in episodes:
        return False
    return bool((episodes["outcome"] == CAPTURE_ONLY).all())


def _check_acted(episodes: "pd.DataFrame") -> None:
    if capture_only(episodes):
        raise UsageError("this run's model was captured (extract --no-act): there is no success rate, only probes")


def shares_of(episodes: "pd.DataFrame", outcome: str) -> "NDArray[np.float64]":
    """(E,) how much of each episode had this outcome: 0 or 1, or a share where several last steps were judged."""
    name = f"share_{outcome}"
    if name in episodes:
        return episodes[name].to_numpy(dtype=np.float64)
    return (episodes["outcome"] == outcome).to_numpy().astype(np.float64)


def _correct(episodes: "pd.DataFrame") -> "pd.Series[float]":
    return episodes[[]].assign(correct=shares_of(episodes, "correct"))["correct"]


def success_share(episodes: "pd.DataFrame", seed_text: str = "") -> Share:
    """SR with groups of items as the unit; the run's `seed_text` tells groups of several suites apart."""
    return Share.of(shares_of(episodes, "correct"), group_names(episodes, seed_text))


def group_names(episodes: "pd.DataFrame", seed_text: str) -> "NDArray[np.str_]":
    """(E,) groups of items, named after the questions of their suite too."""
    return np.char.add(f"{seed_text}/", units_of(episodes))


def success_rate(episodes: "pd.DataFrame") -> SuccessRate:
    """Success rate and its companions for a table of episodes.

    episodes: columns `item_id`, `layout`, `side_correct`, `outcome` (`correct`, `wrong`, `oob`), `side_placed`,
    and `group_id` where items share pictures; `share_correct` and so on where the last steps of an episode were
    averaged, which items' pairs take no notice of. Raises UsageError for a table that is
    empty or of several wordings, and for episodes in which the model did not act.
    """
    check_several_wordings(episodes)
    _check_acted(episodes)
    if episodes.empty:
        raise UsageError("no finished episodes: there is no success rate. Finish the extraction first.")
    correct = _correct(episodes)
    sr, share_wrong = float(correct.mean()), float(shares_of(episodes, "wrong").mean())
    share_outside = float(shares_of(episodes, "oob").mean())
    n_items = int(episodes["item_id"].nunique())
    margin = chance_margin(independent_items(episodes))
    name, reason = regime(sr, margin, share_wrong, share_outside, "parse" in episodes)
    interval = success_share(episodes).interval()
    if name == Regime.KNOWLEDGE and interval.low <= 0.5:
        name, reason = Regime.NO_RELIABLE_KNOWLEDGE, f"{reason}, but its 95 % interval includes one half"
    original, swapped = (_rate(correct[episodes["layout"] == layout]) for layout in ("original", "swapped"))
    placed = episodes["side_placed"][episodes["outcome"] != "oob"]
    return SuccessRate(
        n_episodes=len(episodes),
        n_items=n_items,
        n_groups=np.unique(units_of(episodes)).size,
        sr=sr,
        ci=(interval.low, interval.high),
        sr_original=original,
        sr_swapped=swapped,
        layout_mean=None if original is None or swapped is None else (original + swapped) / 2,
        sr_left=_rate(correct[episodes["side_correct"] == "left"]),
        sr_right=_rate(correct[episodes["side_correct"] == "right"]),
        share_wrong=share_wrong,
        share_outside=share_outside,
        share_never_moved=_rate(episodes["never_moved"].astype(bool)) if "never_moved" in episodes else None,
        share_invalid_action=_flagged(episodes),
        chance_margin_episodes=chance_margin(len(episodes)),
        chance_margin_items=chance_margin(n_items),
        chance_margin=margin,
        regime=name,
        reason=reason,
        side_preference=_rate(placed == "left"),
        paired=paired_items(episodes),
    )


def _flagged(episodes: "pd.DataFrame") -> float | None:
    """Every inference counts once, whatever its episode."""
    if not {"flagged_steps", "inferences"} <= set(episodes):
        return None
    return float(episodes["flagged_steps"].sum() / episodes["inferences"].sum())


def units_of(episodes: "pd.DataFrame") -> "NDArray[np.str_]":
    """(E,) what is drawn as a whole: the group of items that share pictures, or the item where none is known."""
    return episodes["group_id" if "group_id" in episodes else "item_id"].to_numpy(dtype=str)


def independent_items(episodes: "pd.DataFrame") -> float:
    """Return how many items the success rate rests on: all of them, or fewer where those of a group answer alike.

    The number of items over how much more the success rate varies between groups than it would if their items had
    nothing in common.
    """
    correct = _correct(episodes)
    residual = correct - correct.mean()
    by_item = float((residual.groupby(episodes["item_id"]).sum() ** 2).sum())
    by_group = float((residual.groupby(units_of(episodes)).sum() ** 2).sum())
    items = int(episodes["item_id"].nunique())
    return items if by_group <= by_item else items * by_item / by_group


def sensitivity(episodes: "pd.DataFrame", radii: Sequence[float] = SENSITIVITY_RADII) -> dict[float, float]:
    """Success rate by zone radius ε in metres, from where the cube ended: no episode runs again.

    episodes: columns `distance_correct` and `distance_wrong`, metres; missing where the simulator broke, which
    is no success. Empty for a table without these columns. Raises SceneError for a radius with overlapping zones.
    """
    columns = ["distance_correct", "distance_wrong"]
    if not set(columns) <= set(episodes):
        return {}
    distances = [(correct, wrong) for correct, wrong in episodes[columns].astype(float).to_numpy()]
    return {radius: success_at(distances, radius) for radius in radii}


def paired_items(episodes: "pd.DataFrame") -> PairedItems:
    """Items that ran in both layouts, by outcome; others are left out. Raises UsageError if nothing was acted."""
    _check_acted(episodes)
    outcomes = episodes.pivot(index="item_id", columns="layout", values="outcome")
    outcomes = outcomes.reindex(columns=["original", "swapped"]).dropna()
    right, wrong = (outcomes == "correct").sum(axis=1), (outcomes == "wrong").sum(axis=1)
    group_of = dict(zip(episodes["item_id"], units_of(episodes), strict=True))
    lead = ((right == 2).astype(int) - (wrong == 2)).groupby(outcomes.index.map(group_of)).sum()
    both, both_wrong = int((right == 2).sum()), int((wrong == 2).sum())
    return PairedItems(
        both=both,
        one=int((right == 1).sum()),
        none=int((right == 0).sum()),
        both_wrong=both_wrong,
        p=heads_p(int((lead > 0).sum()), int((lead != 0).sum())),  # groups that favour neither are no tosses
    )


def _rate(values: "pd.Series[bool] | pd.Series[float]") -> float | None:
    return float(values.mean()) if len(values) else None
