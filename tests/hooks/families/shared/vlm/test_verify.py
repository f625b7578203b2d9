"""VLMs against what transformers' own models and processors, or their authors' code, put out."""

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks.verification.verify import verify_keys, verify_reference

FOLDERS = {
    "paligemma": "paligemma",
    "qwen2.5-vl": "qwen2_5_vl",
    "qwen3-vl": "qwen3_vl",
    "internvl": "internvl",
    "ovis2.5": "ovis2_5",
}
COMMON = {
    "input_ids", "attention_mask", "pixel_values_shape", "pixel_values_at", "pixel_values_sum", "backbone_resid",
    "backbone_final_norm", "logits_last", "single_logits_last", "option_ids", "option_logits", "greedy_ids",
    "textonly_input_ids", "textonly_logits_last", "vision_resid_row0",
}  # fmt: skip
ASKED_PRISMATIC = {
    "input_ids", "input_mask", "attention_mask", "pixel_values", "projector_features", "backbone_resid",
    "backbone_final_norm", "logits_last", "batch_logits_last", "option_ids", "option_logits", "greedy_ids",
    "textonly_input_ids", "textonly_logits_last",
}  # fmt: skip
UNSAID = {"greedy_ids_hub_settings"}
"""What is said with the penalties of a file that the tool does not follow."""


@pytest.mark.parametrize("family", FOLDERS)
def test_every_recorded_output_is_reproduced(family: str, golden_vlm: Path) -> None:
    verification = verify_reference(family, golden_vlm / FOLDERS[family])
    status = {c.output: c.status for c in verification.comparisons}
    assert verification.passed
    assert {name for name, found in status.items() if found == "ok"} >= COMMON
    assert {name for name, found in status.items() if found != "ok"} == UNSAID


def test_prismatic_is_reproduced_answering_too(golden_vlm: Path) -> None:
    """Its other reference, of one prompt, has other names."""
    verification = verify_reference("prismatic", golden_vlm / "prismatic")
    assert {c.output for c in verification.comparisons if c.status == "ok"} == ASKED_PRISMATIC
    assert len(verification.comparisons) == len(ASKED_PRISMATIC)


def test_one_wrong_number_or_id_in_the_reference_is_noticed(golden_vlm: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(golden_vlm / "paligemma", tmp_path / "golden"))
    with np.load(copy / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["backbone_resid"][2, 1, -3] += 1e-4
    recorded["greedy_ids"][0, 1] += 1
    recorded["logits_last"][0, 0] += 1e-4
    np.savez(copy / "reference.npz", **recorded)
    status = {c.output: c.status for c in verify_reference("paligemma", copy).comparisons}
    assert {name for name, found in status.items() if found == "over"} == {
        "backbone_resid", "greedy_ids", "logits_last",
    }  # fmt: skip


def test_a_reference_without_its_questions_is_refused(golden_vlm: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(golden_vlm / "paligemma", tmp_path / "golden"))
    (copy / "dims.json").unlink()
    with pytest.raises(UsageError, match=r"dims\.json is missing"):
        verify_reference("paligemma", copy)


def _lists(golden: Path) -> list[tuple[str, Path]]:
    return [
        (family, file) for family, folder in FOLDERS.items() for file in sorted((golden / folder).glob("*keys*"))
    ]


@pytest.mark.parametrize(
    ("family", "file", "keys"),
    [
        ("paligemma", "paligemma/hub_keys.3B-pt-224.json.gz", "603 keys"),
        ("internvl", "internvl/hub_keys.8B.json.gz", "841 keys of 8B"),
        ("ovis2.5", "ovis2_5/real_keys.9B.json.gz", "840 keys"),
    ],
)
def test_full_size_keys_are_equal_through_the_renames(family: str, file: str, keys: str, golden_vlm: Path) -> None:
    """Tied output weights are not in the first list. Every list of every size: the slow test below."""
    verification = verify_keys(family, golden_vlm / file)
    assert verification.passed
    assert verification.comparisons[0].output == keys


@pytest.mark.slow
def test_every_list_of_keys_is_that_of_a_released_size(golden_vlm: Path) -> None:
    found = {str(file): verify_keys(family, file) for family, file in _lists(golden_vlm)}
    assert {file for file, verification in found.items() if not verification.passed} == set()
    for file, verification in found.items():
        size = Path(file).name.split(".")[1]
        assert "paligemma" in file or "ovis" in file or f"of {size}" in verification.comparisons[0].output


def test_a_list_without_a_key_that_nothing_else_holds_is_refused(golden_vlm: Path, tmp_path: Path) -> None:
    content = json.loads(gzip.decompress((golden_vlm / "internvl/real_keys.8B.json.gz").read_bytes()))
    gone = ("model.vision_tower.encoder.layer.3.lambda_1", "lm_head.weight")
    for name in gone:
        del content["keys"][name]
    file = tmp_path / "keys.json"
    file.write_text(json.dumps(content), encoding="utf-8")
    verification = verify_keys("internvl", file)
    assert not verification.passed
    assert all(f"{name}: not recorded" in verification.comparisons[0].note for name in gone)
