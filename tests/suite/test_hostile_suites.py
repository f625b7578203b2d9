"""Whatever stands in a suite's files: refused by file, line and field, or loaded as what was written."""

import json
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from probe_kit._system.bounded_files import parse_json
from probe_kit._system.escaping import UNSAFE
from probe_kit.cli import app
from probe_kit.errors import SuiteError
from probe_kit.suite import Suite, load_suite
from probe_kit.suite.items import Item

HOSTILE: list[Any] = [
    None, True, -1, 10**400, 1e308, [], {}, [[["x"]]], {"a": {"b": []}}, "", " ", "\x00", "\x1b[31m", "a\u202eb",
    "e\u0301", "\u212b", "x" * 5000, "../../../etc/passwd", "/etc/passwd", "C:\\x", "images", ".",
    "images/../images", "a\u2028b", "\ufeff", "nan", "=1+1", "'", "9" * 30,
]  # fmt: skip
FIELDS = [field.name for field in fields(Item) if field.name != "folder"]
CARD = ["name", "version", "counts", "content_sha256", "schema_version", "contains_real_faces", "new"]
METADATA = Path("items", "metadata.jsonl")


@pytest.fixture(scope="module")
def place(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(small_suite.folder, tmp_path_factory.mktemp("hostile") / "suite"))


@pytest.fixture(scope="module")
def lines(small_suite: Suite) -> list[str]:
    return (small_suite.folder / METADATA).read_text(encoding="utf-8").splitlines()


def played(item: Item) -> tuple[object, ...]:
    """What an episode is made of; the rest of an item says where it comes from."""
    pictures = item.left_pixels_sha256, item.right_pixels_sha256
    return item.item_id, item.category, item.instruction, item.correct_side, item.group_id, item.wordings, pictures


def restored(place: Path, original: Path) -> None:
    for name in ("suite.json", METADATA):
        shutil.copyfile(original / name, place / name)


@pytest.mark.slow
@given(field=st.sampled_from(FIELDS), value=st.sampled_from(HOSTILE))
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
def test_any_value_in_any_field_is_refused_by_name(
    field: str, value: Any, place: Path, lines: list[str], small_suite: Suite
) -> None:
    restored(place, small_suite.folder)
    record = json.loads(lines[2])
    record[field] = value
    (place / METADATA).write_text("\n".join([*lines[:2], json.dumps(record), *lines[3:]]) + "\n", encoding="utf-8")
    try:
        loaded = load_suite(place)
    except SuiteError as error:
        said = str(error)
        assert "metadata.jsonl:3" in said or "item" in said or "suite.json: content hash" in said
        assert not UNSAFE.search(said)
    else:
        assert [played(item) for item in loaded.items] == [played(item) for item in small_suite.items]
        assert getattr(loaded.items[2], field) == value, "it is read as it was written"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@given(field=st.sampled_from(CARD), value=st.sampled_from(HOSTILE))
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
def test_any_value_in_the_card_is_refused_or_changes_no_item(
    field: str, value: Any, place: Path, small_suite: Suite
) -> None:
    restored(place, small_suite.folder)
    card = json.loads((place / "suite.json").read_text(encoding="utf-8"))
    card[field] = value
    (place / "suite.json").write_text(json.dumps(card), encoding="utf-8")
    try:
        loaded = load_suite(place)
    except SuiteError as error:
        refused = str(error)
        assert not UNSAFE.search(refused)
    else:
        assert loaded.items == small_suite.items
    answer = CliRunner().invoke(app, ["suite", "show", "--counts", str(place)])
    assert answer.exit_code in (0, 1, 2), answer.output
    assert "InternalError" not in answer.output


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": 2}', "names the key 'a' twice"),
        ('{"a": {"b": 1, "c": 2, "b": 1}}', "names the key 'b' twice"),
        ('[{"x": 1}, {"y": 1, "y": 1}]', "names the key 'y' twice"),
    ],
)
def test_json_with_a_key_twice_is_none(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_json(text)


@pytest.mark.parametrize(
    ("part", "by", "words"),
    [
        ('"polarity"', '"polarity": "neg", "polarity"', r"E01 metadata.jsonl:3: .*names the key 'polarity' twice"),
        (
            '"gen": {',
            '"gen": {"x": NaN, ',
            r"E01 metadata.jsonl:3: a number in it is NaN, infinite",
        ),
        (
            '"gen": {',
            '"gen": {"x": -Infinity, ',
            r"E01 metadata.jsonl:3: a number in it is NaN, infinite",
        ),
        (
            '"gen": {',
            '"gen": {"x": [1e999], ',
            r"E01 metadata.jsonl:3: a number in it is NaN, infinite or beyond float range",
        ),
        ("Put the", "Put the\\u0301", r"E02 metadata.jsonl:3: field 'instruction' .*decomposed characters"),
    ],
)
def test_lines_that_mean_two_things_or_nothing_are_refused(
    part: str, by: str, words: str, place: Path, lines: list[str], small_suite: Suite
) -> None:
    restored(place, small_suite.folder)
    assert part in lines[2]
    changed = [*lines[:2], lines[2].replace(part, by, 1), *lines[3:]]
    (place / METADATA).write_text("\n".join(changed) + "\n", encoding="utf-8")
    with pytest.raises(SuiteError, match=words):
        load_suite(place)
