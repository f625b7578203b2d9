""""""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from probe_kit.errors import CheckpointError, ObservationError
from probe_kit.hooks.families.shared.qwen.network import QwenPictures, image_slots, merged_tokens
from tests.support.qwen_checkpoints import picture_settings


def test_every_picture_gets_its_own_number_of_tokens() -> None:
    assert image_slots([1, 9, 2, 9, 3], 9, [3, 1]) == [1, 9, 9, 9, 2, 9, 3]


def test_another_number_of_slots_than_pictures_is_an_error() -> None:
    with pytest.raises(CheckpointError, match="2 image tokens"):
        image_slots([9, 9], 9, [4])


def settings(folder: Path, patch: int = 16, **fields: Any) -> QwenPictures:
    (folder / "preprocessor_config.json").write_text(
        json.dumps(picture_settings(patch, 4096, 65536, **fields)), encoding="utf-8"
    )
    return QwenPictures.from_folder(folder, patch, 2, 2)


def picture(height: int, width: int) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def by_hand(pixels: NDArray[np.uint8], size: tuple[int, int], patch: int) -> NDArray[np.float32]:
    """Patches in the order of the merged tokens, each channel, then its two equal moments, then its rows."""
    rows, columns = size[0] // patch, size[1] // patch
    resized = np.asarray(Image.fromarray(pixels).resize((size[1], size[0]), Image.Resampling.BICUBIC), np.float64)
    scaled = (resized * (1 / 255)).astype(np.float32)
    values = (scaled - np.float32(0.5)) / np.float32(0.5)
    patches = []
    for row, column in ((r, c) for r in range(0, rows, 2) for c in range(0, columns, 2)):
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            top, left = (row + down) * patch, (column + right) * patch
            cut = values[top : top + patch, left : left + patch].transpose(2, 0, 1)
            patches.append(np.stack([cut, cut], axis=1).ravel())
    return np.stack(patches)


@pytest.mark.parametrize("shape", [(128, 128), (96, 160), (300, 401), (50, 40)])
def test_patches_are_those_written_out_by_hand_bit_for_bit(shape: tuple[int, int], tmp_path: Path) -> None:
    prepared = settings(tmp_path)
    values, grid = prepared.patches([picture(*shape)])
    rows, columns = prepared.grid(*shape)
    assert grid.tolist() == [[1, rows, columns]]
    np.testing.assert_array_equal(values.numpy(), by_hand(picture(*shape), (rows * 16, columns * 16), 16))
    assert merged_tokens((rows, columns), 2) == len(values) // 4


def test_pixels_stay_within_the_bounds_whatever_the_size(tmp_path: Path) -> None:
    prepared = settings(tmp_path)
    for shape in ((20, 20), (400, 400), (1000, 130), (256, 256)):
        rows, columns = prepared.grid(*shape)
        assert 4096 <= rows * columns * 256 <= 65536
        assert rows % 2 == columns % 2 == 0


def test_the_older_names_of_the_bounds_mean_the_same(tmp_path: Path) -> None:
    new = settings(tmp_path)
    old = settings(tmp_path, size=None, min_pixels=4096, max_pixels=65536)
    assert new == old


def test_the_two_processors_differ_only_in_last_bits_where_nothing_is_resized(tmp_path: Path) -> None:
    settings(tmp_path)
    both = [QwenPictures.from_folder(tmp_path, 16, 2, 2, fast=fast) for fast in (False, True)]
    slow, fast = (prepared.patches([picture(96, 96)])[0] for prepared in both)
    assert 0 < (slow - fast).abs().max() < 1e-6


def test_settings_of_another_network_are_refused(tmp_path: Path) -> None:
    settings(tmp_path, patch=14)
    with pytest.raises(CheckpointError, match=r"\(14, 2, 2\).*\(16, 2, 2\)"):
        QwenPictures.from_folder(tmp_path, 16, 2, 2)
    with pytest.raises(CheckpointError, match="missing"):
        QwenPictures.from_folder(tmp_path / "elsewhere", 16, 2, 2)


def test_missing_numbers_are_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="min_pixels"):
        settings(tmp_path, size=None)
    content = picture_settings(16, 1, 2)
    del content["image_mean"]
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CheckpointError, match="image_mean"):
        QwenPictures.from_folder(tmp_path, 16, 2, 2)


def test_a_ribbon_of_a_picture_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(ObservationError, match="too long"):
        settings(tmp_path).patches([picture(2, 500)])
