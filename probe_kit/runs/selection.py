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
    categories_of_run = list(dict.fromkeys(items["category"].astype(str)))
    selected = categories_of_run if categories is None else check_categories(categories, categories_of_run)
    if not selected:
        raise UsageError("no category selected. Name at least one, or leave `categories` out for all.")
    item_ids: list[str] = []
    for category in selected:
        planned = items[items["category"] == category]
        count = len(planned) if per_category is None else per_category
        if not 0 < count <= len(planned):
            raise UsageError(
                f"items is {count}, but {where} plans {len(planned)} items of {category!r}; give a number from 1 "
                f"to {len(planned)}, or play more with `probe-kit extract`"
            )
        _check_twins(planned, count, category)
        item_ids += planned["item_id"].iloc[:count].tolist()
    return item_ids


def _check_twins(items: "pd.DataFrame", count: int, category: str) -> None:
    """Raise UsageError if the first items hold one of two role-exchanged twins, and the others the other one."""
    pairs = items["pair_id"]
    separated = set(pairs.iloc[:count].dropna()) & set(pairs.iloc[count:].dropna())
    if separated:
        raise UsageError(
            f"items is {count}, which would keep one of the role-exchanged twins {min(separated)!r} of "
            f"{category!r} and drop the other. Give an even number."
        )
