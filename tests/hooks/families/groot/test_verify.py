"""The golden reference of GR00T, which lerobot's own loading, processors and modules recorded."""

import shutil
from pathlib import Path

import numpy as np

from probe_kit.hooks.verification.verify import verify_reference

MUST_AGREE = {
    "actions", "actions_unnormalized", "backbone_end", "backbone_final_norm", "bridge_resid", "expert_resid",
    "input_ids", "pixel_values", "state", "velocity",
}  # fmt: skip


def test_every_recorded_output_is_reproduced(golden_groot: Path) -> None:
    verification = verify_reference("groot", golden_groot)
    assert {one.output for one in verification.comparisons} == MUST_AGREE
    assert {one.status for one in verification.comparisons} == {"ok"}
    assert verification.passed


def test_one_wrong_number_is_noticed(golden_groot: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(golden_groot, tmp_path / "reference")
    with np.load(folder / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["bridge_resid"][1, 0, 3, 2] += 0.001
    np.savez(folder / "reference.npz", **recorded)
    verification = verify_reference("groot", folder)
    assert [one.output for one in verification.comparisons if one.status == "over"] == ["bridge_resid"]
