"""What NVIDIA's processor file says of state, actions and pictures is honoured, or refused by name."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchvision.transforms import v2

from probe_kit.errors import CheckpointError
from probe_kit.hooks import Observation
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.groot.adapter import Groot
from tests.support.groot_checkpoints import TAG, write_nvidias
from tests.support.pi05_checkpoints import HIGH, LEAST, LOW, MOST

STATE = np.linspace(-0.2, 0.7, 8, dtype=np.float32)
_MINMAX = (2 * (STATE - LOW) / (HIGH - LOW) - 1).clip(-1, 1)
_SCORES = (STATE - LOW) / (HIGH - LOW)  # the tiny files have these as mean and deviation


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nvidias(tmp_path_factory.mktemp("nvidia"))


Changed = Callable[..., Groot]


@pytest.fixture
def changed(stored: Path, tmp_path: Path) -> Changed:
    """Load the checkpoint with other fields; `state`, `action` and `top` are parts of the file of their own."""

    def load(
        state: dict[str, Any] | None = None,
        action: dict[str, Any] | None = None,
        top: dict[str, Any] | None = None,
        options: dict[str, Any] | None = None,
        **settings: Any,
    ) -> Groot:
        shutil.copytree(stored, tmp_path, dirs_exist_ok=True)
        file = tmp_path / "processor_config.json"
        content = json.loads(file.read_text(encoding="utf-8"))
        content["processor_kwargs"] |= settings
        modalities = content["processor_kwargs"]["modality_configs"][TAG]
        modalities["state"] |= state or {}
        modalities["action"] |= action or {}
        file.write_text(json.dumps(content | (top or {})), encoding="utf-8")
        return Groot.load(str(tmp_path), embodiment=TAG, **(options or {}))

    return load


def seen(policy: Groot, picture: NDArray[np.uint8] | None = None) -> list[Observation]:
    (one,) = examples_for(policy, "put the cube on the star")
    image = np.random.default_rng(0).integers(0, 256, (48, 80, 3), np.uint8) if picture is None else picture
    return [replace(one, image=image, state=STATE)]


def state_read(policy: Groot) -> NDArray[np.float32]:
    state: NDArray[np.float32] = policy.batch(seen(policy))["state"][0, 0].numpy()
    return state


def expected(*parts: NDArray[Any]) -> NDArray[np.float32]:
    row = np.concatenate(parts)
    return np.pad(row, (0, 12 - len(row))).astype(np.float32)


def test_without_further_fields_the_state_is_mapped_by_its_quantiles(changed: Changed) -> None:
    np.testing.assert_allclose(state_read(changed()), expected(_MINMAX), atol=1e-6)


def test_angles_are_read_as_sines_then_cosines_in_the_place_of_their_group(changed: Changed) -> None:
    policy = changed({"sin_cos_embedding_keys": ["rotation"]}, apply_sincos_state_encoding=True)
    angles = STATE[3:6]
    own = expected(_MINMAX[:3], np.sin(angles), np.cos(angles), _MINMAX[6:])
    np.testing.assert_allclose(state_read(policy), own, atol=1e-6)
    assert any("SIN_COS" in note for note in policy.card.notes)
    assert not policy.state_units.unusual(np.full((1, 8), -6, np.float32))[0, 3:6].any()  # less than a turn
    assert policy.state_units.unusual(np.full((1, 8), 99, np.float32))[0, 3:6].all()  # degrees
    assert policy.act(seen(policy), [0]).shape[-1] == 7


@pytest.mark.parametrize("switched_on", [True, False])
def test_angles_need_the_switch_and_the_group(changed: Changed, switched_on: bool) -> None:
    keys = [] if switched_on else ["rotation"]
    policy = changed({"sin_cos_embedding_keys": keys}, apply_sincos_state_encoding=switched_on)
    np.testing.assert_allclose(state_read(policy), expected(_MINMAX), atol=1e-6)


def test_groups_with_mean_and_deviation_are_scores_that_are_not_clamped(changed: Changed) -> None:
    policy = changed({"mean_std_embedding_keys": ["x", "gripper"]})
    own = expected(_SCORES[:1], _MINMAX[1:6], _SCORES[6:])
    np.testing.assert_allclose(state_read(policy), own, atol=1e-5)
    far = policy.state_units.normalise(np.full((1, 8), 50, np.float32))[0]
    assert far[0] > 1
    assert far[1] == 1


def test_sines_win_over_scores_as_in_nvidias_processor(changed: Changed) -> None:
    keys = {"sin_cos_embedding_keys": ["rotation"], "mean_std_embedding_keys": ["rotation"]}
    policy = changed(keys, apply_sincos_state_encoding=True)
    np.testing.assert_allclose(state_read(policy)[3:6], np.sin(STATE[3:6]), atol=1e-6)


@pytest.mark.parametrize(("inside", "outside"), [(True, False), (False, True), (True, True)])
def test_a_state_that_is_excluded_in_either_part_of_the_file_is_read_as_zeros(
    changed: Changed, inside: bool, outside: bool
) -> None:
    policy = changed({"exclude_state": inside}, exclude_state=outside)
    assert not state_read(policy).any()
    assert any("EXCLUDED" in note for note in policy.card.notes)


def test_actions_with_mean_and_deviation_are_restored_by_them(changed: Changed) -> None:
    policy = changed(action={"mean_std_embedding_keys": ["x", "yaw"]})
    put_out = np.full((1, 7), 2, np.float32)
    metres = policy.action_units.restore(put_out)[0]
    for number in (0, 5):
        assert metres[number] == pytest.approx(LEAST[number] + 2 * (MOST - LEAST)[number], rel=1e-5)
    assert metres[1] == pytest.approx(MOST[1], rel=1e-5)  # clamped
    slopes = policy.action_units.slopes(put_out)[0]
    assert slopes[0] == pytest.approx((MOST - LEAST)[0], rel=1e-5)
    assert slopes[1] == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"use_mean_std": True}, "use_mean_std: True"),
        ({"use_tactile": True, "tactile_state_keys": ["gripper"]}, "use_tactile: True"),
        ({"state": {"delta_indices": [-1, 0]}}, r"states of the steps \[-1, 0\] \(delta_indices\)"),
        ({"state": {"smoothing": 3}}, "field smoothing: 3"),
        ({"action": {"rescale": 2}}, "field rescale: 2"),
        ({"state_noise": 0.1}, "field state_noise: 0.1"),
        ({"top": {"state_scale": 2}}, "field state_scale: 2"),
        ({"top": {"processor_class": "Gr00tN1d6Processor"}}, "processor_class: 'Gr00tN1d6Processor'"),
        ({"use_percentiles": "false"}, "use_percentiles: 'false'"),
        ({"clip_outliers": None}, "clip_outliers: None"),
        ({"image_target_size": [64]}, r"image_target_size: \[64\]"),
        ({"crop_fraction": 1.5}, "crop_fraction: 1.5"),
        ({"model_type": "eagle"}, "model_type: 'eagle'"),
        ({"max_state_dim": 64}, "max_state_dim: 64, config.json 12"),
        ({"state": {"mean_std_embedding_keys": ["wrist"]}}, "unknown: wrist"),
        ({"state": {"sin_cos_embedding_keys": ["x", "y", "z", "rotation"]}, "apply_sincos_state_encoding": True},
         "14 numbers"),
    ],
)  # fmt: skip
def test_what_is_not_honoured_is_refused_by_name(changed: Changed, change: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        _ = changed(**change).state_units


def test_fields_of_training_change_nothing(changed: Changed) -> None:
    training = {
        "state_dropout_prob": 0.8, "random_rotation_angle": 5, "color_jitter_params": {"hue": 0.1},
        "use_mean_std": False, "use_tactile": False, "max_state_dim": 12, "model_type": "qwen",
    }  # fmt: skip
    np.testing.assert_array_equal(state_read(changed(**training)), state_read(changed()))


def pictures_of(policy: Groot, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What the network's image processor is given."""
    (frames,) = policy.packing.encode._build_sample_images(picture[None, None, None], 1, None)
    tensor: NDArray[np.uint8] = np.asarray(frames[0])
    return tensor


