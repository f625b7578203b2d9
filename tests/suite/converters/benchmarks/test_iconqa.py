import json
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import SuiteError
from probe_kit.suite import Suite, load_picture
from probe_kit.suite.converters import convert


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
