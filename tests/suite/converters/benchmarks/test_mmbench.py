import base64
import csv
import json
import os
import textwrap
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite import Suite
from probe_kit.suite.converters import convert

REAL = Path(os.environ.get("PROBE_KIT_SHARED", Path(__file__).parents[5] / "shared")) / "data" / "mmbench"


def test_real_faces_are_made_only_on_request(mmbench_root: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"real people, and was not asked for. Pass include_real_faces"):
        convert("mmbench", mmbench_root, tmp_path / "suite")


def test_names_are_asked_for_with_other_names_beside_them(mmbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mmbench", mmbench_root, tmp_path / "suite", include_real_faces=True)
    assert len(suite.items) == 6
    assert all(item.instruction == f"Put the cube on {item.object_phrase}" for item in suite.items)
    assert all(item.object_article == "none" and item.contains_real_face for item in suite.items)
    targets = Counter(
        item.left_image_id if item.correct_side == "left" else item.right_image_id for item in suite.items
    )
    assert max(targets.values()) == 1
    assert suite.card["contains_real_faces"] is True


def test_circular_copies_and_other_questions_are_counted_and_left_out(mmbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mmbench", mmbench_root, tmp_path / "suite", include_real_faces=True)
    stats = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))
    assert stats["celebrity"]["pool"] == 9
    assert stats["reasons"]["circular copy"] == stats["reasons"]["not an identity question"] == 1
    assert stats["celebrity"]["rule_selected"] == 7


def test_two_names_for_one_picture_never_meet_and_share_a_group(mmbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mmbench", mmbench_root, tmp_path / "suite", include_real_faces=True)
    assert all(item.left_image_id != item.right_image_id for item in suite.items)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\tcategory\t", "\tkind\t", "lacks category"),
        ("\tA\tcelebrity", "\t\tcelebrity", "row with index 0 .*: no answer"),
        ("\tA\tcelebrity", "\tC\tcelebrity", "answer is 'C', which is not an option"),
        ("B\tcelebrity_recognition\t0\t", "B\tcelebrity_recognition\t77\t", "its picture is in row '77'"),
        ("\n0\t", "\nzero\t", "line 2: index is 'zero'"),
    ],
)
def test_a_broken_file_is_refused_naming_the_row(
    mmbench_root: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = mmbench_root / "MMBench_DEV_EN.tsv"
    text = path.read_bytes().decode().replace("\r\n", "\n")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SuiteError, match=message):
        convert("mmbench", mmbench_root, tmp_path / "suite", include_real_faces=True)
    assert not (tmp_path / "suite").exists()


def test_a_test_file_is_refused_because_its_answers_are_secret(tmp_path: Path) -> None:
    (tmp_path / "MMBench_TEST_EN.tsv").write_text("index\n", encoding="utf-8")
    with pytest.raises(SuiteError, match=r"only a TEST file"):
        convert("mmbench", tmp_path, tmp_path / "suite", include_real_faces=True)


def test_the_published_sample_has_no_celebrities(tmp_path: Path) -> None:
    if not REAL.is_dir():
        pytest.skip(f"no MMBench sample at {REAL} (set PROBE_KIT_SHARED); it is not part of the repository")
    with pytest.raises(SuiteError, match=r"0 rows of category celebrity_recognition among 10"):
        convert("mmbench", REAL, tmp_path / "suite", include_real_faces=True)


def rewritten(root: Path, change: Callable[[list[list[str]]], None]) -> None:
    """Lets `change` edit the heading and the rows of the file."""
    path = root / "MMBench_DEV_EN.tsv"
    limit = csv.field_size_limit(1 << 30)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file, delimiter="\t"))
    csv.field_size_limit(limit)
    change(rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, delimiter="\t").writerows(rows)


def converted(root: Path, folder: Path) -> Suite:
    return convert("mmbench", root, folder / "suite", include_real_faces=True)


@pytest.mark.parametrize("index", ["0", "0.0", "00"])
def test_an_index_that_occurs_twice_is_refused_with_both_lines(
    index: str, mmbench_root: Path, tmp_path: Path
) -> None:
    rewritten(mmbench_root, lambda rows: rows[2].__setitem__(0, index))
    with pytest.raises(SuiteError, match=r"line 3: the index 0 is that of line 2 too"):
        converted(mmbench_root, tmp_path)


def test_a_file_that_ends_inside_a_row_is_refused(mmbench_root: Path, tmp_path: Path) -> None:
    rewritten(mmbench_root, lambda rows: rows.__setitem__(-1, rows[-1][:9]))
    with pytest.raises(SuiteError, match=r"line \d+ has 9 fields, the heading has 11"):
        converted(mmbench_root, tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda whole: whole[: len(whole) // 2 // 4 * 4], "image: not a picture that Pillow can decode"),
        (lambda whole: whole[:-3], "image: not base64"),
        (lambda _: base64.b64encode(b"II*\0" + bytes(60)).decode(), "image: is TIFF"),
    ],
)
def test_a_picture_that_is_cut_or_of_another_format_is_refused_with_its_row(
    content: Callable[[str], str], message: str, mmbench_root: Path, tmp_path: Path
) -> None:
    rewritten(mmbench_root, lambda rows: rows[3].__setitem__(9, content(rows[3][9])))
    with pytest.raises(SuiteError, match=f"row with index 2 of .*{message}"):
        converted(mmbench_root, tmp_path)


def test_a_picture_in_several_lines_of_base64_is_read(mmbench_root: Path, tmp_path: Path) -> None:
    before = converted(mmbench_root, tmp_path / "before")
    rewritten(
        mmbench_root, lambda rows: [row.__setitem__(9, "\n".join(textwrap.wrap(row[9], 76))) for row in rows[1:]]
    )
    assert converted(mmbench_root, tmp_path / "after").content_sha256 == before.content_sha256
