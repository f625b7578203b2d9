"""Selection of a run's items, as `Suite.select` selects a suite's."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.suite.categories import check_categories

if TYPE_CHECKING:
    import pandas as pd


def select_items(
    items: "pd.DataFrame", categories: Sequence[str] | None, per_category: int | None, where: str
) -> list[str]:
    """Ids of the first items of some categories, in the order of the plan.

    items: as `Run.items`. categories: slugs, all by default. where: the run, for messages.
    Raises UnknownCategoryError and UsageError, see `Run.only`.
    """
    there = list(dict.fromkeys(items["category"].astype(str)))
    wanted = there if categories is None else check_categories(categories, there)
    if not wanted:
        raise UsageError("no category selected. Name at least one, or leave `categories` out for all.")
    chosen: list[str] = []
    for category in wanted:
        own = items[items["category"] == category]
        count = len(own) if per_category is None else per_category
        if not 0 < count <= len(own):
            raise UsageError(
                f"items is {count}, but {where} plans {len(own)} items of {category!r}; give a number from 1 to "
                f"{len(own)}, or play more with `probe-kit extract`"
            )
        _check_twins(own, count, category)
        chosen += own["item_id"].iloc[:count].tolist()
    return chosen


def _check_twins(items: "pd.DataFrame", count: int, category: str) -> None:
    """Raise UsageError if the first items hold one of two role-exchanged twins, and the others the other one."""
    pairs = items["pair_id"]
    separated = set(pairs.iloc[:count].dropna()) & set(pairs.iloc[count:].dropna())
    if separated:
        raise UsageError(
            f"items is {count}, which would keep one of the role-exchanged twins {min(separated)!r} of "
            f"{category!r} and drop the other. Give an even number."
        )
