import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import CheckpointError
from probe_kit.models.spatialvla import (
    Intrinsics,
    PictureSettings,
    SpatialVLAConfig,
    known_cameras,
    prepare_picture,
)
from tests.support.spatialvla_checkpoints import SIDE, config_values, preprocessor_values, processor_values

CONFIG = SpatialVLAConfig.from_json(config_values())


def picture(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def settings(folder: Path, **fields: Any) -> PictureSettings:
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessor_values(**fields)), encoding="utf-8")
    return PictureSettings.of(CONFIG, folder)


@pytest.mark.parametrize("shape", [(480, 640), (65, 40), (SIDE, SIDE), (100, 130)])
@pytest.mark.parametrize("fields", [{}, {"resample": 2}, {"do_normalize": True, "image_mean": [0.1, 0.5, 0.4]}])
def test_pixels_are_transformers_pil_processors_bit_for_bit(
    tmp_path: Path, shape: tuple[int, int], fields: dict[str, Any]
) -> None:
    from transformers import SiglipImageProcessorPil

    chosen = settings(tmp_path, **fields)
    theirs = SiglipImageProcessorPil(**{k: v for k, v in preprocessor_values(**fields).items() if "type" not in k})
    expected = np.asarray(theirs(picture(*shape), return_tensors="np")["pixel_values"][0])
    ours = prepare_picture(picture(*shape), chosen)
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours, expected)


def test_without_a_file_pictures_are_prepared_as_released(tmp_path: Path) -> None:
    assert PictureSettings.of(CONFIG, tmp_path) == settings(tmp_path)
    assert prepare_picture(picture(48, 64), PictureSettings(SIDE)).min() >= 0


@pytest.mark.parametrize(
    ("fields", "said"),
    [({"side": 56}, "side 56"), ({"do_resize": False}, "side -1"), ({"resample": 17}, "resample is 17")],
)
def test_a_file_that_contradicts_the_model_is_refused(tmp_path: Path, fields: dict[str, Any], said: str) -> None:
    with pytest.raises(CheckpointError, match=said):
        settings(tmp_path, **fields)


def test_a_camera_sees_the_same_point_in_the_same_part_of_the_squeezed_picture() -> None:
    camera = known_cameras(processor_values(), "file")["default"]
    point = np.array([0.1, -0.2, 0.9])
    place = camera.matrix @ point / point[2]
    squeezed = camera.at(224) @ point / point[2]
    np.testing.assert_allclose(squeezed[:2] / 224, place[:2] / [640, 480], rtol=1e-6)


def test_a_matrix_that_is_no_cameras_is_refused() -> None:
    broken = {"default": {"width": 4, "height": 3, "intrinsic": [[0, 0, 1], [0, 1, 1], [0, 0, 1]]}}
    with pytest.raises(CheckpointError, match="intrinsic_config of default"):
        known_cameras({"intrinsic_config": broken}, "file")


def test_pictures_and_camera_are_the_originals(golden_spatialvla: Path) -> None:
    folder = golden_spatialvla / "checkpoint"
    with np.load(golden_spatialvla / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in ("image_uint8", "pixel_values", "intrinsic_raw", "intrinsic")}
    chosen = PictureSettings.of(SpatialVLAConfig.from_folder(folder), folder)
    np.testing.assert_array_equal(prepare_picture(recorded["image_uint8"], chosen)[None], recorded["pixel_values"])
    height, width = recorded["image_uint8"].shape[:2]
    camera = Intrinsics(recorded["intrinsic_raw"], width, height)
    np.testing.assert_array_equal(camera.at(chosen.side), recorded["intrinsic"])
