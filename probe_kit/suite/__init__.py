"""Suites: items with an instruction, a correct and a wrong picture; building, storage and checks."""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.suite.build import build_suite, default_suite
    from probe_kit.suite.categories import CATEGORIES, Category
    from probe_kit.suite.items import LAYOUTS, Episode, Item, Layout, Side
    from probe_kit.suite.manifest import load_suite
    from probe_kit.suite.own_questions import PicturePair, Terms, suite_from_csv, suite_from_pictures
    from probe_kit.suite.pictures import load_picture
    from probe_kit.suite.rules import Finding
    from probe_kit.suite.suite import Suite
    from probe_kit.suite.validate import Report, validate_suite

__all__ = [
    "CATEGORIES",
    "LAYOUTS",
    "Category",
    "Episode",
    "Finding",
    "Item",
    "Layout",
    "PicturePair",
    "Report",
    "Side",
    "Suite",
    "Terms",
    "build_suite",
    "default_suite",
    "load_picture",
    "load_suite",
    "suite_from_csv",
    "suite_from_pictures",
    "validate_suite",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "build_suite": "build",
        "default_suite": "build",
        "CATEGORIES": "categories",
        "Category": "categories",
        "LAYOUTS": "items",
        "Episode": "items",
        "Item": "items",
        "Layout": "items",
        "Side": "items",
        "load_suite": "manifest",
        "PicturePair": "own_questions",
        "Terms": "own_questions",
        "suite_from_csv": "own_questions",
        "suite_from_pictures": "own_questions",
        "load_picture": "pictures",
        "Finding": "rules",
        "Suite": "suite",
        "Report": "validate",
        "validate_suite": "validate",
    },
)
