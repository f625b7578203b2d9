"""The golden reference of pi0.5, which lerobot's own blocks recorded."""

import shutil
from pathlib import Path

import numpy as np

from probe_kit.hooks.verification.verify import verify_reference

MUST_AGREE = {
    "actions", "actions_unnormalized", "backbone_final_norm", "backbone_resid", "expert_final_norm",
    "expert_resid", "prefix_embs", "prefix_pad", "prep_images", "velocity", "vision_resid", "x_t",
}  # fmt: skip


def test_every_recorded_output_is_reproduced(golden_pi05: Path) -> None:
    verification = verify_reference("pi05", golden_pi05)
    assert {one.output for one in verification.comparisons} >= MUST_AGREE
    assert {one.status for one in verification.comparisons} == {"ok"}
    assert verification.passed


def test_one_wrong_number_is_noticed(golden_pi05: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(golden_pi05, tmp_path / "reference")
    with np.load(folder / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["expert_resid"][3, 2, 1, 0, 5] += 0.001
    np.savez(folder / "reference.npz", **recorded)
    verification = verify_reference("pi05", folder)
    assert [one.output for one in verification.comparisons if one.status == "over"] == ["expert_resid"]
