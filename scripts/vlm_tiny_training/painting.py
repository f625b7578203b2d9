"""Where pictures are put, at the resolution of the model: onto the tiles of a frame, or side by side on grey.

Shading, the renderer's nearest texel, crop and resize are all linear in the texture, so that one sparse matrix
per side takes a texture to the low-resolution pixels of its tile.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import sparse

from probe_kit.env import Act2AnswerEnv, SceneSpec
from probe_kit.env.scene import SIDES, Scene
from probe_kit.env.tiles import TEXTURE_PIXELS, as_texture
from probe_kit.extract.asking.pictures import GREY, MARGIN
from probe_kit.models.pi0_tiny import IMAGE_SIDE
from probe_kit.models.vlm_tiny import CAMERA_PICTURE, LOOKED_AT
from vlm_tiny_training.window import seen


class Place(Protocol):
    """Where one picture goes.

    rows, columns: the box that holds it. cover: (h, w) float32 share of each pixel of the box that it covers when
    nothing hides it.
    """

    rows: slice
    columns: slice
    cover: NDArray[np.float32]

    def paint(self, picture: Image.Image) -> NDArray[np.float32]:
        """(h, w, 3) float32 in [0, 255]: what the picture adds to the pixels of the box."""


@dataclass(frozen=True)
class Surface:
    """Two places, and what is seen without pictures on them: (96, 96, 3) float32."""

    background: NDArray[np.float32]
    places: tuple[Place, Place]


@dataclass(frozen=True)
class Brush:
    """The tile of one side, a `Place`. warp: (h·w, texels) sparse."""

    rows: slice
    columns: slice
    cover: NDArray[np.float32]
    warp: sparse.csr_matrix

    def paint(self, picture: Image.Image) -> NDArray[np.float32]:
        """See `Place`."""
        texels = as_texture(picture).reshape(-1, 3).astype(np.float32)
        return np.asarray(self.warp @ texels, np.float32).reshape(*self.cover.shape, 3)


@dataclass(frozen=True)
class Sheet:
    """One half of a side-by-side picture, a `Place`."""

    rows: slice
    columns: slice
    cover: NDArray[np.float32]

    def paint(self, picture: Image.Image) -> NDArray[np.float32]:
        """See `Place`."""
        small = picture.convert("RGB").resize(self.cover.shape[::-1], Image.Resampling.BILINEAR)
        return np.asarray(small, np.float32) * self.cover[..., None]


def calibrate(spec: SceneSpec) -> Surface:
    """The first frame of an episode with black tiles, and where its tiles are, read off a coordinate texture."""
    column = np.tile(np.arange(TEXTURE_PIXELS, dtype=np.uint8), (TEXTURE_PIXELS, 1))
    ramp = Image.fromarray(np.stack([column, column.T, np.full_like(column, 255)], axis=-1))
    env = Act2AnswerEnv(spec)
    env.reset(seed=0)
    views = [_view(env.scene, texture) for texture in (ramp, Image.new("RGB", ramp.size))]
    env.close()
    (picture, masks), (black, _) = views
    brushes = [_brush(picture.astype(np.float64), mask) for mask in masks]
    return Surface(seen(black).astype(np.float32), (brushes[0], brushes[1]))


def _view(scene: Scene, texture: Image.Image) -> tuple[NDArray[np.uint8], list[NDArray[np.bool_]]]:
    """The scene as it stands, with this texture on both tiles, and which pixels show them."""
    for side in SIDES:
        scene.client.changeVisualShape(scene.quads[side], -1, textureUniqueId=scene.textures.load(texture))
    frame = scene.frame()
    return scene.picture(frame), [frame.bodies == scene.quads[side] for side in SIDES]


def sheet(height: int, width: int) -> Surface:
    """The surface of `probe-kit ask --picture side-by-side` for pictures of that size."""
    gap = round(MARGIN * width)
    side = min((width - 3 * gap) // 2, height - 2 * gap)
    crop_top, crop_left, rows, columns = LOOKED_AT
    tall, wide = CAMERA_PICTURE
    down, across = IMAGE_SIDE * tall / (rows * height), IMAGE_SIDE * wide / (columns * width)
    top = (height - side) // 2 - crop_top * height / tall
    places = []
    for middle in (width // 4, width - width // 4):
        left = middle - side // 2 - crop_left * width / wide
        places.append(_half(top * down, left * across, side * down, side * across))
    background = np.full((IMAGE_SIDE, IMAGE_SIDE, 3), GREY, np.float32)
    for place in places:
        background[place.rows, place.columns] *= 1 - place.cover[..., None]
    return Surface(background, (places[0], places[1]))


def _half(top: float, left: float, height: float, width: float) -> Sheet:
    """A picture in that box of pixels, edges rounded to whole ones."""
    first, last = max(0, round(top)), min(IMAGE_SIDE, round(top + height))
    begin, end = max(0, round(left)), min(IMAGE_SIDE, round(left + width))
    cover = np.ones((last - first, end - begin), np.float32)
    return Sheet(slice(first, last), slice(begin, end), cover)


def _brush(picture: NDArray[np.float64], mask: NDArray[np.bool_]) -> Brush:
    shade = np.median(picture[mask][:, 2]) / 255
    place = np.clip(np.rint(picture[mask][:, :2] / shade), 0, TEXTURE_PIXELS - 1).astype(int)
    texel = place[:, 1] * TEXTURE_PIXELS + place[:, 0]
    y, x = np.nonzero(mask)
    down, across = _resize_weights()
    top, left = LOOKED_AT[:2]
    low = seen(255 * np.uint8(mask)).astype(np.float32) / 255
    rows, columns = (_extent(low.any(axis=axis)) for axis in (1, 0))
    weights = np.einsum("ip,jp->ijp", down[rows][:, y - top], across[columns][:, x - left])
    pixels = sparse.csr_matrix(weights.reshape(-1, len(texel)) * shade)
    lookup = sparse.csr_matrix(
        (np.ones(len(texel)), (np.arange(len(texel)), texel)), (len(texel), TEXTURE_PIXELS**2)
    )
    return Brush(rows, columns, low[rows, columns], (pixels @ lookup).astype(np.float32))


def _resize_weights() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The resize as matrices (96, rows of the crop) and (96, columns of the crop)."""
    _, _, height, width = LOOKED_AT
    size = IMAGE_SIDE, IMAGE_SIDE
    resize = torch.nn.functional.interpolate
    options = {"mode": "bilinear", "antialias": True, "align_corners": False}
    down = resize(torch.eye(height)[:, None, :, None].expand(-1, 1, -1, 8), (size[0], 8), **options)[:, 0, :, 0].T
    across = resize(torch.eye(width)[:, None, None, :].expand(-1, 1, 8, -1), (8, size[1]), **options)[:, 0, 0, :].T
    return down.double().numpy(), across.double().numpy()


def _extent(used: NDArray[np.bool_]) -> slice:
    places = np.flatnonzero(used)
    return slice(int(places[0]), int(places[-1]) + 1)
