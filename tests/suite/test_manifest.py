import json
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite import Suite, load_suite


def test_a_suite_read_back_is_the_suite_written(small_suite: Suite) -> None:
    loaded = load_suite(small_suite.folder)
    assert loaded == small_suite
    assert loaded.card["content_sha256"] == loaded.content_sha256


def test_the_folder_holds_what_the_format_says(small_suite: Suite) -> None:
    assert {path.name for path in small_suite.folder.iterdir()} == {
        "suite.json",
        "items",
        "LICENSES.md",
        "ATTRIBUTION.csv",
        "stats.json",
    }
    assert json.loads((small_suite.folder / "stats.json").read_text(encoding="utf-8"))["color"] == {
        "pool": 55,
        "emitted": 12,
    }
    assert "Apache-2.0 | yes | 24" in (small_suite.folder / "LICENSES.md").read_text(encoding="utf-8")


def test_pictures_are_stored_once_under_their_content_hash(small_suite: Suite) -> None:
    images = small_suite.folder / "items" / "images"
    stored = {str(path.relative_to(small_suite.folder / "items")) for path in images.rglob("*.png")}
    pixels = {item.left_pixels_sha256 for item in small_suite.items}
    pixels |= {item.right_pixels_sha256 for item in small_suite.items}
    assert stored == {f"images/{digest[:2]}/{digest[:16]}.png" for digest in pixels}


def test_every_stored_picture_is_attributed(small_suite: Suite) -> None:
    header, *rows = (small_suite.folder / "ATTRIBUTION.csv").read_text(encoding="utf-8").splitlines()
    assert header == "file_name,image_id,license,attribution"
    assert len(rows) == len(list(small_suite.folder.rglob("*.png")))


def test_pictures_are_found_after_the_working_directory_changed(
    small_suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(small_suite.folder.parent)
    loaded = load_suite(small_suite.folder.name)
    monkeypatch.chdir("/")
    assert loaded.items[0].picture("left").is_file()


@pytest.mark.parametrize("missing", ["nowhere", "."])
def test_a_folder_without_a_suite_is_wrong_usage(tmp_path: Path, missing: str) -> None:
    with pytest.raises(UsageError, match=r"is not a suite: it holds no suite\.json"):
        load_suite(tmp_path / missing)


def test_an_unreadable_card_is_refused(copied: Path) -> None:
    (copied / "suite.json").write_text("{", encoding="utf-8")
    with pytest.raises(SuiteError, match=r"E01 suite\.json: not valid JSON"):
        load_suite(copied)


def test_a_card_without_a_name_is_refused(copied: Path) -> None:
    card = json.loads((copied / "suite.json").read_text(encoding="utf-8"))
    del card["name"]
    (copied / "suite.json").write_text(json.dumps(card), encoding="utf-8")
    with pytest.raises(SuiteError, match=r"E02 suite\.json: field 'name' is None; expected a str"):
        load_suite(copied)


def test_a_card_of_another_schema_is_refused(copied: Path) -> None:
    card = json.loads((copied / "suite.json").read_text(encoding="utf-8")) | {"schema_version": "2.0"}
    (copied / "suite.json").write_text(json.dumps(card), encoding="utf-8")
    with pytest.raises(SuiteError, match=r"E03 suite\.json: uses schema 2\.0; this tool reads 1\.x"):
        load_suite(copied)


@pytest.mark.parametrize("line", ["{half", "[1, 2]", "", b"\xff\xfe".decode("latin-1")])
def test_a_line_that_is_no_json_object_is_found_by_its_number(copied: Path, line: str) -> None:
    path = copied / "items" / "metadata.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[6] = line
    path.write_bytes("\n".join(lines).encode("latin-1"))
    with pytest.raises(SuiteError, match=r"E01 metadata\.jsonl:7: "):
        load_suite(copied)


def test_missing_metadata_is_found(copied: Path) -> None:
    (copied / "items" / "metadata.jsonl").unlink()
    with pytest.raises(SuiteError, match=r"E01 metadata\.jsonl: the file is missing"):
        load_suite(copied)


def test_a_changed_picture_is_found_and_named(copied: Path) -> None:
    item = load_suite(copied).items[0]
    path = item.picture("right")
    with Image.open(path) as image:
        image.rotate(180).save(path)
    with pytest.raises(SuiteError, match=f"E06 item {item.item_id}: right picture changed on disk"):
        load_suite(copied)


def test_a_deleted_picture_is_found_and_named(copied: Path) -> None:
    item = load_suite(copied).items[0]
    item.picture("left").unlink()
    with pytest.raises(SuiteError, match=f"E05 item {item.item_id}: picture '{item.left_file_name}' not found"):
        load_suite(copied)


@pytest.mark.parametrize(
    ("encoded", "message"),
    [(b"rubbish", "cannot be decoded"), ("small", "left picture is 40×40; needs at least 64")],
)
def test_a_picture_that_was_never_good_is_found(
    copied: Path, edit_records: Callable[[Any], Path], encoded: bytes | str, message: str
) -> None:
    if encoded == "small":
        buffer = BytesIO()
        Image.new("RGB", (40, 40)).save(buffer, format="PNG")
        encoded = buffer.getvalue()
    (copied / "items" / "bad.png").write_bytes(encoded)
    edit_records(lambda records: records[0].update(left_file_name="bad.png"))
    with pytest.raises(SuiteError, match=f"E07 .*{message}"):
        load_suite(copied)
