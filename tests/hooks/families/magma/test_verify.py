"""`probe-kit verify magma`, on the golden reference and on one that is damaged on purpose."""

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from probe_kit.hooks.verify import verify_keys, verify_reference
from probe_kit.models.magma import UNUSED_WEIGHTS

INPUTS = 11


def test_everything_recorded_is_compared_and_within_its_tolerance(golden_magma: Path) -> None:
    verification = verify_reference("magma", golden_magma)
    by_status = {comparison.output: comparison.status for comparison in verification.comparisons}
    assert set(by_status.values()) == {"ok"}, by_status
    with np.load(golden_magma / "reference.npz") as recorded:
        assert len(by_status) == len(recorded.files) - INPUTS


@pytest.mark.parametrize("name", ["hidden_states", "batch_logits", "stage2", "generated_ids", "detok_table"])
def test_an_output_that_differs_is_over(golden_magma: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "reference"
    shutil.copytree(golden_magma / "checkpoint", folder / "checkpoint")
    with np.load(golden_magma / "reference.npz") as stored:
        recorded = dict(stored)
    changed = recorded[name].copy()
    changed[..., -1] += 1  # of the last row, which is no padding
    np.savez(folder / "reference.npz", **{**recorded, name: changed})
    statuses = {
        comparison.output: comparison.status for comparison in verify_reference("magma", folder).comparisons
    }
    assert {output for output, status in statuses.items() if status == "over"} == {name}


def test_the_full_size_has_the_recorded_keys_but_for_the_declared_ones(golden_magma: Path) -> None:
    verification = verify_keys("magma", golden_magma / "real_keys.json.gz")
    assert verification.passed, verification.comparisons
    whole, left_out = verification.comparisons
    assert (whole.output, whole.error) == ("672 keys", 0.0)
    assert left_out.status == "not compared"
    assert all(name in left_out.note for name in UNUSED_WEIGHTS)


def test_only_the_declared_keys_may_be_missing_here(golden_magma: Path, tmp_path: Path) -> None:
    recorded = json.loads(gzip.decompress((golden_magma / "real_keys.json.gz").read_bytes()))
    file = tmp_path / "keys.json"
    entry = {"shape": [3], "dtype": "bfloat16"}
    for name in ("vision_tower.clip_vision_model.trunk.headless", "multi_modal_projector.row_separator"):
        file.write_text(json.dumps({"keys": {**recorded["keys"], name: entry}}))
        verification = verify_keys("magma", file)
        assert not verification.passed
        assert f"{name}: missing here" in verification.comparisons[0].note
