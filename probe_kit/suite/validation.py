"""The rules a suite must keep, as small functions that yield findings.

Records are the JSON objects of `metadata.jsonl`, checked before they can become items. Every rule that works on
items has the same shape, a Suite in and findings out, and is listed in `LOADING_RULES`; those are fast enough
to run each time a suite is opened, because pictures are hashed but not decoded.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields
from itertools import groupby
from operator import attrgetter
from pathlib import PurePosixPath
from typing import Any, Literal

from probe_kit.suite.categories import CATEGORIES
from probe_kit.suite.grouping import ties
from probe_kit.suite.items import Item, Side
from probe_kit.suite.pictures import picture_size
from probe_kit.suite.suite import Suite, count_by_category

SCHEMA_MAJOR = "1"
SMALLEST_PICTURE = 64
PRINTED_PER_RULE = 20

_SIDES: tuple[Side, Side] = ("left", "right")
_ENUMS: dict[str, tuple[str, ...]] = {
    "category": tuple(CATEGORIES),
    "domain": tuple(dict.fromkeys(category.domain for category in CATEGORIES.values())),
    "transfer_type": ("near", "moderate", "heavy", "procedural"),
    "construction": ("native_pair", "choice_vs_distractor", "cross_item", "recolored", "procedural"),
    "object_article": ("the", "none"),
    "polarity": ("pos", "neg", "none"),
    "correct_side": _SIDES,
    "curation_status": ("rules-only", "accepted", "edited", "llm-trusted"),
    "split": ("eval", "dev", "train"),
}
_TYPES: dict[str, type] = {"source": dict, "gen": dict, "redistributable": bool, "contains_real_face": bool}
_CARD_TYPES: dict[str, type] = {"name": str, "version": str, "counts": dict, "content_sha256": str}
_REQUIRED = [field.name for field in fields(Item) if field.default is MISSING]


@dataclass(frozen=True)
class Finding:
    """One violation of one rule; errors make a suite unusable, warnings do not."""

    rule: str
    severity: Literal["error", "warning"]
    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.rule} {self.where}: {self.message}"


def _error(rule: str, where: str, message: str) -> Finding:
    return Finding(rule, "error", where, message)


def report(findings: Iterable[Finding]) -> str:
    """The findings as lines sorted by rule, at most 20 of each rule and then how many more there are."""
    lines = []
    for rule, same_rule in groupby(sorted(findings, key=attrgetter("rule")), key=attrgetter("rule")):
        found = [str(finding) for finding in same_rule]
        lines += found[:PRINTED_PER_RULE]
        if len(found) > PRINTED_PER_RULE:
            lines.append(f"{rule}: and {len(found) - PRINTED_PER_RULE} more")
    return "\n".join(lines)


# -- records -----------------------------------------------------------------------------------------


def parse_line(line: bytes, where: str) -> dict[str, Any] | Finding:
    """E01: the JSON object on one line, or why it is none."""
    try:
        record = json.loads(line)
    except ValueError as error:  # JSONDecodeError or UnicodeDecodeError
        return _error("E01", where, f"not valid JSON ({error})")
    if not isinstance(record, dict):
        return _error("E01", where, f"a JSON {type(record).__name__}; expected an object")
    return record


def check_card(card: dict[str, Any]) -> Iterator[Finding]:
    """E02 for `suite.json`: it holds what identifies a suite."""
    for name, expected in _CARD_TYPES.items():
        if not isinstance(card.get(name), expected):
            yield _error(
                "E02", "suite.json", f"field {name!r} is {card.get(name)!r}; expected a {expected.__name__}"
            )


def check_record(record: dict[str, Any], where: str) -> Iterator[Finding]:
    """E02: every field is there, has its type, and is one of the values it may have."""
    for name in _REQUIRED:
        expected = _TYPES.get(name, str)
        if name not in record:
            yield _error("E02", where, f"field {name!r} is missing")
        elif not isinstance(record[name], expected):
            yield _error("E02", where, f"field {name!r} is {record[name]!r}; expected a {expected.__name__}")
        elif name in _ENUMS and record[name] not in _ENUMS[name]:
            allowed = ", ".join(_ENUMS[name])
            yield _error("E02", where, f"field {name!r} is {record[name]!r}; expected one of {allowed}")


def check_schema(record: dict[str, Any], where: str) -> Iterator[Finding]:
    """E03: the record follows a schema this tool can read."""
    version = str(record.get("schema_version", "none"))
    if version.split(".")[0] != SCHEMA_MAJOR:
        yield _error("E03", where, f"uses schema {version}; this tool reads {SCHEMA_MAJOR}.x")


# -- items -------------------------------------------------------------------------------------------


def unique_ids(suite: Suite) -> Iterator[Finding]:
    """E04: no two items have the same id."""
    for item_id, count in Counter(item.item_id for item in suite.items).items():
        if count > 1:
            yield _error("E04", f"item {item_id}", f"the id appears {count} times")


def pictures_unchanged(suite: Suite) -> Iterator[Finding]:
    """E05 to E07: every picture is a file inside the suite, has the recorded bytes, and is large enough."""
    users: dict[tuple[str, str], tuple[Item, Side]] = {}
    for item in suite.items:
        for side in _SIDES:
            users.setdefault((item.file_name(side), item.file_sha256(side)), (item, side))
    for item, side in users.values():
        yield from _check_file(item, side)


def _check_file(item: Item, side: Side) -> Iterator[Finding]:
    where, name, path = f"item {item.item_id}", item.file_name(side), item.picture(side)
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        yield _error("E05", where, f"the path {name!r} leaves the suite folder")
    elif not path.is_file():
        yield _error("E05", where, f"picture {name!r} not found")
    else:
        encoded = path.read_bytes()
        yield from _check_bytes(encoded, item, side)
        yield from _check_size(encoded, item, side)


def _check_bytes(encoded: bytes, item: Item, side: Side) -> Iterator[Finding]:
    expected, found = item.file_sha256(side), hashlib.sha256(encoded).hexdigest()
    if found != expected:
        message = f"{side} picture changed on disk (expected {expected[:12]}, found {found[:12]})"
        yield _error("E06", f"item {item.item_id}", message)


def _check_size(encoded: bytes, item: Item, side: Side) -> Iterator[Finding]:
    size = picture_size(encoded)
    if size is None:
        yield _error("E07", f"item {item.item_id}", f"{side} picture cannot be decoded")
    elif min(size) < SMALLEST_PICTURE:
        message = f"{side} picture is {size[0]}×{size[1]}; needs at least {SMALLEST_PICTURE}"
        yield _error("E07", f"item {item.item_id}", message)


def sides_differ(suite: Suite) -> Iterator[Finding]:
    """E08: the two pictures of an item are different ones."""
    for item in suite.items:
        if item.left_pixels_sha256 == item.right_pixels_sha256:
            yield _error("E08", f"item {item.item_id}", "both sides are the same picture")


def concepts_differ(suite: Suite) -> Iterator[Finding]:
    """E11: the wrong picture does not show what is asked for."""
    for item in suite.items:
        if item.target_concept == item.distractor_concept:
            message = f"target and distractor concept are both {item.target_concept!r}"
            yield _error("E11", f"item {item.item_id}", message)


def groups_closed(suite: Suite) -> Iterator[Finding]:
    """E12: items that share a picture or are twins are in the same group."""
    first_with: dict[str, Item] = {}
    for item in suite.items:
        for tie in ties(item):
            first = first_with.setdefault(tie, item)
            if first.group_id != item.group_id:
                message = f"share {tie} but have groups {first.group_id}, {item.group_id}"
                yield _error("E12", f"items {first.item_id} and {item.item_id}", message)


def card_agrees(suite: Suite) -> Iterator[Finding]:
    """E13: the counts and the content hash of the items are those of `suite.json`."""
    said = suite.card["counts"], suite.card["content_sha256"]
    found = count_by_category(suite.items), suite.content_sha256
    for what, expected, given in zip(("count per category", "content hash"), said, found, strict=True):
        if expected != given:
            yield _error("E13", "suite.json", f"{what} differs: it says {expected}, items give {given}")


LOADING_RULES: Sequence[Callable[[Suite], Iterator[Finding]]] = (
    unique_ids,
    pictures_unchanged,
    sides_differ,
    concepts_differ,
    groups_closed,
    card_agrees,
)
