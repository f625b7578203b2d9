"""Pictures of the paper's two sizes, prepared with the numbers of released files, against their processors."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.hooks.families.internvl.network import TiledPictures
from probe_kit.hooks.families.ovis2_5.network import OvisPictures, full_size_ovis2_5
from probe_kit.hooks.families.paligemma.network import SquarePictures
from probe_kit.hooks.families.shared.qwen.network import QwenPictures, merged_tokens

CLIP = {
    "image_mean": [0.48145466, 0.4578275, 0.40821073], "image_std": [0.26862954, 0.26130258, 0.27577711],
}  # fmt: skip
HALF = {"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
FILES: dict[str, dict[str, Any]] = {
    "qwen2_5_vl": {"patch_size": 14, "temporal_patch_size": 2, "merge_size": 2, "min_pixels": 3136,
                   "max_pixels": 12845056, **CLIP},
    "qwen3_vl": {"patch_size": 16, "temporal_patch_size": 2, "merge_size": 2,
                 "size": {"shortest_edge": 65536, "longest_edge": 16777216}, **HALF},
    "internvl": {"size": {"height": 448, "width": 448}, "crop_to_patches": False, "min_patches": 1,
                 "max_patches": 12, "resample": 3, **IMAGENET},
    "paligemma": {"size": {"height": 224, "width": 224}, "resample": 3, **HALF},
    "ovis2_5": {"size": {"height": 512, "width": 512}, "resample": 2, "rescale_factor": 1 / 255, **HALF},
}  # fmt: skip
Prepared = tuple[NDArray[Any], int]


def _qwen(patch: int) -> Callable[[Path, NDArray[np.uint8]], Prepared]:
    def prepare(folder: Path, picture: NDArray[np.uint8]) -> Prepared:
        pictures = QwenPictures.from_folder(folder, patch, 2, 2, fast=True)
        return pictures.patches([picture])[0].numpy(), merged_tokens(pictures.grid(*picture.shape[:2]), 2)

    return prepare


def _internvl(folder: Path, picture: NDArray[np.uint8]) -> Prepared:
    pictures = TiledPictures.from_folder(folder, 448)
    return pictures.pixels([picture]).numpy(), 256 * pictures.tiles(*picture.shape[:2])


def _paligemma(folder: Path, picture: NDArray[np.uint8]) -> Prepared:
    return SquarePictures.from_folder(folder, 224).pixels([picture]).numpy(), 256


def _ovis(folder: Path, picture: NDArray[np.uint8]) -> Prepared:
    vision = full_size_ovis2_5().config.vision
    pictures = OvisPictures.from_folder(folder, vision)
    return pictures.patches([picture])[0].numpy(), pictures.tokens(*picture.shape[:2]) + 2


PREPARE = {"qwen2_5_vl": _qwen(14), "qwen3_vl": _qwen(16), "internvl": _internvl, "paligemma": _paligemma,
           "ovis2_5": _ovis}  # fmt: skip


@pytest.mark.parametrize("size", ["224x224", "560x480"])
@pytest.mark.parametrize("family", PREPARE)
def test_pictures_are_prepared_as_by_the_released_processors(
    family: str, size: str, golden_vlm: Path, tmp_path: Path
) -> None:
    reference = golden_vlm / "preprocess"
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(FILES[family]), encoding="utf-8")
    expected = json.loads((reference / "dims.json").read_text(encoding="utf-8"))[f"{family}_{size}"]
    with np.load(reference / "reference.npz") as arrays:
        prepared, tokens = PREPARE[family](tmp_path, arrays[f"picture_{size}"])
        recorded = {part: arrays[f"{family}_{size}_{part}"] for part in ("shape", "index", "at", "sum")}
    assert prepared.shape == tuple(recorded["shape"])
    assert tokens == expected["image_tokens"]
    np.testing.assert_allclose(prepared.ravel()[recorded["index"]], recorded["at"], rtol=0, atol=1e-6)
    doubles = prepared.astype(np.float64)
    np.testing.assert_allclose([doubles.sum(), np.abs(doubles).sum()], recorded["sum"], rtol=1e-6)


def test_one_tile_on_wish_shows_the_whole_picture(golden_vlm: Path, tmp_path: Path) -> None:
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(FILES["internvl"]), encoding="utf-8")
    with np.load(golden_vlm / "preprocess" / "reference.npz") as arrays:
        picture = arrays["picture_560x480"]
    tiled, single_tile = (TiledPictures.from_folder(tmp_path, 448, tiled) for tiled in (True, False))
    assert (tiled.tiles(480, 560), single_tile.tiles(480, 560)) == (13, 1)
    np.testing.assert_array_equal(tiled.pixels([picture])[-1:], single_tile.pixels([picture]))
