"""Where pictures are put, at the resolution of the model: onto the tiles of a frame, or side by side on grey."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit.env import Act2AnswerEnv, SceneSpec
from probe_kit.env.scene import SIDES, Scene
from probe_kit.extract.prompts import GREY, MARGIN
from probe_kit.hooks.families.embedded import CAMERA_PICTURE, IMAGE_SIDE, LOOKED_AT
from vlm_tiny_training.brush import brush_of, ramp
from vlm_tiny_training.window import model_view


class Place(Protocol):
    """Where one picture goes.

    Attributes:
        rows: Of the box that holds it.
        columns: Of the same box.
        cover: (h, w) float32 share of each pixel of the box that it covers when nothing hides it.
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
    env = Act2AnswerEnv(spec)
    env.reset(seed=0)
    views = [_view(env.scene, texture) for texture in (ramp(), Image.new("RGB", ramp().size))]
    env.close()
    (picture, masks), (black, _) = views
    brushes = [brush_of(picture.astype(np.float64), mask, LOOKED_AT, model_view) for mask in masks]
    return Surface(model_view(black).astype(np.float32), (brushes[0], brushes[1]))


def _view(scene: Scene, texture: Image.Image) -> tuple[NDArray[np.uint8], list[NDArray[np.bool_]]]:
    """The scene as it stands, with this texture on both tiles, and which pixels show them."""
    scene.show(dict.fromkeys(SIDES, texture))
    frame = scene.frame()
    return frame.picture, [frame.bodies == scene.quads[side] for side in SIDES]


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
    for area in places:
        background[area.rows, area.columns] *= 1 - area.cover[..., None]
    return Surface(background, (places[0], places[1]))


def _half(top: float, left: float, height: float, width: float) -> Sheet:
    """A picture in that box of pixels, edges rounded to whole ones."""
    first, last = max(0, round(top)), min(IMAGE_SIDE, round(top + height))
    begin, end = max(0, round(left)), min(IMAGE_SIDE, round(left + width))
    cover = np.ones((last - first, end - begin), np.float32)
    return Sheet(slice(first, last), slice(begin, end), cover)
