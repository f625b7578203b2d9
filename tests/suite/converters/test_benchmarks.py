"""Benchmarks in little become suites, and what is broken in one is named."""

import base64
import csv
import json
import os
import textwrap
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite import Suite, load_picture, validate_suite
from probe_kit.suite.converters import convert
from probe_kit.suite.converters.vlthink import upright_board

STATES = "Labeled_data/st_label/State_Transform_merged0_0_1000"


def test_pairs_are_kept_and_half_of_them_negated(compbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["emotion"])
    assert Counter(item.instruction for item in suite.items) == {
        "Put the cube on the more smiling person": 6,
        "Put the cube on the less smiling person": 6,
    }
    assert Counter(item.polarity for item in suite.items) == {"pos": 6, "neg": 6}
    assert Counter(item.correct_side for item in suite.items) == {"left": 6, "right": 6}


@pytest.mark.slow
def test_the_answered_picture_is_the_target_and_the_other_one_if_negated(
    compbench_root: Path, tmp_path: Path
) -> None:
    records = json.loads(
        (compbench_root / "Labeled_data/fer2013_label/fer2013_0_720_rebalanced.json").read_text(encoding="utf-8")
    )
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["emotion"])
    for item in suite.items:
        record = records[int(item.source["source_id"].rpartition("/")[2])]
        answered = record["image_1"] if record["answer"] == "Left" else record["image_2"]
        target = item.left_image_id if item.correct_side == "left" else item.right_image_id
        assert target.endswith(answered) == (item.polarity == "pos")


@pytest.mark.slow
def test_the_papers_polarity_can_be_kept(compbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "s", categories=["emotion"], paper_polarity=True)
    assert {item.polarity for item in suite.items} == {"pos"}


@pytest.mark.slow
def test_split_files_are_united_and_types_sorted_into_state_and_attribute(
    compbench_root: Path, tmp_path: Path
) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute", "state"])
    stats = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))
    assert stats["state"]["pool"] == stats["attribute"]["pool"] == 5
    assert stats["reasons"]["empty record"] == 1
    assert stats["attribute"]["needs_edit"] == 1
    assert stats["attribute"]["paper_pool"] == 5386


def test_a_whole_file_is_preferred_to_its_parts(compbench_root: Path, tmp_path: Path) -> None:
    all_records = json.loads((compbench_root / f"{STATES}_test.json").read_text(encoding="utf-8"))[:2]
    (compbench_root / f"{STATES}.json").write_text(json.dumps(all_records), encoding="utf-8")
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute", "state"])
    assert sum(suite.card["counts"].values()) == 2


@pytest.mark.slow
def test_faces_are_declared_and_may_be_small_only_where_the_source_is(
    compbench_root: Path, tmp_path: Path
) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["emotion"])
    assert suite.card["contains_real_faces"] is True
    assert not any(item.redistributable for item in suite.items)
    with pytest.raises(SuiteError, match="picture too small 12×"):
        convert("mllm-compbench", compbench_root, tmp_path / "x", categories=["emotion"], fer_min_side=64)


def test_a_missing_picture_is_named_with_its_record_what_was_tried_and_a_remedy(
    compbench_root: Path, tmp_path: Path
) -> None:
    (compbench_root / "fer-2013/test/happy/im4_b.png").unlink()
    with pytest.raises(
        SuiteError, match=r"record 4 of fer2013_0_720_rebalanced\.json: tried .*im4_b\.png.*image_root"
    ):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["emotion"])
    assert not (tmp_path / "suite").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ("{}", "holds a JSON dict; expected a list"),
        ('[{"image_1": "a"}]', "record 0 of .*: field 'answer' is None"),
    ],
)
def test_a_broken_annotation_file_is_named(compbench_root: Path, tmp_path: Path, text: str, message: str) -> None:
    (compbench_root / "Labeled_data/fer2013_label/fer2013_0_720_rebalanced.json").write_text(
        text, encoding="utf-8"
    )
    with pytest.raises(SuiteError, match=message):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["emotion"])
    assert not (tmp_path / "suite").exists()


def test_a_tree_without_annotations_is_refused_with_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(
        SuiteError, match=r"no annotation file found .*fer2013_label/fer2013_0_720_rebalanced\.json"
    ):
        convert("mllm-compbench", tmp_path, tmp_path / "suite")


