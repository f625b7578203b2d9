"""The golden reference of pi0-FAST, which lerobot's own blocks and decoding recorded."""

import shutil
from pathlib import Path

import numpy as np

from probe_kit.hooks.verification.verify import verify_reference

MUST_AGREE = {
    "action_final_norm", "action_resid", "actions", "actions_unnormalized", "backbone_final_norm",
    "backbone_resid", "logits", "prefix_pad", "prep_images", "tokens", "vision_resid",
}  # fmt: skip


def test_every_recorded_output_is_reproduced(golden_pi0_fast: Path) -> None:
    verification = verify_reference("pi0-fast", golden_pi0_fast)
    assert {one.output for one in verification.comparisons} == MUST_AGREE
    assert {one.status for one in verification.comparisons} == {"ok"}
    assert verification.passed


def test_one_wrong_number_is_noticed(golden_pi0_fast: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(golden_pi0_fast, tmp_path / "reference")
    with np.load(folder / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    recorded["action_resid"][3, 2, 1, 0, 5] += 0.001
    np.savez(folder / "reference.npz", **recorded)
    verification = verify_reference("pi0-fast", folder)
    assert [one.output for one in verification.comparisons if one.status == "over"] == ["action_resid"]
