"""Rules E01 to E15: the lines of `metadata.jsonl`, the card, every item, and the suite as a whole.

E01 to E04 check records before items are made of them. Every other rule has one shape, a Suite in and findings
out. Those in `LOADING_RULES` run each time a suite is opened; they are fast, because pictures are hashed but not
decoded. `DECODING_RULES` run in `validate_suite`.
"""

import hashlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from itertools import groupby
from math import isfinite
from operator import attrgetter
from pathlib import PurePosixPath
from typing import Any, Literal
from unicodedata import is_normalized

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit._system.escaping import terminal_safe
from probe_kit.errors import SuiteError
from probe_kit.suite.categories import CATEGORIES, OWN_DOMAIN, is_slug
from probe_kit.suite.items import MOST_CHARACTERS, MOST_WORDS, VERBATIM, WORDINGS, Item, Side, side_words, ties
from probe_kit.suite.pictures import LARGEST_PICTURE, decode_picture, picture_size, pixels_sha256
from probe_kit.suite.suite import Suite, count_by_category

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
    """Make a finding that makes the suite unusable."""
    return Finding(rule, "error", where, message)


def warning(rule: str, where: str, message: str) -> Finding:
    """Make a finding with which results are still valid, if it is known."""
    return Finding(rule, "warning", where, message)


def listing(findings: Iterable[Finding]) -> str:
    """Return the findings as lines sorted by rule, at most 20 of each rule and then how many more there are."""
    lines = []
    for rule, same_rule in groupby(sorted(findings, key=attrgetter("rule")), key=attrgetter("rule")):
        lines_of_rule = [str(finding) for finding in same_rule]
        lines += lines_of_rule[:PRINTED_PER_RULE]
        if len(lines_of_rule) > PRINTED_PER_RULE:
            lines.append(f"{rule}: and {len(lines_of_rule) - PRINTED_PER_RULE} more")
    return "\n".join(lines)


# -- records -----------------------------------------------------------------------------------------------------


SCHEMA_MAJOR = "1"
LONGEST_FIELD = 4096
"""Most characters of any text in a record; only an attribution comes near."""
LONGEST_NAME = 255
"""Most bytes of a file name or id, as in file systems."""
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
    """Check E01: return the JSON object on one line, or why there is none."""
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
    """Check E02 for `suite.json`: it has the fields that identify a suite."""
    for name, expected in _CARD_TYPES.items():
        if not isinstance(card.get(name), expected):
            yield error(
                "E02", "suite.json", f"field {name!r} is {card.get(name)!r}; expected a {expected.__name__}"
            )
        elif expected is str:
            yield from _check_text("item_id", card[name], "suite.json")


def check_record(record: dict[str, Any], where: str) -> Iterator[Finding]:
    """Check E02: every field is present, has its type, and has one of its allowed values."""
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
    """Check E02: no text is endless, contains terminal control characters, or looks like other bytes.

    A text in decomposed characters looks like the same text in Unicode's form NFC.
    """
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
    """Check E03: the record follows a schema that this tool can read."""
    version = str(record.get("schema_version", "none"))
    if version.split(".")[0] != SCHEMA_MAJOR:
        yield error("E03", where, f"uses schema {terminal_safe(version[:80])}; this tool reads {SCHEMA_MAJOR}.x")


def unique_ids(lines_of: Mapping[str, Sequence[int]]) -> Iterator[Finding]:
    """Check E04: no two items have one id; `lines_of` are the line numbers of each."""
    for item_id, lines in lines_of.items():
        if len(lines) > 1:
            listed = ", ".join(map(str, lines[:-1]))
            yield error("E04", f"item {item_id}", f"the id appears in lines {listed} and {lines[-1]}")


# -- items and the suite -----------------------------------------------------------------------------------------


SMALLEST_PICTURE = 64
MOST_PICTURE_BYTES = 64 << 20
"""Most bytes of a picture's file; a photograph of the largest size has a tenth of it."""
MOST_PIXELS = 1 << 37
"""Most pixels of all pictures of a suite: 2,048 of the largest size, or 200,000 of 800 × 800.

They take half a day to decode.
"""
SIGN_CATEGORIES = ("traffic", "public-info")  # a sign may be named after a side
SIDES: tuple[Side, Side] = ("left", "right")