@pytest.mark.slow
def test_the_command_counts_by_name_what_it_leaves_out(compbench_root: Path, tmp_path: Path) -> None:
    path = compbench_root / "Labeled_data/fer2013_label/fer2013_0_720_rebalanced.json"
    records = json.loads(path.read_text(encoding="utf-8"))
    records[0]["answer"], records[1]["answer"] = "Same", "left"
    path.write_text(json.dumps(records), encoding="utf-8")
    out = str(tmp_path / "suite")
    options = ["--root", str(compbench_root), "--out", out, "--categories", "emotion"]
    message = " ".join(CliRunner().invoke(app, ["suite", "convert", "mllm-compbench", *options]).stderr.split())
    assert (
        "records left out: answer is 'Same', not Left or Right 1×; answer is 'left', not Left or Right 1×"
        in message
    )


@pytest.fixture
def suite(iconqa_root: Path, tmp_path: Path) -> Suite:
    return convert("iconqa", iconqa_root, tmp_path / "suite")


def test_only_self_contained_questions_become_items(suite: Suite) -> None:
    shapes = {item.source["source_id"]: item.instruction for item in suite.items if item.category == "shape"}
    assert shapes == {"1": "Put the cube on the triangle", "4": "Put the cube on the square"}, "4 has a blank stem"
    stats = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))
    assert stats["reasons"]["question refers to the stem"] == 1


def test_clocks_and_symmetry_are_found_by_their_words(suite: Suite) -> None:
    (clock,) = [item for item in suite.items if item.category == "time"]
    assert clock.instruction == "Put the cube on the clock showing half past four"
    (symmetric,) = [item for item in suite.items if item.category == "symmetry"]
    assert symmetric.object_phrase in ("picture with a line of symmetry", "picture without a line of symmetry")


def test_stems_of_one_thing_are_paired_across_problems_and_asked_both_ways(suite: Suite) -> None:
    counted = [item for item in suite.items if item.construction == "cross_item"]
    assert len(counted) == 4
    assert {item.object_phrase for item in counted} <= {
        *("picture with five cars", "picture with three cars", "picture with one car", "picture with two cars"),
    }
    assert sorted(item.target_concept for item in counted) == sorted(item.distractor_concept for item in counted)


def test_cross_items_can_be_left_out(iconqa_root: Path, tmp_path: Path) -> None:
    suite = convert("iconqa", iconqa_root, tmp_path / "suite", categories=["counting"], cross_items=False)
    assert {item.construction for item in suite.items} == {"choice_vs_distractor"}


def test_art_is_flattened_trimmed_and_padded(suite: Suite) -> None:
    pixels = np.asarray(load_picture(suite.items[0].picture("left")))
    ink = (pixels < 240).any(axis=2)
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    side = len(pixels)
    assert max(np.ptp(rows), np.ptp(columns)) / side == pytest.approx(0.84, abs=0.03)
    assert abs((rows[0] + rows[-1]) / 2 - side / 2) < 0.03 * side
    assert "8 % margin" in suite.items[0].source["picture_operation"]


def test_a_missing_choice_is_named_with_its_problem(iconqa_root: Path, tmp_path: Path) -> None:
    (path,) = iconqa_root.rglob("choose_img/2/choice_1.png")
    path.unlink()
    with pytest.raises(SuiteError, match=r"problem 2 of problems\.json: tried .*choice_1\.png"):
        convert("iconqa", iconqa_root, tmp_path / "suite")
    assert not (tmp_path / "suite").exists()


def test_an_answer_beyond_the_choices_is_refused(iconqa_root: Path, tmp_path: Path) -> None:
    path = iconqa_root / "iconqa_data" / "problems.json"
    problems = json.loads(path.read_text(encoding="utf-8"))
    problems["1"]["answer"] = 2
    path.write_text(json.dumps(problems), encoding="utf-8")
    with pytest.raises(SuiteError, match=r"problem 1 of problems\.json: answer 2 of 2 choices"):
        convert("iconqa", iconqa_root, tmp_path / "suite")


def test_a_folder_without_problems_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"problems\.json is missing\. Name the folder"):
        convert("iconqa", tmp_path, tmp_path / "suite")


def test_a_problem_in_two_splits_is_refused(iconqa_root: Path, tmp_path: Path) -> None:
    path = iconqa_root / "iconqa_data" / "pid_splits.json"
    splits = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**splits, "choose_img_val": ["2"]}), encoding="utf-8")
    with pytest.raises(SuiteError, match=r"choose_img_val: pid '2' is that of choose_img_train too"):
        convert("iconqa", iconqa_root, tmp_path / "suite")


