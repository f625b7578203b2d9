"""What items are enough for, and how many would be, is known before any work."""

import json
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import SuiteError, UsageError
from probe_kit.statistics.significance import detectable
from probe_kit.statistics.sufficiency import (
    GROUPS_FOR_PROBES,
    groups_for_absence,
    groups_for_interventions,
    groups_for_not_used,
    groups_for_signal,
)
from probe_kit.suite import Suite, build_suite, load_suite, validate_suite
from probe_kit.suite.pictures import decode_picture, encode_png
from probe_kit.suite.rules import Finding, listing
from probe_kit.suite.sufficiency import Smallest, Sufficiency, sufficiencies
from probe_kit.suite.suite import count_by_category
from probe_kit.suite.validate import FEWEST_ITEMS
from tests.support.changed_suites import save_changed

Record = dict[str, Any]
EditRecords = Callable[[Callable[[list[Record]], None]], Path]


def rules(folder: Path) -> set[str]:
    return {finding.rule for finding in validate_suite(folder).findings}


@pytest.mark.slow
def test_the_embedded_suite_is_valid(tmp_path: Path) -> None:
    embedded = build_suite(tmp_path / "embedded", items_per_category=FEWEST_ITEMS)
    report = validate_suite(embedded.folder)
    assert report.ok
    assert report.missing == ("celebrity",)
    assert "Not in this suite: Celebrity." in report.to_text()
    assert report.warnings == ()


def test_a_folder_without_a_suite_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is not a suite"):
        validate_suite(tmp_path)


def test_an_unreadable_card_is_a_finding_not_a_crash(copied: Path) -> None:
    (copied / "suite.json").write_text("{", encoding="utf-8")
    report = validate_suite(copied)
    assert not report.ok
    assert [finding.rule for finding in report.errors] == ["E01"]


def test_the_json_form_holds_every_finding_and_the_text_twenty_of_a_rule(edit_records: EditRecords) -> None:
    def break_all(records: list[Record]) -> None:
        for record in records:
            record["distractor_concept"] = record["target_concept"]

    report = validate_suite(edit_records(break_all))
    content = json.loads(json.dumps(report.to_json()))
    assert content["ok"] is False
    assert sum(finding["rule"] == "E11" for finding in content["findings"]) == 24
    lines = report.to_text().splitlines()
    assert sum(line.startswith("E11 ") for line in lines) == 20
    assert "E11: and 4 more" in lines


def test_pixels_that_no_longer_match_their_record_are_found_by_decoding(edit_records: EditRecords) -> None:
    def change(records: list[Record]) -> None:
        records[0]["left_pixels_sha256"] = "0" * 64

    messages = [str(finding) for finding in validate_suite(edit_records(change)).errors]
    assert any("E06" in message and "left picture has other pixels" in message for message in messages)


def test_answers_that_pile_up_on_one_side_are_warned_of(edit_records: EditRecords) -> None:
    def all_left(records: list[Record]) -> None:
        for record in records:
            record["correct_side"] = "left"

    texts = [str(finding) for finding in validate_suite(edit_records(all_left)).warnings]
    assert "W01 Color: 12 left / 0 right" in texts


def test_a_concept_that_is_almost_always_the_target_is_warned_of(edit_records: EditRecords) -> None:
    def always_red(records: list[Record]) -> None:
        for number, record in enumerate(records[:12]):
            record |= {"target_concept": "red", "distractor_concept": f"other {number}"}

    texts = [str(finding) for finding in validate_suite(edit_records(always_red)).warnings]
    assert "W02 Color: concept 'red' is target 12×, distractor 0×" in texts


def test_fewer_items_than_requested_are_warned_of(edit_records: EditRecords) -> None:
    texts = [str(finding) for finding in validate_suite(edit_records(lambda records: records.pop())).warnings]
    assert "W04 Shape: 11 of 12 requested" in texts


