"""SmolVLA's packing, compared with lerobot's own masks."""

from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import InstructionError, ObservationError
from probe_kit.hooks.families.smolvla.adapter import SmolVLA
from probe_kit.hooks.testing import example_observations
from tests.hooks.families.smolvla.checkpoints import write_smolvla


@pytest.mark.slow
@pytest.mark.parametrize("shown_cameras", [1, 2])
@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"empty_cameras": 1},
        {"add_image_special_tokens": True, "empty_cameras": 1},
        {"prefix_length": 40},
        {"add_image_special_tokens": True, "prefix_length": 50},
    ],
)
def test_roles_name_the_positions_that_lerobot_masks(tmp_path: Path, fields: dict, shown_cameras: int) -> None:
    cameras = ("top", "wrist")
    policy = SmolVLA.load(str(write_smolvla(tmp_path, cameras=cameras, **fields))).with_cameras(
        cameras[:shown_cameras]
    )
    observations = example_observations(["Put the cube on the star", "Put the cube on the red shape"], cameras)
    batch = policy.batch(observations)
    images, masks = policy.network.prepare_images(batch)
    tokens, valid = policy.tokenise([observation.instruction for observation in observations])
    state = policy.network.prepare_state(batch)
    with torch.no_grad():
        _, expected, _ = policy.network.model.embed_prefix(images, masks, tokens, valid, state)
    ours = np.stack([row.valid for row in policy.roles(observations)["backbone"]])
    np.testing.assert_array_equal(ours, expected.bool().numpy())
    assert {f"image.{camera}" for camera in cameras[:shown_cameras]} <= set(policy.role_names["backbone"])


def test_a_second_camera_is_needed_once_it_is_shown(tmp_path: Path) -> None:
    policy = SmolVLA.load(str(write_smolvla(tmp_path, cameras=("top", "wrist")))).with_cameras(["top", "wrist"])
    with pytest.raises(ObservationError, match=r"no camera\.wrist"):
        policy.act(example_observations(["Put the cube on the star"]), [0])
    with pytest.raises(ObservationError, match="in order"):
        policy.with_cameras(["wrist"])


def test_words_are_checked_without_the_network(tmp_path: Path) -> None:
    """An AttributeError refused every instruction before anything was loaded."""
    checkpoint = str(write_smolvla(tmp_path))
    SmolVLA.check_words(checkpoint, ["Put the cube on the star"])
    with pytest.raises(InstructionError, match=r"does not know|tokens; this checkpoint reads"):
        SmolVLA.check_words(checkpoint, ["Put the cube on the zebra " * 40])