REAL_ROWS = Path(os.environ.get("PROBE_KIT_SHARED", Path(__file__).parents[4] / "shared")) / "data" / "mmbench"


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
    if not REAL_ROWS.is_dir():
        pytest.skip(f"no MMBench sample at {REAL_ROWS} (set PROBE_KIT_SHARED); it is not part of the repository")
    with pytest.raises(SuiteError, match=r"0 rows of category celebrity_recognition among 10"):
        convert("mmbench", REAL_ROWS, tmp_path / "suite", include_real_faces=True)


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
        (lambda content: content[: len(content) // 2 // 4 * 4], "image: not a picture that Pillow can decode"),
        (lambda content: content[:-3], "image: not base64"),
        (lambda _: base64.b64encode(b"II*\0" + bytes(60)).decode(), "image: is TIFF"),
    ],
)
def test_a_picture_that_is_cut_or_of_another_format_is_refused_with_its_row(
    content: Callable[[str], str], message: str, mmbench_root: Path, tmp_path: Path
) -> None:
    rewritten(mmbench_root, lambda rows: rows[3].__setitem__(9, content(rows[3][9])))
    with pytest.raises(SuiteError, match=f"row with index 2 of .*{message}"):
        converted(mmbench_root, tmp_path)


@pytest.mark.slow
def test_a_picture_in_several_lines_of_base64_is_read(mmbench_root: Path, tmp_path: Path) -> None:
    before = converted(mmbench_root, tmp_path / "before")
    rewritten(
        mmbench_root, lambda rows: [row.__setitem__(9, "\n".join(textwrap.wrap(row[9], 76))) for row in rows[1:]]
    )
    assert converted(mmbench_root, tmp_path / "after").content_sha256 == before.content_sha256


def test_without_boxes_everything_waits_for_a_person(okvqa_root: Path, tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"no item left to write.*paired 6.*all stay pending"):
        convert("ok-vqa", okvqa_root, tmp_path / "suite")
    assert not (tmp_path / "suite").exists()


def test_boxes_rule_out_pictures_that_hold_the_answer_and_objects_too_small(
    okvqa_root: Path, coco_instances: Path, tmp_path: Path
) -> None:
    suite = convert("ok-vqa", okvqa_root, tmp_path / "suite", instances=str(coco_instances))
    for item in suite.items:
        assert {item.left_image_id, item.right_image_id} != {"coco/0", "coco/1"}, "the cow's picture holds a horse"
        assert "coco/3" not in (item.left_image_id, item.right_image_id), "the zebra is tiny"
    assert {item.object_phrase for item in suite.items} <= {
        "picture of horse",
        "picture of cow",
        "picture of sheep",
    }
    stats = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))
    assert stats["reasons"]["object too small or not boxed"] == 1


def test_the_raw_answer_people_agree_on_decides(okvqa_root: Path, coco_instances: Path, tmp_path: Path) -> None:
    suite = convert("ok-vqa", okvqa_root, tmp_path / "suite", instances=str(coco_instances))
    reasons = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))["reasons"]
    assert reasons["people do not agree on the answer"] == 1
    assert reasons["question asks for something else than a kind"] == 1


def test_only_plants_and_animals_count_into_the_pool(
    okvqa_root: Path, coco_instances: Path, tmp_path: Path
) -> None:
    suite = convert("ok-vqa", okvqa_root, tmp_path / "suite", instances=str(coco_instances))
    assert json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))["living-world"]["pool"] == 8
    assert all(item.license == "LicenseRef-COCO-Flickr" and not item.redistributable for item in suite.items)


def test_a_missing_photograph_is_named(okvqa_root: Path, tmp_path: Path) -> None:
    (okvqa_root / "train2014" / "COCO_train2014_000000000001.jpg").unlink()
    with pytest.raises(
        SuiteError, match=r"annotation 1 of mscoco_train2014_annotations.json: tried .*000000000001"
    ):
        convert("ok-vqa", okvqa_root, tmp_path / "suite")


def test_annotations_of_another_release_are_refused(okvqa_root: Path, tmp_path: Path) -> None:
    (okvqa_root / "OpenEnded_mscoco_train2014_questions.json").write_text('{"questions": []}', encoding="utf-8")
    with pytest.raises(SuiteError, match=r"annotation 0 .*question 0 is not in OpenEnded"):
        convert("ok-vqa", okvqa_root, tmp_path / "suite")


def test_a_folder_without_questions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"no OpenEnded_mscoco_<split>_questions.json"):
        convert("ok-vqa", tmp_path, tmp_path / "suite")


@pytest.mark.parametrize(("name", "key"), [("OpenEnded_mscoco", "questions"), ("mscoco", "annotations")])
def test_a_question_that_occurs_twice_is_refused(name: str, key: str, okvqa_root: Path, tmp_path: Path) -> None:
    path = okvqa_root / f"{name}_train2014_{key}.json"
    records = json.loads(path.read_text(encoding="utf-8"))
    records[key].append({**records[key][1]})
    path.write_text(json.dumps(records), encoding="utf-8")
    with pytest.raises(SuiteError, match=rf"question_id 10 is that of {key[:-1]} 1 of .* too"):
        convert("ok-vqa", okvqa_root, tmp_path / "suite")


