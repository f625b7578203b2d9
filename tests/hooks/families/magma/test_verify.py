"""`probe-kit verify magma`: the golden reference, references made here at other sizes, and damaged ones."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from probe_kit.hooks.verification.verify import verify_keys, verify_reference
from probe_kit.models.magma import UNUSED_WEIGHTS
from tests.support.magma_reference import write_reference

INPUTS = 11
VARIANTS = {
    "one crop, then four": (((40, 50), (130, 121)), 6, {}),
    "crops side by side, then above each other": (((40, 130), (130, 40)), 9, {"vision": {"img_size": 96}}),
    "the whole picture at once": (((64, 190), (130, 130)), 3, {"vision": {"img_anyres_strategy": "global"}}),
    "other sizes": (
        ((65, 64), (30, 400)),
        5,
        {
            "vision": {
                "max_num_crops": 6,
                "mm_hidden_size": 48,
                "mm_projector_type": "mlp3x_gelu",
                "mm_use_im_start_end": True,
                "timm_overrides": {"depths": [2, 1, 1, 2], "dims": [8, 16, 24, 48], "norm_eps": 1e-3},
            },
            "text": {"hidden_size": 48, "num_hidden_layers": 2, "num_key_value_heads": 4, "rms_norm_eps": 1e-3},
            "mm_use_image_start_end": False,
        },
    ),
}


def test_everything_recorded_is_compared_and_within_its_tolerance(golden_magma: Path) -> None:
    verification = verify_reference("magma", golden_magma)
    by_status = {comparison.output: comparison.status for comparison in verification.comparisons}
    assert set(by_status.values()) == {"ok"}, by_status
    with np.load(golden_magma / "reference.npz") as recorded:
        assert len(by_status) == len(recorded.files) - INPUTS


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_is_tuned_to_one_reference(tmp_path: Path, variant: str) -> None:
    sizes, steps, fields = VARIANTS[variant]
    folder = write_reference(tmp_path, sizes, steps, seed=len(variant), **fields)
    verification = verify_reference("magma", folder)
    by_status = {
        comparison.output: (comparison.status, comparison.note) for comparison in verification.comparisons
    }
    assert {status for status, _ in by_status.values()} == {"ok"}, by_status
    with np.load(folder / "reference.npz") as recorded:
        assert len(by_status) == len(recorded.files) - INPUTS + 1  # the choice of crops is recorded elsewhere


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hidden_states", "batch_logits", "stage2", "generated_ids", "detok_table"])
def test_an_output_that_differs_is_over(tmp_path: Path, name: str) -> None:
    sizes, steps, fields = VARIANTS["one crop, then four"]
    folder = write_reference(tmp_path, sizes, steps, seed=1, **fields)
    with np.load(folder / "reference.npz") as stored:
        recorded = dict(stored)
    recorded[name][..., -1] += 1  # of the last row, which is no padding
    np.savez(folder / "reference.npz", **recorded)
    comparisons = verify_reference("magma", folder).comparisons
    assert {comparison.output for comparison in comparisons if comparison.status == "over"} == {name}


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
        file.write_text(json.dumps({"keys": {**recorded["keys"], name: entry}}), encoding="utf-8")
        verification = verify_keys("magma", file)
        assert not verification.passed
        assert f"{name}: missing here" in verification.comparisons[0].note
