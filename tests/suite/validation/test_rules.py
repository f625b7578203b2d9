import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import SuiteError
from probe_kit.suite import Suite, load_suite
from probe_kit.suite.pictures import decode_picture
from probe_kit.suite.rules import Finding, listing
from tests.support.changed_suites import save_changed

Record = dict[str, Any]
EditRecords = Callable[[Callable[[list[Record]], None]], Any]


def set_field(name: str, value: Any) -> Callable[[list[Record]], None]:
    """Gives the first record another value."""

    def change(records: list[Record]) -> None:
        records[0][name] = value

    return change


def say(phrase: str) -> Callable[[list[Record]], None]:
    """Asks the first record for something else."""

    def change(records: list[Record]) -> None:
        records[0] |= {"object_phrase": phrase, "instruction": f"Put the cube on the {phrase}"}

    return change


def drop_field(records: list[Record]) -> None:
    del records[0]["pair_id"]


def repeat_id(records: list[Record]) -> None:
    records[1]["item_id"] = records[0]["item_id"]


def show_one_picture_twice(records: list[Record]) -> None:
    records[0]["right_pixels_sha256"] = records[0]["left_pixels_sha256"]


def ask_for_both(records: list[Record]) -> None:
    records[0]["distractor_concept"] = records[0]["target_concept"]


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (drop_field, r"E02 metadata.jsonl:1: field 'pair_id' is missing"),
        (set_field("gen", "none"), r"E02 metadata.jsonl:1: field 'gen' is 'none'; expected a dict"),
        (set_field("correct_side", "centre"), r"E02 .*'correct_side' is 'centre'; expected one of left, right"),
        (set_field("category", "My colours"), r"E02 .*'category' is 'My colours'; expected one like 'ripe-fruit'"),
        (set_field("schema_version", "2.0"), r"E03 metadata.jsonl:1: uses schema 2.0; this tool reads 1.x"),
        (repeat_id, r"E04 item a2a-embedded-color-\w+: the id appears in lines 1 and 2"),
        (set_field("left_file_name", "images/no.png"), r"E05 item .*: picture 'images/no.png' not found"),
        (set_field("left_file_name", "../x.png"), r"E05 item .*: the path '../x.png' leaves the suite folder"),
        (set_field("left_file_name", "/x.png"), r"E05 item .*: the path '/x.png' leaves the suite folder"),
        (set_field("left_sha256", "ab" * 32), r"E06 .*left picture changed.*expected abababababab, found"),
        (show_one_picture_twice, r"E08 item .*: both sides are the same picture"),
        (ask_for_both, r"E11 item .*: target and distractor concept are both '\w+'"),
        (set_field("instruction", "Put the cube on me"), r"E09 item .*does not contain the object phrase"),
        (set_field("object_phrase", ""), r"E09 item .*does not contain the object phrase ''"),
        (say("red shape."), r"E09 item .*ends with a period"),
        (say("red\nshape"), r"E09 item .*more than one line"),
        (say("very " * 12 + "red shape"), r"E09 item .*has 19 words \(limit 12\)"),
        (say("x" * 80), r"E09 item .*has 100 characters \(limit 80\)"),
        (say("left shape"), r"E10 item .*names a side \('left'\)"),
        (set_field("license", " "), r"E14 item .*: licence missing"),
        (set_field("license", "LicenseRef-x"), r"E14 item .*marked redistributable"),
        (set_field("contains_real_face", True), r"E15 item .*suite.json says there are none"),
        (set_field("group_id", "g-other"), r"E12 items .* share picture \w+ but have groups g-other, g-"),
        (list.pop, r"E13 suite.json: count per category differs: .*'shape': 12.*'shape': 11"),
        (set_field("instruction", "Put the cube on me"), r"E13 suite.json: content hash differs"),
    ],
)
def test_each_rule_finds_its_violation(edit_records: EditRecords, change: Any, finding: str) -> None:
    folder = edit_records(change)
    with pytest.raises(SuiteError, match=finding):
        load_suite(folder)


def test_an_untouched_copy_passes_all_rules(edit_records: EditRecords) -> None:
    folder = edit_records(lambda _: None)
    assert len(load_suite(folder).items) == 24


def test_fields_of_a_later_minor_schema_are_left_out(small_suite: Suite, tmp_path: Path) -> None:
    first, *others = small_suite.items
    later = replace(small_suite, items=(replace(first, schema_version="1.7"), *others))
    folder = save_changed(later, tmp_path / "later").folder
    lines = (folder / "items" / "metadata.jsonl").read_text(encoding="utf-8").splitlines()
    lines[0] = json.dumps(json.loads(lines[0]) | {"mood": "sunny"})
    (folder / "items" / "metadata.jsonl").write_text("\n".join(lines), encoding="utf-8")
    assert load_suite(folder).items[0].schema_version == "1.7"


