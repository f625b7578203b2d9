"""References of other sizes, which code that is not ours records here, are reproduced too."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.hooks.verify import verify_reference
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
