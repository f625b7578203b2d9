"""Whatever stands in a suite's files: refused by file, line and field, or loaded as what was written."""

import json
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
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
from probe_kit.statistics.folds import assign_folds
from probe_kit.suite import Item, Suite, build_suite, load_suite, validate_suite
from probe_kit.suite.validate import Baseline, limit_for, run_baselines

HOSTILE: list[Any] = [
    None, True, -1, 10**400, 1e308, [], {}, [[["x"]]], {"a": {"b": []}}, "", " ", "\x00", "\x1b[31m", "a\u202eb",
    "e\u0301", "\u212b", "x" * 5000, "../../../etc/passwd", "/etc/passwd", "C:\\x", "images", ".",
    "images/../images", "a\u2028b", "\ufeff", "nan", "=1+1", "'", "9" * 30,
]  # fmt: skip
FIELDS = [field.name for field in fields(Item) if field.name != "folder"]
CARD = ["name", "version", "counts", "content_sha256", "schema_version", "contains_real_faces", "new"]
METADATA = Path("items", "metadata.jsonl")


@pytest.fixture(scope="module")
def folder(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(small_suite.folder, tmp_path_factory.mktemp("hostile") / "suite"))


@pytest.fixture(scope="module")
def lines(small_suite: Suite) -> list[str]:
    return (small_suite.folder / METADATA).read_text(encoding="utf-8").splitlines()


def played(item: Item) -> tuple[object, ...]:
    """What an episode is made of; the rest of an item says where it comes from."""
    pictures = item.left_pixels_sha256, item.right_pixels_sha256
    return item.item_id, item.category, item.instruction, item.correct_side, item.group_id, item.wordings, pictures


def restored(folder: Path, original: Path) -> None:
    for name in ("suite.json", METADATA):
        shutil.copyfile(original / name, folder / name)


@pytest.mark.slow
@given(field=st.sampled_from(FIELDS), value=st.sampled_from(HOSTILE))
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
def test_any_value_in_any_field_is_refused_by_name(
    field: str, value: Any, folder: Path, lines: list[str], small_suite: Suite
) -> None:
    restored(folder, small_suite.folder)
    record = json.loads(lines[2])
    record[field] = value
    (folder / METADATA).write_text(
        "\n".join([*lines[:2], json.dumps(record), *lines[3:]]) + "\n", encoding="utf-8"
    )
    try:
        loaded = load_suite(folder)
    except SuiteError as error:
        message = str(error)
        assert "metadata.jsonl:3" in message or "item" in message or "suite.json: content hash" in message
        assert not UNSAFE.search(message)
    else:
        assert [played(item) for item in loaded.items] == [played(item) for item in small_suite.items]
        assert getattr(loaded.items[2], field) == value, "it is read as it was written"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Generating overly large repr")
@given(field=st.sampled_from(CARD), value=st.sampled_from(HOSTILE))
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
def test_any_value_in_the_card_is_refused_or_changes_no_item(
    field: str, value: Any, folder: Path, small_suite: Suite
) -> None:
    restored(folder, small_suite.folder)
    card = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
    card[field] = value
    (folder / "suite.json").write_text(json.dumps(card), encoding="utf-8")
    try:
        loaded = load_suite(folder)
    except SuiteError as error:
        refused = str(error)
        assert not UNSAFE.search(refused)
    else:
        assert loaded.items == small_suite.items
    answer = CliRunner().invoke(app, ["suite", "show", "--counts", str(folder)])
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
    part: str, by: str, words: str, folder: Path, lines: list[str], small_suite: Suite
) -> None:
    restored(folder, small_suite.folder)
    assert part in lines[2]
    changed = [*lines[:2], lines[2].replace(part, by, 1), *lines[3:]]
    (folder / METADATA).write_text("\n".join(changed) + "\n", encoding="utf-8")
    with pytest.raises(SuiteError, match=words):
        load_suite(folder)


def part(suite: Suite, keep: Callable[[Item], bool]) -> Suite:
    """The same suite with some of its items only."""
    return replace(suite, items=tuple(item for item in suite.items if keep(item)))


