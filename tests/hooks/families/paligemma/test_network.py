"""The part of a picture that a checkpoint looks at."""

import json
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.paligemma.network import CROP, SquarePictures

SETTINGS = {
    "do_resize": True, "do_rescale": True, "rescale_factor": 1 / 255, "do_normalize": True,
    "image_mean": [0.5] * 3, "image_std": [0.5] * 3, "resample": 2, "size": {"height": 32, "width": 32},
}  # fmt: skip
PICTURE = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)


def pictures(folder: Path, **settings: object) -> SquarePictures:
    (folder / "preprocessor_config.json").write_text(json.dumps(SETTINGS | settings), encoding="utf-8")
    return SquarePictures.from_folder(folder, 32)


def test_a_cropped_picture_is_the_part_by_itself(tmp_path: Path) -> None:
    cropped = pictures(tmp_path, **{CROP: [0.25, 0.5, 0.5, 0.5]}).pixels([PICTURE, PICTURE[::-1].copy()])
    part = pictures(tmp_path).pixels([PICTURE[15:45, 40:80], PICTURE[::-1][15:45, 40:80].copy()])
    np.testing.assert_array_equal(cropped, part)


def test_without_a_crop_all_of_a_picture_is_looked_at(tmp_path: Path) -> None:
    uncropped = pictures(tmp_path, **{CROP: [0, 0, 1, 1]}).pixels([PICTURE])
    np.testing.assert_array_equal(pictures(tmp_path).pixels([PICTURE]), uncropped)


@pytest.mark.parametrize(
    "crop", [[0, 0, 1], "all", [0.5, 0, 0.6, 1], [0, 0, 0, 1], [0, -0.1, 1, 1], [0, 0, 1, "x"], 1]
)
def test_what_is_no_part_of_a_picture_is_refused(crop: object, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"expected top, left, height and width"):
        pictures(tmp_path, **{CROP: crop})