def test_near_duplicates_in_other_groups_are_warned_of_unless_drawn(
    copied: Path, edit_records: EditRecords
) -> None:
    def photographs(records: list[Record]) -> None:
        for record in records:
            record["construction"] = "native_pair"
        records[2]["left_file_name"] = "copy.png"
        (copied / "items" / "copy.png").write_bytes((copied / "items" / records[0]["left_file_name"]).read_bytes())

    assert "W03" in rules(edit_records(photographs))
    assert "W03" not in rules(edit_records(lambda records: [r.update(construction="procedural") for r in records]))


def square(side: int) -> Any:
    """A black square in the middle of a white picture of 128 px."""
    pixels = np.full((128, 128, 3), 255, np.uint8)
    start = 64 - side // 2
    pixels[start : start + side, start : start + side] = 0
    return pixels


@pytest.mark.parametrize(
    ("pixels", "problem"),
    [
        (np.full((128, 128, 3), 200, np.uint8), "has little contrast"),
        (square(12), "shows almost nothing"),
        (square(19), "shows something only "),
    ],
)
def test_validation_warns_of_pictures_that_are_not_legible_in_a_frame(
    copied: Path, edit_records: EditRecords, pixels: Any, problem: str
) -> None:
    (copied / "items" / "faint.png").write_bytes(encode_png(Image.fromarray(pixels)))
    folder = edit_records(lambda records: records[0].update(left_file_name="faint.png"))
    warned = [str(finding) for finding in validate_suite(folder).warnings if finding.rule == "W06"]
    assert len(warned) == 1
    assert problem in warned[0]


def test_a_sign_named_after_a_side_is_listed_and_not_an_error(edit_records: EditRecords) -> None:
    def turn(records: list[Record]) -> None:
        phrase = "no left turn sign"
        records[0] |= {"category": "traffic", "domain": "normative", "side_word": True, "object_phrase": phrase}
        records[0]["instruction"] = f"Put the cube on the {phrase}"

    broken_rules = rules(edit_records(turn))
    assert "W07" in broken_rules
    assert "E10" not in broken_rules


def test_validation_changes_nothing(small_suite: Suite) -> None:
    before = load_suite(small_suite.folder).identity
    validate_suite(small_suite.folder)
    assert load_suite(small_suite.folder).identity == before
    assert not (small_suite.folder / "baselines.json").exists()


def test_validate_says_how_strong_a_leak_must_be_to_be_found(small_suite: Suite) -> None:
    """A baseline that is at chance shows little where it could not have been seen above."""
    result = CliRunner().invoke(app, ["suite", "validate", str(small_suite.folder), "--power", "--json"])
    power = json.loads(result.stdout)["power"]
    counts = count_by_category(small_suite.items)
    assert power == {name: pytest.approx(detectable(count)) for name, count in counts.items()}
    text = CliRunner().invoke(app, ["suite", "validate", str(small_suite.folder), "--power"]).stdout
    assert "a leak is found in 4 of 5 suites" in text


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
    first, *other_items = small_suite.items
    later = replace(small_suite, items=(replace(first, schema_version="1.7"), *other_items))
    folder = save_changed(later, tmp_path / "later").folder
    lines = (folder / "items" / "metadata.jsonl").read_text(encoding="utf-8").splitlines()
    lines[0] = json.dumps(json.loads(lines[0]) | {"mood": "sunny"})
    (folder / "items" / "metadata.jsonl").write_text("\n".join(lines), encoding="utf-8")
    assert load_suite(folder).items[0].schema_version == "1.7"


@pytest.mark.parametrize("field", ["schema_version", "pair_id"])
def test_a_change_of_anything_in_the_content_hash_is_detected(field: str, edit_records: EditRecords) -> None:
    with pytest.raises(SuiteError, match=r"E13 suite\.json: content hash differs"):
        load_suite(edit_records(set_field(field, "1.7")))


