import json
from collections import Counter
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import SuiteError
from probe_kit.suite.converters import convert

STATES = "Labeled_data/st_label/State_Transform_merged0_0_1000"


def test_pairs_are_kept_and_half_of_them_negated(compbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["emotion"])
    assert Counter(item.instruction for item in suite.items) == {
        "Put the cube on the more smiling person": 6,
        "Put the cube on the less smiling person": 6,
    }
    assert Counter(item.polarity for item in suite.items) == {"pos": 6, "neg": 6}
    assert Counter(item.correct_side for item in suite.items) == {"left": 6, "right": 6}


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


def test_the_papers_polarity_can_be_kept(compbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "s", categories=["emotion"], paper_polarity=True)
    assert {item.polarity for item in suite.items} == {"pos"}


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
    whole = json.loads((compbench_root / f"{STATES}_test.json").read_text(encoding="utf-8"))[:2]
    (compbench_root / f"{STATES}.json").write_text(json.dumps(whole), encoding="utf-8")
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute", "state"])
    assert sum(suite.card["counts"].values()) == 2


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


def test_the_command_counts_by_name_what_it_leaves_out(compbench_root: Path, tmp_path: Path) -> None:
    path = compbench_root / "Labeled_data/fer2013_label/fer2013_0_720_rebalanced.json"
    records = json.loads(path.read_text(encoding="utf-8"))
    records[0]["answer"], records[1]["answer"] = "Same", "left"
    path.write_text(json.dumps(records), encoding="utf-8")
    place = str(tmp_path / "suite")
    options = ["--root", str(compbench_root), "--out", place, "--categories", "emotion"]
    said = " ".join(CliRunner().invoke(app, ["suite", "convert", "mllm-compbench", *options]).stderr.split())
    assert (
        "records left out: answer is 'Same', not Left or Right 1×; answer is 'left', not Left or Right 1×" in said
    )