PICTURE = np.random.default_rng(1).integers(0, 256, (48, 80, 3), np.uint8)


def test_pictures_are_squashed_bilinearly_and_cut_as_nvidias_newest_code(changed: Changed) -> None:
    policy = changed()
    own = v2.Compose([v2.Resize((64, 64)), v2.CenterCrop((58, 58)), v2.Resize((64, 64))])
    np.testing.assert_array_equal(pictures_of(policy, PICTURE), own(torch.from_numpy(PICTURE).permute(2, 0, 1)))
    assert any("Isaac-GR00T" in note and "without letterbox" in note for note in policy.card.notes)
    assert policy.card.settings["resize"] == "nvidia"


def test_lerobots_resizing_is_another_one_and_can_be_chosen(changed: Changed) -> None:
    plain, other = (pictures_of(changed(options=own), PICTURE) for own in ({}, {"resize": "lerobot"}))
    assert plain.shape == other.shape == (3, 64, 64)
    assert np.abs(plain.astype(int) - other).max() > 10


@pytest.mark.parametrize("where", ["file", "option"])
def test_letterbox_puts_black_bars_above_and_below(changed: Changed, where: str) -> None:
    white = np.full((48, 80, 3), 255, np.uint8)
    policy = changed(letter_box_transform=True) if where == "file" else changed(options={"letterbox": True})
    rows = pictures_of(policy, white)[0].mean(1)
    assert rows[0] == rows[-1] == 0
    assert rows[32] == 255
    assert any("black bars" in note for note in policy.card.notes)
    off = changed(letter_box_transform=True, options={"letterbox": False})
    assert pictures_of(off, white).min() == 255


def test_area_resizing_keeps_proportions_with_a_shortest_edge_and_squashes_where_it_is_null(
    changed: Changed,
) -> None:
    kept = changed(use_albumentations=True, shortest_image_edge=32, crop_fraction=None)
    assert pictures_of(kept, PICTURE).shape == (3, 32, 53)
    squashed = changed(use_albumentations=True, shortest_image_edge=None, crop_fraction=1.0)
    area = cv2.resize(PICTURE, (64, 64), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(pictures_of(squashed, PICTURE), area.transpose(2, 0, 1))


def test_a_file_without_sizes_is_refused_where_nvidias_code_has_none(changed: Changed) -> None:
    with pytest.raises(CheckpointError, match=r"no image_target_size.*-M resize=lerobot"):
        changed(image_target_size=None)
    assert pictures_of(changed(image_target_size=None, options={"resize": "lerobot"}), PICTURE).shape[-1] == 256
