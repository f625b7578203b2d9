"""Painting a picture onto a tile of a finished frame, at the resolution of the policy.

Shading, the renderer's nearest texel, crop and resize are all linear in the texture, so that one sparse matrix
per side takes a texture to the low-resolution pixels of its tile.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import sparse

from probe_kit.env.simulation import TEXTURE_PIXELS, as_texture
from probe_kit.hooks.families.embedded import IMAGE_SIDE


@dataclass(frozen=True)
class Brush:
    """The tile of one side.

    Attributes:
        rows: Of the box of the policy's picture that holds the tile.
        columns: Of the same box.
        cover: (h, w) float32 share of each pixel of the box that the tile covers when nothing hides it.
        warp: (h·w, texels) sparse.
    """

    rows: slice
    columns: slice
    cover: NDArray[np.float32]
    warp: sparse.csr_matrix

    def paint(self, picture: Image.Image) -> NDArray[np.float32]:
        """(h, w, 3) float32 in [0, 255]: what the tile adds to the pixels of the box."""
        texels = as_texture(picture).reshape(-1, 3).astype(np.float32)
        return np.asarray(self.warp @ texels, np.float32).reshape(*self.cover.shape, 3)


def ramp() -> Image.Image:
    """A texture that says in red and green which texel is seen, and in blue how it is lit."""
    column = np.tile(np.arange(TEXTURE_PIXELS, dtype=np.uint8), (TEXTURE_PIXELS, 1))
    return Image.fromarray(np.stack([column, column.T, np.full_like(column, 255)], axis=-1))


def brush_of(
    picture: NDArray[np.float64],
    mask: NDArray[np.bool_],
    crop: tuple[int, int, int, int],
    view: Callable[[NDArray[np.uint8]], NDArray[np.uint8]],
) -> Brush:
    """The brush of the tile that `mask` shows in a picture of it with `ramp` on it.

    Args:
        picture: (H, W, 3) of the scene with `ramp` on the tile.
        mask: (H, W), True where the tile is seen.
        crop: Top, left, height, width of what the model looks at.
        view: That crop, resized as the model does.
    """
    shade = np.median(picture[mask][:, 2]) / 255
    texel_position = np.clip(np.rint(picture[mask][:, :2] / shade), 0, TEXTURE_PIXELS - 1).astype(int)
    texel = texel_position[:, 1] * TEXTURE_PIXELS + texel_position[:, 0]
    y, x = np.nonzero(mask)
    down, across = _resize_weights(*crop[2:])
    top, left = crop[:2]
    low = view(255 * np.uint8(mask)).astype(np.float32) / 255
    rows, columns = (_extent(low.any(axis=axis)) for axis in (1, 0))
    weights = np.einsum("ip,jp->ijp", down[rows][:, y - top], across[columns][:, x - left])
    pixels = sparse.csr_matrix(weights.reshape(-1, len(texel)) * shade)
    lookup = sparse.csr_matrix(
        (np.ones(len(texel)), (np.arange(len(texel)), texel)), (len(texel), TEXTURE_PIXELS**2)
    )
    return Brush(rows, columns, low[rows, columns], (pixels @ lookup).astype(np.float32))


def _resize_weights(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The resize as matrices (96, rows of the crop) and (96, columns of the crop)."""
    resize, small = torch.nn.functional.interpolate, IMAGE_SIDE
    options = {"mode": "bilinear", "antialias": True, "align_corners": False}
    down = resize(torch.eye(height)[:, None, :, None].expand(-1, 1, -1, 8), (small, 8), **options)[:, 0, :, 0].T
    across = resize(torch.eye(width)[:, None, None, :].expand(-1, 1, 8, -1), (8, small), **options)[:, 0, 0, :].T
    return down.double().numpy(), across.double().numpy()


def _extent(used: NDArray[np.bool_]) -> slice:
    places = np.flatnonzero(used)
    return slice(int(places[0]), int(places[-1]) + 1)