def pictures_unchanged(suite: Suite) -> Iterator[Finding]:
    """Check E05 to E07: every picture is a file inside the suite, has the recorded bytes, and is large enough.

    All pictures together have at most `MOST_PIXELS`.
    """
    users: dict[tuple[str, str], tuple[Item, Side]] = {}
    for item in suite.items:
        for side in SIDES:
            users.setdefault((item.file_name(side), item.file_sha256(side)), (item, side))
    pixels = 0
    for item, side in users.values():
        pixels += yield from _check_file(item, side)
    if pixels > MOST_PIXELS:
        yield error("E07", "the pictures", f"have {pixels:,} pixels together; at most {MOST_PIXELS:,} are read")


def _check_file(item: Item, side: Side) -> Generator[Finding, None, int]:
    """Yield what is wrong with a picture's file, and return the pixels that its header states."""
    where, name, path = f"item {item.item_id}", item.file_name(side), item.picture(side)
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        yield error("E05", where, f"the path {name!r} leaves the suite folder")
    elif not path.is_file():
        yield error("E05", where, f"picture {name!r} not found")
    elif not path.resolve().is_relative_to(item.folder.resolve()):
        yield error("E05", where, f"picture {name!r} is a link that leaves the suite folder; copy the file there")
    elif (size := path.stat().st_size) > MOST_PICTURE_BYTES:
        most = f"expected at most {MOST_PICTURE_BYTES >> 20} MiB"
        yield error("E07", where, f"picture {name!r} has {size / 1e6:,.0f} MB; {most}")
    else:
        encoded = read_regular(path)
        expected, actual = item.file_sha256(side), hashlib.sha256(encoded).hexdigest()
        if actual != expected:
            message = f"{side} picture changed on disk (expected {expected[:12]}, found {actual[:12]})"
            yield error("E06", where, message)
        return (yield from _check_size(encoded, item, side))
    return 0


def _check_size(encoded: bytes, item: Item, side: Side) -> Generator[Finding, None, int]:
    size = picture_size(encoded)
    if size is None:
        yield error("E07", f"item {item.item_id}", f"{side} picture cannot be decoded")
        return 0
    if min(size) < SMALLEST_PICTURE:
        message = f"{side} picture is {size[0]}×{size[1]}; needs at least {SMALLEST_PICTURE}"
        yield error("E07", f"item {item.item_id}", message)
    elif max(size) > LARGEST_PICTURE:
        message = f"{side} picture is {size[0]}×{size[1]}; at most {LARGEST_PICTURE} are read"
        yield error("E07", f"item {item.item_id}", message)
    return size[0] * size[1]


def sides_differ(suite: Suite) -> Iterator[Finding]:
    """Check E08: the two pictures of an item are different."""
    for item in suite.items:
        if item.left_pixels_sha256 == item.right_pixels_sha256:
            yield error("E08", f"item {item.item_id}", "both sides are the same picture")


def instruction_names_object(suite: Suite) -> Iterator[Finding]:
    """Check E09: the instruction is one short line without a full stop that contains the object phrase.

    A source's own instruction may be long.
    """
    for item in suite.items:
        words = len(item.instruction.split())
        problems = {
            f"the instruction does not contain the object phrase {item.object_phrase!r}": (
                not item.object_phrase or item.object_phrase not in item.instruction
            ),
            "the instruction has more than one line": len(item.instruction.splitlines()) != 1,
        }
        style = {
            "the instruction ends with a period": item.instruction.endswith("."),
            f"the instruction has {words} words (limit {MOST_WORDS})": words > MOST_WORDS,
            f"the instruction has {len(item.instruction)} characters (limit {MOST_CHARACTERS})": (
                len(item.instruction) > MOST_CHARACTERS
            ),
        }
        for message, present in {**problems, **({} if item.rule_id == VERBATIM else style)}.items():
            if present:
                yield error("E09", f"item {item.item_id}", message)


