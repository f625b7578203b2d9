"""The network alone against the original implementation; `verify` compares through the adapter."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from probe_kit.models.magma import (
    UNUSED_WEIGHTS,
    MagmaConfig,
    MagmaNetwork,
    PictureSettings,
    build_magma,
    prepare_picture,
)

TOLERANCE = 2e-5


@pytest.fixture(scope="module")
def recorded(golden_magma: Path) -> dict[str, np.ndarray]:
    with np.load(golden_magma / "reference.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def network(golden_magma: Path) -> MagmaNetwork:
    built = build_magma(MagmaConfig.from_folder(golden_magma / "checkpoint"), torch.float32)
    tensors = load_file(golden_magma / "checkpoint" / "model.safetensors")
    used = {name: tensor for name, tensor in tensors.items() if name not in UNUSED_WEIGHTS}
    built.load_state_dict(used, strict=True, assign=True)
    return built


def close(ours: Any, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(np.asarray(ours), theirs, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("which", ["", "_2"])
@torch.inference_mode()
def test_one_crop_and_stitched_crops_are_read_as_the_original_reads_them(
    network: MagmaNetwork, recorded: dict[str, np.ndarray], which: str
) -> None:
    settings = PictureSettings(network.config.vision.base, network.config.vision.crops)
    picture = prepare_picture(recorded["image2_uint8" if which else "image1_uint8"], settings)
    np.testing.assert_array_equal(picture.crops[None], recorded["pixel_values" + which])
    ids = recorded["input_ids"][0].tolist()
    output = network([ids], [picture])
    close(torch.stack(output.hidden_states), recorded["hidden_states" + which])
    close(output.logits, recorded["logits" + which])
