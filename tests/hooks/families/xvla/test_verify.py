"""The golden reference of X-VLA, which lerobot's own loading, processors and modules recorded."""

import shutil
from pathlib import Path

import numpy as np

from probe_kit.hooks.verification.verify import verify_reference

MUST_AGREE = {
    "actions", "actions_unnormalized", "backbone_resid", "expert_resid", "input_ids", "pixels", "predicted",
}  # fmt: skip


def test_every_recorded_output_is_reproduced(golden_xvla: Path) -> None:
    verification = verify_reference("xvla", golden_xvla)
    assert {one.output for one in verification.comparisons} == MUST_AGREE
    assert {one.status for one in verification.comparisons} == {"ok"}
    assert verification.passed


def test_one_wrong_number_is_noticed(golden_xvla: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(golden_xvla, tmp_path / "reference")
    with np.load(folder / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["backbone_resid"][1, 0, 3, 2] += 0.001
    np.savez(folder / "reference.npz", **recorded)
    verification = verify_reference("xvla", folder)
    assert [one.output for one in verification.comparisons if one.status == "over"] == ["backbone_resid"]