REAL_BOARDS = Path(os.environ.get("PROBE_KIT_SHARED", Path(__file__).parents[4] / "shared")) / "data" / "vl-think"


@pytest.fixture
def real() -> Path:
    if not REAL_BOARDS.is_dir():
        pytest.skip(
            f"no VL-Think sample at {REAL_BOARDS} (set PROBE_KIT_SHARED); it is not part of the repository"
        )
    return REAL_BOARDS


def board(root: Path, group: str, name: str) -> np.ndarray:
    folder = root / "ManiSkill/mani_skill/assets/carrot" / f"more_{group}" / "shapes"
    (path,) = folder.glob(f"*{name}/textured.glb")
    return np.asarray(upright_board(path).convert("L"), np.float64)


def test_boards_come_out_upright(vlthink_root: Path) -> None:
    """The look-alike has a red post at the left and a black bar at the top."""
    folder = vlthink_root / "ManiSkill/mani_skill/assets/carrot/more_traffic/shapes"
    pixels = np.asarray(upright_board(folder / "000_stopgiveway" / "textured.glb"), np.int64)
    reddish = (pixels[..., 0] - pixels[..., 2]) > 100
    rows, columns = np.nonzero(reddish)
    assert np.ptp(rows) > 2 * np.ptp(columns)
    assert columns.mean() < pixels.shape[1] / 2


@pytest.mark.parametrize(
    ("name", "axis", "tip"), [("left", 1, 0), ("right", 1, -1), ("up", 0, 0), ("down", 0, -1)]
)
def test_real_arrows_point_where_their_names_say(real: Path, name: str, axis: int, tip: int) -> None:
    """An arrow's head is broad: the half with the tip holds more ink."""
    ink = 255 - board(real, "arrows", f"arrow_{name}")
    halves = np.array_split(ink, 2, axis=axis)
    assert halves[tip].sum() > 1.2 * halves[-1 if tip == 0 else 0].sum()


def test_real_hearts_stand_on_their_tip(real: Path) -> None:
    upper, lower = np.array_split(255 - board(real, "shape", "heart_black"), 2, axis=0)
    assert upper.sum() > 1.3 * lower.sum()


@pytest.mark.slow
def test_every_two_signs_are_asked_both_ways(vlthink_root: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])
    assert len(suite.items) == 5 * 4
    roles = Counter(item.target_concept for item in suite.items)
    assert roles == Counter(item.distractor_concept for item in suite.items)
    assert "Put the cube on the stop sign" in {item.instruction for item in suite.items}, "aliased label"
    assert validate_suite(suite.folder, baselines=True).ok


def test_signs_named_after_a_side_are_marked_and_can_be_left_out(vlthink_root: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])
    assert {item.object_phrase for item in suite.items if item.side_word} == {"no left turn sign"}
    without = convert("vl-think", vlthink_root, tmp_path / "without", categories=["traffic"], side_words=False)
    assert not any("left" in item.instruction for item in without.items)
    assert len(without.items) == 4 * 3


@pytest.mark.slow
def test_real_colours_are_eight_and_eleven_when_repainted(real: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", real, tmp_path / "eight", categories=["color"])
    assert len({item.target_concept for item in suite.items}) == 8
    recolored = convert("vl-think", real, tmp_path / "eleven", categories=["color"], recolor=True)
    assert len({item.target_concept for item in recolored.items}) == 11
    assert {item.construction for item in recolored.items} == {"cross_item", "recolored"}


@pytest.mark.slow
def test_real_signs_of_the_laundry_are_made_on_request(real: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", real, tmp_path / "s", categories=["public-info"], n=20, extra_boards=["laundry"])
    assert suite.card["counts"] == {"public-info": 20}
    assert min(load_picture(suite.items[0].picture("left")).size) >= 224


def test_a_board_that_is_no_gltf_is_named(vlthink_root: Path, tmp_path: Path) -> None:
    (path,) = vlthink_root.rglob("*noentry/textured.glb")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SuiteError, match=r"noentry.textured\.glb is not a glTF with an embedded picture"):
        convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])
    assert not (tmp_path / "suite").exists()


def test_a_missing_board_is_named_with_its_key(vlthink_root: Path, tmp_path: Path) -> None:
    (path,) = vlthink_root.rglob("*danger/textured.glb")
    path.unlink()
    with pytest.raises(SuiteError, match=r"image not found for board 003_danger of .*model_db\.json"):
        convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])


def test_a_tree_without_boards_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"no boards for color, public-info, traffic .*more_shape"):
        convert("vl-think", tmp_path, tmp_path / "suite")
