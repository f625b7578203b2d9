import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import map_coordinates
from torchvision.transforms import functional
from torchvision.transforms.functional import InterpolationMode

from probe_kit.errors import CheckpointError
from probe_kit.models.prismatic import PictureSettings, PrismaticConfig, centre_crop, prepare_picture
from tests.support.prismatic_checkpoints import config_values

SHAPES = [(48, 64), (65, 40), (28, 28), (29, 90), (90, 29)]


def picture(shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)


def settings(strategy: str, folder: Path = Path("nowhere")) -> PictureSettings:
    values = config_values(vision="dinoclip-vit-l-336px", image_resize_strategy=strategy)
    return PictureSettings.of(PrismaticConfig.from_json(values), folder)


def by_torchvision(image: np.ndarray, chosen: PictureSettings) -> np.ndarray:
    """The same in torchvision's words, whose rounding the original software has."""
    whole = Image.fromarray(image)
    if chosen.strategy == "letterbox":
        longer = max(whole.size)
        left, top = int((longer - whole.width) / 2), int((longer - whole.height) / 2)
        fill = tuple(int(255 * value) for value in chosen.means[-1])
        whole = functional.pad(whole, [left, top, left, top], fill=fill)
    channels = []
    for side, mean, deviation in zip(chosen.sides, chosen.means, chosen.deviations, strict=True):
        size = [side, side] if chosen.strategy == "resize-naive" else side
        resized = functional.resize(whole, size, InterpolationMode.BICUBIC)
        tensor = functional.to_tensor(functional.center_crop(resized, [side, side]))
        channels.append(functional.normalize(tensor, list(mean), list(deviation)))
    return torch.cat(channels).numpy()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("strategy", ["resize-naive", "letterbox", "resize-crop"])
def test_pixel_values_are_torchvisions_bit_for_bit(strategy: str, shape: tuple[int, int]) -> None:
    chosen = settings(strategy)
    ours = prepare_picture(picture(shape), chosen)
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours, by_torchvision(picture(shape), chosen))


def test_the_checkpoints_own_preprocessor_wins_over_the_table(tmp_path: Path) -> None:
    stored = {
        "image_resize_strategy": "resize-crop",
        "input_sizes": [[3, 28, 28], [3, 28, 28]],
        "means": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
        "stds": [[1, 1, 1], [2, 2, 2]],
        "interpolations": ["bicubic", "bilinear"],
    }
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stored), encoding="utf-8")
    found = settings("letterbox", tmp_path)
    assert (found.strategy, found.resampling, found.means[1]) == (
        "resize-crop",
        ("bicubic", "bilinear"),
        (0.4, 0.5, 0.6),
    )
    stored["interpolations"] = ["bicubic", "hamming"]
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stored), encoding="utf-8")
    with pytest.raises(CheckpointError, match="hamming"):
        settings("letterbox", tmp_path)


@pytest.mark.parametrize("shape", [(48, 64), (224, 224), (31, 17)])
def test_the_centre_crop_samples_the_middle_nine_tenths_of_the_area(shape: tuple[int, int]) -> None:
    """Against scipy's linear interpolation at the places TensorFlow's `crop_and_resize` defines."""
    image, side, factor = picture(shape), 56, np.sqrt(0.9)
    start, stop = (1 - factor) / 2, (1 + factor) / 2
    rows, columns = (np.linspace(start, stop, side) * (extent - 1) for extent in shape)
    grid = np.meshgrid(rows, columns, indexing="ij")
    expected = np.stack([map_coordinates(image[..., c] / 255, grid, order=1) for c in range(3)], axis=-1)
    ours = centre_crop(image, side).astype(int)
    assert ours.shape == (side, side, 3)
    assert np.abs(ours - (expected * 255.5).astype(np.uint8)).max() <= 1
    assert (ours == (expected * 255.5).astype(np.uint8)).mean() > 0.999