@pytest.mark.parametrize("field", ["schema_version", "pair_id"])
def test_what_stands_in_the_hash_cannot_be_changed_unseen(field: str, edit_records: EditRecords) -> None:
    with pytest.raises(SuiteError, match=r"E13 suite\.json: content hash differs"):
        load_suite(edit_records(set_field(field, "1.7")))


@pytest.mark.parametrize(("field", "value"), [("name", "mine"), ("version", "9.9.9"), ("schema_version", "1.7")])
def test_what_the_card_names_cannot_be_changed_unseen(field: str, value: str, edit_records: EditRecords) -> None:
    folder = edit_records(lambda _: None)
    card = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
    (folder / "suite.json").write_text(json.dumps(card | {field: value}), encoding="utf-8")
    with pytest.raises(SuiteError, match=r"E13 suite\.json: content hash differs"):
        load_suite(folder)


def test_all_findings_are_reported_at_once(edit_records: EditRecords) -> None:
    def change(records: list[Record]) -> None:
        ask_for_both(records)
        records[3]["left_file_name"] = "images/no.png"

    with pytest.raises(SuiteError) as caught:
        load_suite(edit_records(change))
    assert all(rule in str(caught.value) for rule in ("E05", "E11", "E13"))


def test_a_report_holds_at_most_twenty_findings_of_a_rule() -> None:
    findings = [Finding("E06", "error", f"item {n}", "changed") for n in range(23)]
    findings.append(Finding("E05", "error", "item x", "not found"))
    lines = listing(findings).splitlines()
    assert lines[0] == "E05 item x: not found"
    assert len(lines) == 1 + 20 + 1
    assert lines[-1] == "E06: and 3 more"


def test_a_picture_may_not_be_a_link_that_leaves_the_suite(edit_records: EditRecords, tmp_path: Path) -> None:
    folder = edit_records(lambda _: None)
    picture = next(folder.glob("items/images/*/*.png"))
    picture.rename(tmp_path / "elsewhere.png")
    picture.symlink_to(tmp_path / "elsewhere.png")
    with pytest.raises(SuiteError, match=r"E05 item .* is a link that leaves the suite folder"):
        load_suite(folder)


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (
            set_field("item_id", "a\x1b[31m"),
            r"E02 .*'item_id' holds characters that cannot be printed \('a␛\[31m'\)",
        ),
        (set_field("item_id", "two\nlines"), r"E02 .*'item_id' holds characters"),
        (set_field("attribution", "user\u202egnp"), r"E02 .*'attribution' holds characters"),
        (set_field("attribution", "x" * 5000), r"E02 .*'attribution' has 5000 characters; expected at most 4096"),
        (set_field("left_file_name", "images/" + "a" * 5000), r"E02 .*'left_file_name' has 5007 characters"),
        (set_field("instruction", "half \ud800"), r"E01 .*half a surrogate pair"),
    ],
)
def test_text_that_no_terminal_or_file_system_should_meet_is_refused(
    edit_records: EditRecords, change: Any, finding: str
) -> None:
    with pytest.raises(SuiteError, match=finding):
        load_suite(edit_records(change))


@pytest.mark.parametrize("name", ["suite.json", "items/metadata.jsonl"])
@pytest.mark.parametrize(
    "content", [b"[" * 100_000, b'{"a":' * 100_000, b"\xed\xa0\x80", b"9" * 5000, b"\xff\xfe"]
)
def test_json_that_is_none_is_a_finding(edit_records: EditRecords, name: str, content: bytes) -> None:
    folder = edit_records(lambda _: None)
    (folder / name).write_bytes(content)
    with pytest.raises(SuiteError, match="E01"):
        load_suite(folder)


def test_a_picture_that_fills_all_memory_once_decoded_is_refused(edit_records: EditRecords) -> None:
    bomb = png_bomb(12_000)
    folder = edit_records(set_field("left_sha256", sha256(bomb).hexdigest()))
    record = json.loads((folder / "items/metadata.jsonl").read_text(encoding="utf-8").splitlines()[0])
    (folder / "items" / record["left_file_name"]).write_bytes(bomb)
    with pytest.raises(SuiteError, match=r"E07 item .*left picture is 12000×12000; at most 8192 are read"):
        load_suite(folder)
    with pytest.raises(SuiteError, match="claims to be 12000×12000"):
        decode_picture(folder / "items" / record["left_file_name"])


def png_bomb(side: int) -> bytes:
    """A PNG of a few bytes that claims a size."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(b""))]
    chunks = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in parts
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
