import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.processor import ImageCropResizeProcessorStep

from probe_kit.errors import CheckpointError, ObservationError
from probe_kit.hooks.families.shared.lerobot.window import STEP, PictureWindow, read_window

CAMERA = "observation.images.base"


def write_step(folder: Path, config: dict[str, object]) -> None:
    steps = [{"registry_name": STEP, "config": config}]
    (folder / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}), encoding="utf-8")


def test_the_window_is_the_one_lerobots_own_step_cuts(tmp_path: Path) -> None:
    crop, size = (3, 5, 20, 30), (12, 10)
    write_step(tmp_path, {"crop_params_dict": {CAMERA: crop}, "resize_size": size})
    pictures = torch.from_numpy(np.random.default_rng(0).random((2, 3, 40, 50), np.float32))
    step = ImageCropResizeProcessorStep(crop_params_dict={CAMERA: crop}, resize_size=size)
    torch.testing.assert_close(
        read_window(tmp_path, CAMERA)(pictures), step.observation({CAMERA: pictures})[CAMERA], rtol=0, atol=0
    )


def test_a_checkpoint_without_the_step_sees_the_whole_picture(tmp_path: Path) -> None:
    assert read_window(tmp_path, CAMERA) == PictureWindow()
    pictures = torch.rand(1, 3, 8, 8)
    assert torch.equal(PictureWindow()(pictures), pictures)


def test_a_crop_of_another_camera_is_not_applied(tmp_path: Path) -> None:
    write_step(tmp_path, {"crop_params_dict": {"observation.images.wrist": [0, 0, 4, 4]}, "resize_size": None})
    assert read_window(tmp_path, CAMERA).crop is None


def test_a_crop_outside_the_picture_is_an_error_and_not_black_padding() -> None:
    with pytest.raises(ObservationError, match="rows 30 to 50"):
        PictureWindow(crop=(30, 0, 20, 10))(torch.rand(1, 3, 40, 40))


def test_a_broken_step_names_the_file(tmp_path: Path) -> None:
    write_step(tmp_path, {"crop_params_dict": {CAMERA: [1, 2, 3]}})
    with pytest.raises(CheckpointError, match="policy_preprocessor"):
        read_window(tmp_path, CAMERA)


def test_a_smaller_picture_is_brought_to_the_size_the_crop_was_chosen_on() -> None:
    window = PictureWindow(crop=(10, 0, 20, 40), size=(20, 40), camera=(40, 40))
    whole = torch.linspace(0, 1, 40).expand(1, 3, 40, 40)
    halved = torch.nn.functional.interpolate(whole, (20, 20), mode="area")
    assert (window(halved) - window(whole)).abs().max() < 0.02
    wide = window(torch.ones(1, 3, 10, 40))
    assert float(wide[..., 0, :].max()) == 0.0, "padding is black"
    assert float(wide[..., 10, :].min()) == pytest.approx(1.0)
