"""The twelve categories of Act2Answer with their domains, and user-defined categories."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from probe_kit.errors import UnknownCategoryError, UsageError

OWN_DOMAIN = "own"
"""The domain of every category that is not one of the paper's."""
RESERVED = ("all", "mean")
"""Names that tables use for results over all categories."""
_SLUG = re.compile(r"[a-z0-9]([a-z0-9-]{0,38}[a-z0-9])?")


@dataclass(frozen=True)
class Category:
    """One kind of knowledge that the suite asks for."""

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


def category_of(slug: str) -> Category:
    """Return the category of this name: one of the paper's, or one of a suite's own."""
    return CATEGORIES.get(slug) or Category(slug, slug.replace("-", " ").capitalize(), OWN_DOMAIN)


def is_slug(name: str) -> bool:
    """Whether a category may have this name: small letters, digits and inner hyphens, at most 40, not reserved."""
    return _SLUG.fullmatch(name) is not None and name not in RESERVED


def check_slug(name: str) -> str:
    """Return the name unchanged.

    Raises:
        UsageError: If no category may have this name.
    """
    if not is_slug(name):
        raise UsageError(
            f"{name!r} cannot name a category: expected up to 40 small letters, digits and inner hyphens, such as "
            f"`ripe-fruit`, and none of {', '.join(RESERVED)}"
        )
    return name


def in_order(slugs: Iterable[str]) -> tuple[str, ...]:
    """Return each name once: the paper's categories in its order, then the others alphabetically."""
    names = set(slugs)
    return (*(slug for slug in CATEGORIES if slug in names), *sorted(names - CATEGORIES.keys()))


def check_categories(names: Sequence[str], available: Sequence[str]) -> tuple[str, ...]:
    """Return the names unchanged, if all are available.

    Raises:
        UnknownCategoryError: For a name that is not available; the message has its nearest match and all available
            names.
    """
    for name in names:
        if name not in available:
            near = get_close_matches(name.lower(), available, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise UnknownCategoryError(f"unknown category {name!r}; available: {', '.join(available)}.{hint}")
    return tuple(names)