def no_side_words(suite: Suite) -> Iterator[Finding]:
    """Check E10: no side is named, except by signs and a source's own questions marked `side_word`.

    W07 lists those.
    """
    for item in suite.items:
        if item.side_word and item.rule_id == VERBATIM:
            continue
        outside = item.instruction.replace(item.object_phrase, " ")
        exempt = item.side_word and item.category in SIGN_CATEGORIES
        sides = side_words(outside) or (() if exempt else side_words(item.object_phrase))
        if sides:
            yield error("E10", f"item {item.item_id}", f"the instruction names a side ({sides[0]!r})")
        for wording in ("named", "neutral"):
            if not item.side_word and (named_sides := side_words(item.wordings.get(wording, ""))):
                yield error(
                    "E10", f"item {item.item_id}", f"its wording {wording!r} names a side ({named_sides[0]!r})"
                )


def concepts_differ(suite: Suite) -> Iterator[Finding]:
    """Check E11: the wrong picture does not show the requested concept."""
    for item in suite.items:
        if item.target_concept == item.distractor_concept:
            message = f"target and distractor concept are both {item.target_concept!r}"
            yield error("E11", f"item {item.item_id}", message)


def groups_closed(suite: Suite) -> Iterator[Finding]:
    """Check E12: items that share a picture or are twins are in the same group."""
    first_with: dict[str, Item] = {}
    for item in suite.items:
        for tie in ties(item):
            first = first_with.setdefault(tie, item)
            if first.group_id != item.group_id:
                message = f"share {tie} but have groups {first.group_id}, {item.group_id}"
                yield error("E12", f"items {first.item_id} and {item.item_id}", message)


def card_agrees(suite: Suite) -> Iterator[Finding]:
    """Check E13: counts, and the hash of name, version and items, are those of `suite.json`."""
    recorded = suite.card["counts"], suite.card["content_sha256"]
    counted = count_by_category(suite.items), suite.content_sha256
    for what, expected, actual in zip(("count per category", "content hash"), recorded, counted, strict=True):
        if expected != actual:
            yield error("E13", "suite.json", f"{what} differs: it says {expected}, items give {actual}")


def license_present(suite: Suite) -> Iterator[Finding]:
    """Check E14: every item has a licence, and a licence that forbids passing pictures on is marked so."""
    for item in suite.items:
        if not item.license.strip():
            yield error("E14", f"item {item.item_id}", "licence missing")
        elif item.redistributable and item.license.startswith("LicenseRef-"):
            message = f"marked redistributable, but {item.license!r} is no licence known to allow that"
            yield error("E14", f"item {item.item_id}", message)


def real_faces_declared(suite: Suite) -> Iterator[Finding]:
    """Check E15: the card says whether there are pictures of real people."""
    declared = bool(suite.card.get("contains_real_faces", False))
    with_face = [item.item_id for item in suite.items if item.contains_real_face]
    if with_face and not declared:
        yield error("E15", f"item {with_face[0]}", "contains_real_face is true but suite.json says there are none")
    if declared and not with_face:
        yield error("E15", "suite.json", "contains_real_faces is true but no item has a real face")


LOADING_RULES: Sequence[Callable[[Suite], Iterator[Finding]]] = (
    pictures_unchanged,
    sides_differ,
    instruction_names_object,
    no_side_words,
    concepts_differ,
    groups_closed,
    card_agrees,
    license_present,
    real_faces_declared,
)


def pixels_as_recorded(suite: Suite) -> Iterator[Finding]:
    """Check E07: every picture decodes; and E06: it decodes to the recorded pixels."""
    checked: set[tuple[str, str]] = set()
    for item in suite.items:
        recorded = {"left": item.left_pixels_sha256, "right": item.right_pixels_sha256}
        for side in SIDES:
            name = item.file_name(side)
            if (name, recorded[side]) in checked or not item.picture(side).is_file():
                continue
            checked.add((name, recorded[side]))
            try:
                actual = pixels_sha256(decode_picture(item.picture(side)))
            except SuiteError as problem:
                yield error("E07", f"item {item.item_id}", f"{side} picture cannot be decoded ({problem})")
                continue
            if actual != recorded[side]:
                message = f"{side} picture has other pixels (expected {recorded[side][:12]}, found {actual[:12]})"
                yield error("E06", f"item {item.item_id}", message)


DECODING_RULES: Sequence[Callable[[Suite], Iterator[Finding]]] = (pixels_as_recorded,)