@pytest.fixture(scope="module")
def honest(embedded: Suite) -> tuple[Baseline, ...]:
    return run_baselines(embedded)


@pytest.mark.slow
def test_every_embedded_category_is_within_its_limit(honest: tuple[Baseline, ...], embedded: Suite) -> None:
    assert {baseline.category for baseline in honest} == set(embedded.categories)
    assert {baseline.name for baseline in honest} == {"position", "instruction", "pixels", "statistics"}
    assert [str(baseline) for baseline in honest if not baseline.ok] == []


@pytest.mark.slow
def test_twins_put_every_baseline_at_exactly_one_half(honest: tuple[Baseline, ...]) -> None:
    assert {baseline.accuracy for baseline in honest} == {0.5}


@pytest.mark.slow
@pytest.mark.parametrize("category", ["attribute", pytest.param("state", marks=pytest.mark.slow)])
def test_pictures_give_the_answer_away_if_only_one_polarity_is_asked(category: str, tmp_path: Path) -> None:
    suite = build_suite(tmp_path / "suite", [category], 100)
    always_more = part(suite, lambda item: item.polarity == "pos")
    baselines = {baseline.name: baseline for baseline in run_baselines(always_more)}
    assert not baselines["statistics"].ok or (category == "state" and not baselines["pixels"].ok)


@pytest.mark.slow
def test_text_gives_the_answer_away_if_a_layout_is_tied_to_it(embedded: Suite) -> None:
    """Both layouts protect the text; the position baseline cannot leave one half either."""
    tied = part(embedded.select(["state"]), lambda item: (item.polarity == "pos") == (item.correct_side == "left"))
    accuracy_by_baseline = {b.name: b.accuracy for b in run_baselines(tied)}
    assert accuracy_by_baseline["instruction"] == accuracy_by_baseline["position"] == 0.5


@pytest.mark.slow
def test_folds_never_separate_layouts_or_twins(embedded: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.suite import validate as baselines

    splits = []

    def spy(*arguments: Any) -> Any:
        splits.append((arguments[1], assign_folds(*arguments)))
        return splits[-1][1]

    monkeypatch.setattr(baselines, "assign_folds", spy)
    run_baselines(embedded.select(["time"]))
    ((groups, folds),) = splits
    for group in set(groups):
        assert len(set(folds[groups == group])) == 1
    assert len(set(folds)) == 5


def test_the_limit_is_that_of_items_and_not_of_episodes() -> None:
    assert limit_for(150) == pytest.approx(0.580, abs=5e-4)
    assert limit_for(70) == pytest.approx(0.617, abs=5e-4)


def test_baselines_are_stored_in_the_suite_without_changing_it(copied: Path) -> None:
    before = load_suite(copied).identity
    report = validate_suite(copied, baselines=True)
    stored = json.loads((copied / "baselines.json").read_text(encoding="utf-8"))
    assert load_suite(copied).identity == before == stored["suite"]
    assert len(stored["baselines"]) == len(report.baselines or ()) == 8
    assert stored["sides"]["color"] == {"left": 6, "right": 6}
    assert all(uses["target"] == uses["distractor"] for uses in stored["roles"]["shape"].values())
    assert report.ok


def test_a_suite_with_errors_gets_no_baselines(copied: Path) -> None:
    load_suite(copied).items[0].picture("left").unlink()
    report = validate_suite(copied, baselines=True)
    assert not report.ok
    assert report.baselines is None
    assert not (copied / "baselines.json").exists()


def test_a_leak_is_a_warning_that_makes_the_report_not_ok(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leak = Baseline("color", "pixels", 0.71, (0.6, 0.8), 0.58, 150, 75, "group_id")
    monkeypatch.setattr("probe_kit.suite.validate.run_baselines", lambda *_: (leak,))
    report = validate_suite(copied, baselines=True)
    assert not report.ok
    assert "W05 Color: pixels 0.71 [0.60, 0.80] (limit 0.58)" in report.to_text()
