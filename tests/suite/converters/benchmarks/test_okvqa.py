import json
from pathlib import Path

import pytest

from probe_kit.errors import SuiteError
from probe_kit.suite.converters import convert


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