@pytest.mark.parametrize(("field", "value"), [("name", "mine"), ("version", "9.9.9"), ("schema_version", "1.7")])
def test_a_changed_entry_of_the_card_is_detected(field: str, value: str, edit_records: EditRecords) -> None:
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


def by_name(suite: Suite, scored: bool = True, probed: bool = True) -> dict[str, Sufficiency]:
    return {sufficiency.name: sufficiency for sufficiency in sufficiencies(suite, scored, probed)}


@pytest.mark.parametrize("items", [2, 6, 8, 10, 12])
def test_every_use_is_enough_exactly_from_its_number_of_groups(items: int, small_suite: Suite) -> None:
    suite = small_suite.select(None, items)
    groups = min(
        len({item.group_id for item in suite.items if item.category == name}) for name in suite.categories
    )
    sufficiency_by_name = by_name(suite)
    assert list(sufficiency_by_name) == [
        "success rate", "probes", "retention", "shown", "absent", "interventions", "not used",
    ]  # fmt: skip
    assert (
        sufficiency_by_name["probes"].enough
        == sufficiency_by_name["retention"].enough
        == (groups >= GROUPS_FOR_PROBES)
    )
    assert sufficiency_by_name["shown"].enough == (groups >= groups_for_signal())
    assert sufficiency_by_name["interventions"].enough == (groups >= groups_for_interventions())
    assert sufficiency_by_name["not used"].enough == (groups >= groups_for_not_used())
    assert sufficiency_by_name["absent"].enough == (groups >= groups_for_absence(round(2 * items / groups)))
    assert sufficiency_by_name["success rate"].enough is (False if items < 4 else None)
    for sufficiency in sufficiency_by_name.values():
        if sufficiency.enough is False and sufficiency.name != "success rate":
            assert sufficiency.words.startswith(f"no, {groups} groups of ")
            assert re.search(r"; (take \d+ (items|or more)|the suite has \d+)$", sufficiency.words)
            assert len(sufficiency.words) < 64  # a line of a terminal of 80 columns


@pytest.mark.parametrize("category", ["color", "shape"])
def test_the_number_of_items_that_would_do_is_the_smallest_that_can_be_selected(
    category: str, small_suite: Suite
) -> None:
    smallest = Smallest.of(small_suite.select([category], 2))
    for groups in range(1, 7):
        items = smallest.items_for(groups)
        if items is None:
            assert Smallest.of(small_suite.select([category])).groups < groups
            continue
        assert Smallest.of(small_suite.select([category], items)).groups >= groups
        if items > 2:
            assert Smallest.of(small_suite.select([category], items - 2)).groups < groups


def test_the_category_with_the_fewest_groups_decides_and_is_named(small_suite: Suite) -> None:
    few = small_suite.select(["shape"], 4).items
    suite = Suite(
        small_suite.name, small_suite.version,
        tuple(item for item in small_suite.items if item.category == "color" or item in few),
        small_suite.folder, small_suite.card,
    )  # fmt: skip
    assert Smallest.of(suite).words.startswith("shape: 4 items in ")


def test_a_use_that_a_run_cannot_have_is_not_mentioned(small_suite: Suite) -> None:
    suite = small_suite.select(None, 4)
    assert list(by_name(suite, probed=False)) == ["success rate"]
    assert next(iter(by_name(suite, scored=False))) == "probes"


def test_the_command_says_it_before_any_work_in_few_lines(small_suite: Suite, tmp_path: Path) -> None:
    command = ["extract", "--model", "idle", "--suite", str(small_suite.folder), "--items", "4", "--dry-run"]
    answer = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "run")])
    assert answer.exit_code == 0, answer.output
    lines = answer.output.splitlines()
    at = next(number for number, line in enumerate(lines) if "enough for" in line)
    assert "4 items in" in lines[at]
    assert "Δ = ± 49.0 points; ± 10 takes 97 items" in lines[at + 1]
    assert len(lines) - at <= 8
    assert not (tmp_path / "run").exists()
