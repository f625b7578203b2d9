"""Suites: items with an instruction, a correct and a wrong picture; building, storage and checks."""

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
