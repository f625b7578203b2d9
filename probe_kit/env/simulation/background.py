"""The background of the scene under visual matching: a photo, or a drawn wooden table."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.bounded_files import read_regular
from probe_kit.env.rotations import Array
from probe_kit.env.simulation.camera import Camera, Picture
from probe_kit.errors import SceneError
from probe_kit.suite.pictures import decode_bytes

# All colours and numbers of grain are chosen by eye. Pictures, and all that models make of them, depend on each.
PLANK_WIDTH = 0.14
"""Metres."""
TABLE_END = 0.92
"""x at which the table meets a wall, metres."""
DARK_WOOD = np.array([118.0, 78.0, 46.0])
LIGHT_WOOD = np.array([190.0, 146.0, 98.0])
WALL = np.array([196.0, 198.0, 194.0])
SUPERSAMPLING = 2
"""Times as many pixels in each direction are drawn and then scaled down, so that seams are smooth."""


def load_photo(path: Path, width: int, height: int) -> Picture:
    """The photo at `path`, squeezed to (height, width, 3). Raises SceneError if it cannot be read."""
    remedy = "Give another file, or leave `background` out for our own wooden table."
    try:
        encoded = read_regular(path)
    except OSError as error:
        raise SceneError(f"background {path}: cannot be read ({error.strerror}). {remedy}") from error
    picture = decode_bytes(encoded, f"background {path}:", SceneError, remedy)
    return np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS))


@lru_cache(maxsize=8)
def wooden_table(camera: Camera) -> Picture:
    """A table of planks with a wall behind it, (H, W, 3), seen by `camera` in the right perspective."""
    fine = camera.magnified(SUPERSAMPLING)
    rays = fine.rays()
    eye = np.array(fine.spec.eye)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_table = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        to_wall = np.where(rays[..., 0] > 0, (TABLE_END - eye[0]) / rays[..., 0], np.inf)
    nearest = np.minimum(np.minimum(to_table, to_wall), 10.0)  # a ray may meet neither, and is wall
    points = eye + nearest[..., None] * rays
    color = np.where((to_table < to_wall)[..., None], _wood(points), _wall(points))
    picture = Image.fromarray(np.clip(color, 0, 255).astype(np.uint8))
    return np.asarray(picture.resize((camera.spec.width, camera.spec.height), Image.Resampling.LANCZOS))


def _wood(points: Array) -> Array:
    """Colour of the table at world points (..., 3): planks along y, each with its own grain and tone."""
    x, y = points[..., 0], points[..., 1]
    plank = np.floor(x / PLANK_WIDTH)
    shift = 7.3 * plank
    rings = np.sin(2 * np.pi * (9 * x + 1.6 * _noise(3 * x + shift, 1.5 * y, 1) + shift))
    fibre = _noise(260 * x, 9 * y + shift, 2)
    tone = _noise(5.7 * plank, 0 * y, 3)
    lightness = 0.45 + 0.16 * rings + 0.30 * (fibre - 0.5) + 0.35 * (tone - 0.5)
    seam = np.abs(x / PLANK_WIDTH - plank - 0.5) > 0.49
    shade = (1.06 - 0.35 * np.hypot(x - 0.3, y - 0.1)) * np.where(seam, 0.62, 1.0)
    return np.asarray((DARK_WOOD + lightness[..., None] * (LIGHT_WOOD - DARK_WOOD)) * shade[..., None])


def _wall(points: Array) -> Array:
    y, z = points[..., 1], points[..., 2]
    shade = 0.90 + 0.08 * np.tanh(4 * z) + 0.03 * (_noise(3 * y, 3 * z, 4) - 0.5)
    return np.asarray(WALL * shade[..., None])


def _noise(u: Array, v: Array, seed: int) -> Array:
    """Smooth noise in [0, 1] on the plane: random values on a grid that repeats every 64 cells."""
    grid: NDArray[np.float64] = np.random.default_rng(seed).random((64, 64))
    cell_u, cell_v = np.floor(u).astype(int), np.floor(v).astype(int)
    s, t = _ease(u - cell_u), _ease(v - cell_v)
    near = (1 - s) * grid[cell_u % 64, cell_v % 64] + s * grid[(cell_u + 1) % 64, cell_v % 64]
    far = (1 - s) * grid[cell_u % 64, (cell_v + 1) % 64] + s * grid[(cell_u + 1) % 64, (cell_v + 1) % 64]
    return np.asarray((1 - t) * near + t * far)


def _ease(share: Array) -> Array:
    return np.asarray(share * share * (3 - 2 * share))
