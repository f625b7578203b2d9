"""The twelve categories of Act2Answer (paper, table of tasks) with their domains."""

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from probe_kit.errors import UnknownCategoryError


@dataclass(frozen=True)
class Category:
    """One kind of knowledge the suite asks for."""

    slug: str
    title: str
    domain: str


_ALL = (
    Category("emotion", "Emotion", "social"),
    Category("attribute", "Attribute", "physical"),
    Category("state", "State", "physical"),
    Category("color", "Color", "physical"),
    Category("shape", "Shape", "physical"),
    Category("symmetry", "Symmetry", "physical"),
    Category("counting", "Counting", "quantitative"),
    Category("time", "Time", "temporal"),
    Category("public-info", "Public Info", "normative"),
    Category("traffic", "Traffic", "normative"),
    Category("celebrity", "Celebrity", "cultural"),
    Category("living-world", "Living World", "biological"),
)
CATEGORIES: dict[str, Category] = {category.slug: category for category in _ALL}


def check_categories(names: Sequence[str], available: Sequence[str]) -> tuple[str, ...]:
    """The names as given, if all are available.

    Raises UnknownCategoryError naming the first one that is not, its nearest match, and what there is.
    """
    for name in names:
        if name not in available:
            near = get_close_matches(name.lower(), available, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise UnknownCategoryError(f"unknown category {name!r}; available: {', '.join(available)}.{hint}")
    return tuple(names)
