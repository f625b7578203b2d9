import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from probe_kit.errors import SuiteError
from probe_kit.suite import Suite
from probe_kit.suite.converters import convert
from probe_kit.suite.converters.curation import read_curation
from tests.suite.converters.conftest import write_compbench

Rows = list[dict[str, Any]]


@pytest.fixture(scope="module")
def pending(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A curation file for all pairs."""
    folder = tmp_path_factory.mktemp("pending")
    path = folder / "review.jsonl"
    convert("mllm-compbench", write_compbench(folder / "compbench"), folder / "unreviewed", emit_curation=path)
    return path.read_text(encoding="utf-8")


@pytest.fixture
def review(pending: str, compbench_root: Path, tmp_path: Path) -> Callable[[Callable[[Rows], None]], Suite]:
    """Lets `change` edit the rows of the curation file, and converts with it."""

    def run(change: Callable[[Rows], None]) -> Suite:
        path = tmp_path / "review.jsonl"
        rows = [json.loads(line) for line in pending.splitlines()]
        change(rows)
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        return convert("mllm-compbench", compbench_root, tmp_path / "reviewed", curation=path)

    return run


def accept_first(rows: Rows) -> None:
    rows[0]["status"] = "accept"


def test_only_what_a_person_accepted_is_emitted(review: Callable[[Callable[[Rows], None]], Suite]) -> None:
    suite = review(accept_first)
    assert [item.curation_status for item in suite.items] == ["accepted"]
    assert suite.card["curation"] == ["accepted"]
    assert len(suite.card["curation_sha256"]) == 64


def test_an_edited_wording_replaces_the_proposed_one(review: Callable[[Callable[[Rows], None]], Suite]) -> None:
    def reword(rows: Rows) -> None:
        (row,) = [row for row in rows if row["rule_id"] == "R0"]
        row |= {"status": "edited", "object_phrase": "red sky", "instruction": "Put the cube on the red sky"}

    (item,) = review(reword).items
    assert (item.object_phrase, item.curation_status, item.rule_id) == ("red sky", "edited", "R0")


def test_rejected_and_unrecognisable_ones_are_left_out(review: Callable[[Callable[[Rows], None]], Suite]) -> None:
    def judge(rows: Rows) -> None:
        accept_first(rows)
        rows[1]["status"] = "reject"
        rows[2] |= {"status": "accept", "recognisable": "no"}

    assert len(review(judge).items) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"candidate_id": "emotion-unknown", "status": "accept"}, "1 unknown ids, such as emotion-unknown"),
        ({"question_sha256": "0" * 64, "status": "accept"}, "1 stale rows, such as"),
        ({"status": "yes"}, "line 1 .*status is 'yes'; expected one of pending"),
        ({"status": ""}, "line 1 has no status"),
        ({"status": "edited", "instruction": "Take the cube"}, "do not fit; expected 'Put the cube on the"),
    ],
)
def test_a_row_that_cannot_be_applied_is_named(
    review: Callable[[Callable[[Rows], None]], Suite], change: dict[str, str], message: str
) -> None:
    with pytest.raises(SuiteError, match=message):
        review(lambda rows: rows[0].update(change))


def test_accepting_a_question_without_wording_is_refused(
    review: Callable[[Callable[[Rows], None]], Suite],
) -> None:
    def accept_unworded(rows: Rows) -> None:
        (row,) = [row for row in rows if row["rule_id"] == "R0"]
        row["status"] = "accept"

    with pytest.raises(SuiteError, match="is accepted but has no instruction"):
        review(accept_unworded)


@pytest.mark.slow
def test_every_row_names_its_previews(compbench_root: Path, tmp_path: Path) -> None:
    path = tmp_path / "review.jsonl"
    convert("mllm-compbench", compbench_root, tmp_path / "suite", emit_curation=path)
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert rows
    for row in rows:
        for name in (row["left_preview"], row["right_preview"]):
            with Image.open(tmp_path / name) as preview:
                assert max(preview.size) <= 160


@pytest.mark.slow
def test_a_spreadsheet_does_as_well(compbench_root: Path, tmp_path: Path) -> None:
    path = tmp_path / "review.csv"
    convert("mllm-compbench", compbench_root, tmp_path / "unreviewed", emit_curation=path)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    rows[0]["status"] = "accept"
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, rows[0].keys())
        table.writeheader()
        table.writerows(rows)
    assert len(convert("mllm-compbench", compbench_root, tmp_path / "reviewed", curation=path).items) == 1


@pytest.mark.slow
def test_pairs_that_wait_for_a_person_are_written_out_even_if_no_item_is(okvqa_root: Path, tmp_path: Path) -> None:
    path = tmp_path / "review.jsonl"
    with pytest.raises(SuiteError, match="no item left to write"):
        convert("ok-vqa", okvqa_root, tmp_path / "suite", emit_curation=path)
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    path.write_text("".join(json.dumps(row | {"status": "accept"}) + "\n" for row in rows), encoding="utf-8")
    suite = convert("ok-vqa", okvqa_root, tmp_path / "suite", curation=path)
    assert len(suite.items) == len(rows) == 6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["review.jsonl", "review.csv"])
def test_a_review_is_not_written_over(name: str, compbench_root: Path, tmp_path: Path) -> None:
    path = tmp_path / name
    for _ in range(2):  # no pair is reviewed so far
        convert("mllm-compbench", compbench_root, tmp_path / "suite", emit_curation=path)
    reviewed = path.read_text(encoding="utf-8").replace("pending", "accept", 1)
    path.write_text(reviewed, encoding="utf-8")
    with pytest.raises(SuiteError, match=r"holds the review of 1 pairs.*--curation"):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", emit_curation=path)
    assert path.read_text(encoding="utf-8") == reviewed


def test_a_missing_curation_file_is_named(compbench_root: Path, tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"curation file .*no\.jsonl not found"):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", curation=tmp_path / "no.jsonl")


HEADING = "candidate_id,question_sha256,status,instruction,object_phrase,recognisable"


def review_of(folder: Path, *rows: str, ending: str = "csv") -> Rows:
    path = folder / f"review.{ending}"
    path.write_text("\n".join((HEADING, *rows)), encoding="utf-8")
    return read_curation(path)


@pytest.mark.parametrize("status", ["Accept", "ACCEPT", " accept "])
@pytest.mark.parametrize(
    ("recognisable", "expected"), [("No", "no"), ("FALSE", "no"), ("0", "no"), ("Yes", "yes")]
)
def test_decisions_are_read_in_the_spellings_of_a_spreadsheet(
    status: str, recognisable: str, expected: str, tmp_path: Path
) -> None:
    (row,) = review_of(tmp_path, f"a,0,{status},,,{recognisable}")
    assert (row["status"], row["recognisable"]) == ("accept", expected)


def test_an_answer_that_is_neither_yes_nor_no_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"line 2 \(a\): recognisable is 'hardly'; expected yes, no or an empty"):
        review_of(tmp_path, "a,0,accept,,,hardly")


def test_an_equal_decision_counts_once_and_a_contradicting_one_is_refused(tmp_path: Path) -> None:
    assert len(review_of(tmp_path, "a,0,accept,,,yes", "b,0,reject,,,", "a,0,Accept,,,TRUE")) == 2
    for row in ("a,0,reject,,,yes", "a,0,accept,,,no", "a,0,edited,Put it on red,red,yes", "a,1,accept,,,yes"):
        with pytest.raises(SuiteError, match=r"line 3: a has .*, and in .*line 2"):
            review_of(tmp_path, "a,0,accept,,,yes", row)


def test_a_review_as_json_lines_follows_the_same_rules(tmp_path: Path) -> None:
    path = tmp_path / "review.jsonl"
    row = {"candidate_id": "a", "question_sha256": "0", "status": "Edited", "instruction": "Put it\u2028on red"}
    other = {**row, "status": "reject"}
    path.write_text("\ufeff" + json.dumps(row, ensure_ascii=False) + "\n\n", encoding="utf-8")
    assert read_curation(path) == [{**row, "status": "edited", "instruction": "Put it on red", "recognisable": ""}]
    path.write_text(f"{json.dumps(row)}\n{json.dumps(other)}\n", encoding="utf-8")
    with pytest.raises(SuiteError, match=r"line 2: a has status 'reject', and in .*line 1 'edited'"):
        read_curation(path)


@pytest.mark.parametrize(
    "ending", ["csv", *(pytest.param(ending, marks=pytest.mark.slow) for ending in ("tsv", "jsonl"))]
)
def test_a_review_that_cannot_be_read_is_never_written_anew(
    ending: str, compbench_root: Path, tmp_path: Path
) -> None:
    path = tmp_path / f"review.{ending}"
    convert("mllm-compbench", compbench_root, tmp_path / "one", emit_curation=path)
    convert("mllm-compbench", compbench_root, tmp_path / "two", emit_curation=path)
    reviewed = path.read_text(encoding="utf-8").replace("pending", "acept", 1)
    path.write_text(reviewed, encoding="utf-8")
    with pytest.raises(SuiteError, match=r"no review that can be read: .*line [12].* status is 'acept'"):
        convert("mllm-compbench", compbench_root, tmp_path / "three", emit_curation=path)
    assert path.read_text(encoding="utf-8") == reviewed
