"""What a swap of the images or of the instruction showed, in sentences."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from probe_kit.intervene.kinds.base import TableContext
from probe_kit.intervene.kinds.image_swap.effects import ImageSwapEffect
from probe_kit.intervene.kinds.image_swap.verdict import UseVerdict
from probe_kit.suite.categories import category_of


class Swapped(Protocol):
    """The numbers of a swap: `ImageSwapEffect`, or a part of a row that has them."""

    @property
    def follow_rate(self) -> float | None:
        """Share of episodes."""

    @property
    def reversal_rate(self) -> float | None:
        """Share of episodes."""

    @property
    def net_follow_rate_ci(self) -> tuple[float | None, float | None] | None:
        """95 % interval of the difference."""

    @property
    def reach_share(self) -> float | None:
        """Displacement in units of the reach."""


def describe_swap(swap: Swapped, use: UseVerdict) -> str:
    """What a swap of the pictures does to the action, with the numbers that the verdict's sentence lacks.

    Numbers and words are of the verdict's own readout.
    """
    use = replace(use, other=None)
    low, high = (_percent(limit) for limit in swap.net_follow_rate_ci or (None, None))
    followed, net = f"in {_percent(swap.follow_rate)} % of episodes", f"net of reversals {low} to {high} %"
    moved = "" if swap.reach_share is None else f", moved by {swap.reach_share:.2f} of its reach"
    if use.behaviour == "used" and not use.reversed:
        return f"the action follows a swap of the pictures {followed} ({net})"
    if use.behaviour == "used":
        against = f"in {_percent(swap.reversal_rate)} % of episodes"
        return f"the action goes against the pictures, swapped or not, {against}"
    if use.is_bounded:
        return f"the action does not follow a swap of the pictures ({followed})"
    if use.behaviour == "inconclusive":
        return f"whether the action follows a swap of the pictures is open ({followed})"
    numbers = f"{followed}, {net}{moved}" if use.is_used else followed
    return f"the action follows a swap of the pictures in part ({numbers})"


def image_swap_sentences(rows: Sequence[ImageSwapEffect], context: TableContext) -> list[str]:
    """One per category, with its verdict."""
    return [f"{_begin(row)}: {_finding(row, context)}" for row in rows]


def _finding(row: ImageSwapEffect, context: TableContext) -> str:
    use = context.verdicts.get(row.category)
    return (
        f"{describe_swap(row, use)}. {use.sentence}"
        if isinstance(use, UseVerdict)
        else f"{_rates(row, 'images')}."
    )


def instruction_swap_sentences(rows: Sequence[ImageSwapEffect], _: TableContext) -> list[str]:
    """One per category; a swap of the instruction enters no verdict."""
    return [f"{_begin(row)}: {_rates(row, 'instruction')}." for row in rows]


def _rates(row: ImageSwapEffect, what: str) -> str:
    low, high = map(_percent, row.net_follow_rate_ci)
    return (
        f"the action follows a swap of the {what} in {_percent(row.follow_rate)} % of episodes and does the "
        f"reverse in {_percent(row.reversal_rate)} % (net {low} to {high} %)"
    )


def _begin(row: ImageSwapEffect) -> str:
    return f"{category_of(row.category).title} ({row.n_items} item{'s' * (row.n_items != 1)})"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f}"
