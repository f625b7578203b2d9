import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.statistics.significance import detectable
from probe_kit.suite import Suite, load_suite, validate_suite
from probe_kit.suite.pictures import encode_png
from probe_kit.suite.suite import count_by_category

Record = dict[str, Any]
EditRecords = Callable[[Callable[[list[Record]], None]], Path]


def rules(folder: Path) -> set[str]:
    return {finding.rule for finding in validate_suite(folder).findings}


@pytest.mark.slow
def test_the_embedded_suite_is_valid(embedded: Suite) -> None:
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
def test_what_cannot_be_seen_on_the_screen_is_warned_of(
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

    found = rules(edit_records(turn))
    assert "W07" in found
    assert "E10" not in found


def test_validation_changes_nothing(small_suite: Suite) -> None:
    before = load_suite(small_suite.folder).identity
    validate_suite(small_suite.folder)
    assert load_suite(small_suite.folder).identity == before
    assert not (small_suite.folder / "baselines.json").exists()


def test_validate_says_how_strong_a_leak_must_be_to_be_found(small_suite: Suite) -> None:
    """A baseline that is at chance shows little where it could not have been seen above."""
    found = CliRunner().invoke(app, ["suite", "validate", str(small_suite.folder), "--power", "--json"])
    power = json.loads(found.stdout)["power"]
    counts = count_by_category(small_suite.items)
    assert power == {name: pytest.approx(detectable(count)) for name, count in counts.items()}
    text = CliRunner().invoke(app, ["suite", "validate", str(small_suite.folder), "--power"]).stdout
    assert "a leak is found in 4 of 5 suites" in text
