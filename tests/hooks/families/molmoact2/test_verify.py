"""The golden reference of MolmoAct2, which lerobot's own blocks and processors recorded."""

import shutil
from pathlib import Path

import numpy as np

from probe_kit.hooks.verification.verify import verify_reference

MUST_AGREE = {
    "actions", "actions_unnormalized", "attention_mask", "backbone_final_norm", "backbone_resid",
    "expert_final_norm", "expert_resid", "input_ids", "keys", "pixel_values", "values", "velocity", "vision_resid",
}  # fmt: skip


def test_every_recorded_output_is_reproduced(golden_molmoact2: Path) -> None:
    verification = verify_reference("molmoact2", golden_molmoact2)
    assert {one.output for one in verification.comparisons} == MUST_AGREE
    assert {one.status for one in verification.comparisons} == {"ok"}
    assert verification.passed


def test_one_wrong_number_is_noticed(golden_molmoact2: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(golden_molmoact2, tmp_path / "reference")
    with np.load(folder / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["keys"][1, 0, 3, 2] += 0.001
    np.savez(folder / "reference.npz", **recorded)
    verification = verify_reference("molmoact2", folder)
    assert [one.output for one in verification.comparisons if one.status == "over"] == ["keys"]
