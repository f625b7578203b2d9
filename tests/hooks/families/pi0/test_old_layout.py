"""Checkpoints in lerobot's layout of early 2025, read as if they were of today."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks import Observation
from probe_kit.hooks.families.pi0.adapter import Pi0, current_config
from probe_kit.hooks.verify import verify_reference
from tests.support.pi0_checkpoints import old_golden


@pytest.fixture(scope="module")
def golden(golden_pi0: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return old_golden(golden_pi0, tmp_path_factory.mktemp("old") / "pi0")


@pytest.fixture(scope="module")
def policy(golden: Path) -> Pi0:
    return Pi0.load(str(golden / "checkpoint"))


def test_the_golden_reference_in_the_old_layout_gives_every_recorded_number(golden: Path) -> None:
    verification = verify_reference("pi0", golden)
    compared = {own.output for own in verification.comparisons if own.status == "ok"}
    assert verification.passed
    assert {"actions", "actions_unnormalized", "backbone_resid", "expert_resid", "prep_images"} <= compared


def test_statistics_among_the_weights_are_those_of_the_processor_files(golden_pi0: Path, policy: Pi0) -> None:
    today = Pi0.load(str(golden_pi0 / "checkpoint"))
    for old, new in ((policy.state_units, today.state_units), (policy.action_units, today.action_units)):
        assert old.source == "the weights"
        np.testing.assert_array_equal(old.low, new.low)
        np.testing.assert_array_equal(old.high, new.high)
    assert "MEAN_STD from the weights" in policy.card.notes[-1]


def test_pictures_are_padded_on_the_left_and_top_as_that_lerobot_did(policy: Pi0) -> None:
    """Today's pads on both sides; another place in the picture is another token."""
    picture = np.full((24, 40, 3), 255, np.uint8)
    seen = policy.look("top", [picture])[0, 0]
    assert seen.shape == (32, 32)
    assert policy.card.settings["picture"] == "padded-top-left"
    rows = seen.mean(dim=1)
    height = int(24 * 32 / 40)
    assert (rows[: 32 - height] == 0).all()
    assert (rows[32 - height :] == 1).all()


def test_a_random_twin_keeps_the_statistics_that_lie_among_the_weights(golden: Path, policy: Pi0) -> None:
    twin = Pi0.load(str(golden / "checkpoint"), random_weights=True)
    assert twin.card.random_weights
    np.testing.assert_array_equal(twin.action_units.low, policy.action_units.low)


def test_a_tensor_of_the_old_layout_that_is_missing_is_named(golden: Path, tmp_path: Path) -> None:
    copy = old_copy(golden, tmp_path)
    weights = load_file(copy / "model.safetensors")
    weights.pop("model.paligemma_with_expert.paligemma.vision_tower.vision_model.post_layernorm.weight")
    save_file(weights, copy / "model.safetensors")
    with pytest.raises(WeightsError, match=r"1 tensors missing.*post_layernorm"):
        Pi0.load(str(copy))


@pytest.mark.parametrize("change", ["absent", "unfilled"])
def test_statistics_that_nobody_filled_are_no_statistics(golden: Path, tmp_path: Path, change: str) -> None:
    """lerobot filled the buffers with infinity until statistics were given."""
    copy = old_copy(golden, tmp_path)
    weights = load_file(copy / "model.safetensors")
    name = "unnormalize_outputs.buffer_action.std"
    weights[name] = torch.full_like(weights[name], torch.inf)
    if change == "absent":
        del weights[name]
    save_file(weights, copy / "model.safetensors")
    policy = Pi0.load(str(copy))
    with pytest.raises(CheckpointError, match=r"buffer_action\.std"):
        _ = policy.action_units
    assert "buffer_action.std" in str(policy.embodiment_mismatch())


def test_statistics_given_to_a_checkpoint_that_has_its_own_are_refused(
    golden: Path, observation: Observation
) -> None:
    policy = Pi0.load(str(golden / "checkpoint"), statistics="bridge")
    assert "leave -M statistics out" in str(policy.embodiment_mismatch())
    with pytest.raises(CheckpointError, match="leave -M statistics out"):
        policy.act([observation], [0])


def test_a_setting_that_nobody_knows_is_an_error_until_it_is_accepted(golden: Path, tmp_path: Path) -> None:
    copy = old_copy(golden, tmp_path)
    config = json.loads((copy / "config.json").read_text(encoding="utf-8"))
    (copy / "config.json").write_text(
        json.dumps({**config, "flip_pictures": True, "num_views": 1}), encoding="utf-8"
    )
    with pytest.raises(CheckpointError, match="-M unread=flip_pictures,num_views"):
        Pi0.load(str(copy))
    assert Pi0.load(str(copy), unread="flip_pictures,num_views").config.num_inference_steps == 10


def test_settings_that_changed_states_and_actions_are_refused() -> None:
    for name in ("adapt_to_pi_aloha", "use_delta_joint_actions_aloha"):
        with pytest.raises(CheckpointError, match=f"{name}=True"):
            current_config({"type": "pi0", name: True}, "config.json")


def old_copy(golden: Path, target: Path) -> Path:
    import shutil

    return Path(shutil.copytree(golden, target / "pi0")) / "checkpoint"
