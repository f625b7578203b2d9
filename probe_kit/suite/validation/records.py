"""Findings, and E01 to E04: the lines of `metadata.jsonl` and the card, before items are made of them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from itertools import groupby
from math import isfinite
from operator import attrgetter
from typing import Any, Literal
from unicodedata import is_normalized

from probe_kit._system.bounded_json import parse_json
from probe_kit._terminal.plain_text import terminal_safe
from probe_kit.suite.categories import CATEGORIES, OWN_DOMAIN, is_slug
from probe_kit.suite.items import Item
from probe_kit.suite.wording import WORDINGS

PRINTED_PER_RULE = 20


@dataclass(frozen=True)
class Finding:
    """One violation of one rule; errors make a suite unusable, warnings do not."""

    rule: str
    severity: Literal["error", "warning"]
    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.rule} {self.where}: {self.message}"


def error(rule: str, where: str, message: str) -> Finding:
    """A finding that makes the suite unusable."""
    return Finding(rule, "error", where, message)


def warning(rule: str, where: str, message: str) -> Finding:
    """A finding that results survive, if one knows of it."""
    return Finding(rule, "warning", where, message)


def listing(findings: Iterable[Finding]) -> str:
    """The findings as lines sorted by rule, at most 20 of each rule and then how many more there are."""
    lines = []
    for rule, same_rule in groupby(sorted(findings, key=attrgetter("rule")), key=attrgetter("rule")):
        lines_of_rule = [str(finding) for finding in same_rule]
        lines += lines_of_rule[:PRINTED_PER_RULE]
        if len(lines_of_rule) > PRINTED_PER_RULE:
            lines.append(f"{rule}: and {len(lines_of_rule) - PRINTED_PER_RULE} more")
    return "\n".join(lines)


SCHEMA_MAJOR = "1"
LONGEST_FIELD = 4096
"""Characters of any text in a record; only an attribution comes anywhere near."""
LONGEST_NAME = 255
"""Bytes of a file name or id, as file systems have it."""
_NAMES = ("item_id", "left_file_name", "right_file_name", "group_id", "pair_id")

_ENUMS: dict[str, tuple[str, ...]] = {
    "domain": (*dict.fromkeys(category.domain for category in CATEGORIES.values()), OWN_DOMAIN),
    "transfer_type": ("near", "moderate", "heavy", "procedural"),
    "construction": ("native_pair", "choice_vs_distractor", "cross_item", "recolored", "procedural"),
    "object_article": ("the", "none"),
    "polarity": ("pos", "neg", "none"),
    "correct_side": ("left", "right"),
    "curation_status": ("rules-only", "accepted", "edited", "llm-trusted"),
    "split": ("eval", "dev", "train"),
}
_TYPES: dict[str, type] = {"source": dict, "gen": dict, "redistributable": bool, "contains_real_face": bool}
_CARD_TYPES: dict[str, type] = {"name": str, "version": str, "counts": dict, "content_sha256": str}
_REQUIRED = [f.name for f in fields(Item) if f.default is MISSING and f.default_factory is MISSING]


def parse_line(line: bytes, where: str) -> dict[str, Any] | Finding:
    """E01: the JSON object on one line, or why it is none."""
    try:
        record = parse_json(line)
    except ValueError as problem:
        return error("E01", where, f"not valid JSON ({problem})")
    if not isinstance(record, dict):
        return error("E01", where, f"a JSON {type(record).__name__}; expected an object")
    if not _is_finite(record):
        return error("E01", where, "a number in it is NaN, infinite or beyond float range")
    return record


def _is_finite(value: object) -> bool:
    if isinstance(value, dict | list):
        return all(map(_is_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or isfinite(value)


def check_card(card: dict[str, Any]) -> Iterator[Finding]:
    """E02 for `suite.json`: it holds what identifies a suite."""
    for name, expected in _CARD_TYPES.items():
        if not isinstance(card.get(name), expected):
            yield error(
                "E02", "suite.json", f"field {name!r} is {card.get(name)!r}; expected a {expected.__name__}"
            )
        elif expected is str:
            yield from _check_text("item_id", card[name], "suite.json")


def check_record(record: dict[str, Any], where: str) -> Iterator[Finding]:
    """E02: every field is there, has its type, and is one of the values it may have."""
    for name in _REQUIRED:
        expected = _TYPES.get(name, str)
        if name not in record:
            yield error("E02", where, f"field {name!r} is missing")
        elif not isinstance(record[name], expected):
            yield error("E02", where, f"field {name!r} is {record[name]!r}; expected a {expected.__name__}")
        elif name in _ENUMS and record[name] not in _ENUMS[name]:
            allowed = ", ".join(_ENUMS[name])
            yield error("E02", where, f"field {name!r} is {record[name]!r}; expected one of {allowed}")
        elif name == "category" and not is_slug(record[name]):
            yield error("E02", where, f"field 'category' is {record[name]!r}; expected one like 'ripe-fruit'")
        elif isinstance(record[name], str):
            yield from _check_text(name, record[name], where)
    yield from _check_wordings(record.get("wordings", {}), where)


def _check_wordings(wordings: object, where: str) -> Iterator[Finding]:
    expected = f"texts by name: {', '.join(WORDINGS[1:])}"
    if not isinstance(wordings, dict):
        yield error("E02", where, f"field 'wordings' is {wordings!r}; expected {expected}")
        return
    for name, text in wordings.items():
        if name not in WORDINGS[1:] or not isinstance(text, str) or not text.strip():
            yield error("E02", where, f"wording {name!r} is {text!r}; expected {expected}")
        elif (name == "side") != ("{side}" in text):
            yield error("E02", where, f"wording {name!r} is {text!r}; 'side' alone contains '{{side}}', and must")
        else:
            yield from _check_text(f"wordings.{name}", text, where)


def _check_text(name: str, text: str, where: str) -> Iterator[Finding]:
    """E02: no text is endless, holds what a terminal would obey, or looks like another that is other bytes."""
    longest = LONGEST_NAME if name in _NAMES else LONGEST_FIELD
    if len(text.encode(errors="replace")) > longest:
        yield error("E02", where, f"field {name!r} has {len(text)} characters; expected at most {longest}")
    elif terminal_safe(text) != text or (name in _NAMES and not text.isprintable()):
        printable = terminal_safe(text[:80])
        yield error("E02", where, f"field {name!r} holds characters that cannot be printed ({printable!r})")
    elif not is_normalized("NFC", text):
        advice = "write it in Unicode's form NFC, which looks the same and is other bytes to a model"
        yield error("E02", where, f"field {name!r} is {text[:80]!r} in decomposed characters; {advice}")


def check_schema(record: dict[str, Any], where: str) -> Iterator[Finding]:
    """E03: the record follows a schema this tool can read."""
    version = str(record.get("schema_version", "none"))
    if version.split(".")[0] != SCHEMA_MAJOR:
        yield error("E03", where, f"uses schema {terminal_safe(version[:80])}; this tool reads {SCHEMA_MAJOR}.x")


def unique_ids(lines_of: Mapping[str, Sequence[int]]) -> Iterator[Finding]:
    """E04: no id is that of two items; `lines_of` holds the line numbers of each."""
    for item_id, lines in lines_of.items():
        if len(lines) > 1:
            listed = ", ".join(map(str, lines[:-1]))
            yield error("E04", f"item {item_id}", f"the id appears in lines {listed} and {lines[-1]}")
