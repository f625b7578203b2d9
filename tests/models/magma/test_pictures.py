import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torchvision.transforms import Compose, Normalize, ToTensor

from probe_kit.errors import CheckpointError
from probe_kit.models.magma import (
    Grid,
    MagmaConfig,
    PictureSettings,
    choose_grid,
    prepare_picture,
    shrink_picture,
)
from tests.support.magma_checkpoints import config_values

SETTINGS = PictureSettings(64, 4)


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("width", "height", "grid"),
    [
        (224, 224, Grid(1, 1)),
        (640, 480, Grid(1, 2)),
        (480, 640, Grid(2, 1)),
        (1280, 720, Grid(2, 2)),
        (100, 1000, Grid(2, 1)),
        (2000, 100, Grid(1, 4)),
        (1, 3000, Grid(1, 1)),
    ],
)
def test_the_grid_keeps_most_pixels_and_wastes_fewest(width: int, height: int, grid: Grid) -> None:
    assert choose_grid(width, height, PictureSettings(512, 4)) == grid


@pytest.mark.parametrize(("height", "width"), [(50, 50), (70, 121), (48, 64), (128, 128), (200, 40)])
def test_crops_are_torchvisions_pixels_stretched_and_cut_bit_for_bit(height: int, width: int) -> None:
    picture = noise(height, width)
    prepared = prepare_picture(picture, SETTINGS)
    pixels = Compose([ToTensor(), Normalize(SETTINGS.mean, SETTINGS.deviation)])(Image.fromarray(picture))
    rows, columns = prepared.grid.rows, prepared.grid.columns
    whole = torch.nn.functional.interpolate(pixels[None], size=(64 * rows, 64 * columns), mode="bilinear")[0]
    expected = [
        whole[:, 64 * row : 64 * (row + 1), 64 * column : 64 * (column + 1)]
        for row in range(rows)
        for column in range(columns)
    ]
    assert torch.equal(prepared.crops, torch.stack(expected))


def test_the_client_shrinks_with_pils_default_filter() -> None:
    picture = noise(48, 64)
    expected = np.asarray(Image.fromarray(picture).resize((20, 20)))
    np.testing.assert_array_equal(shrink_picture(picture, 20), expected)


def test_the_checkpoints_own_processor_wins_over_its_configuration(tmp_path: Path) -> None:
    vision = MagmaConfig.from_json(config_values()).vision
    assert PictureSettings.of(vision, tmp_path) == SETTINGS
    file = tmp_path / "preprocessor_config.json"
    file.write_text(json.dumps({"base_img_size": 96, "num_crops": 2, "image_mean": [0, 0.5, 1]}), encoding="utf-8")
    found = PictureSettings.of(vision, tmp_path)
    assert (found.base, found.crops, found.mean, found.deviation) == (96, 2, (0, 0.5, 1), SETTINGS.deviation)
    file.write_text(json.dumps({"num_crops": 2}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="base_img_size"):
        PictureSettings.of(vision, tmp_path)
