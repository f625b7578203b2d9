"""Pictures on the tiles: one textured quad per tile, and a texture cache of limited size.

PyBullet stretches a texture on a box so that only a corner of it shows, and it loads broken files without an
error. So a tile is a box with a quad of our own mesh on top, and every texture is a PNG we wrote ourselves.
"""

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit.env.simulation.bullet import BulletClient

TEXTURE_PIXELS = 256
"""Side of a texture; a tile covers about 170 pixels of the rendered picture."""
TEXTURE_BUDGET = 128
"""Textures per loaded scene, 0.6 MB each. PyBullet frees none of them before the scene is reloaded."""


def write_quad(path: Path, side: float) -> None:
    """Write a square of `side` metres in the plane z = 0 as OBJ; the top of its picture points to +x."""
    h = side / 2
    corners = "".join(f"v {x} {y} 0\n" for x, y in ((-h, h), (-h, -h), (h, -h), (h, h)))
    picture = "".join(f"vt {u} {v}\n" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)))
    path.write_text(f"{corners}{picture}vn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n", encoding="utf-8")


def as_texture(picture: Image.Image) -> NDArray[np.uint8]:
    """The pixels (256, 256, 3) of a square picture of any size."""
    return np.asarray(picture.convert("RGB").resize((TEXTURE_PIXELS, TEXTURE_PIXELS), Image.Resampling.LANCZOS))


class TextureCache:
    """Textures of one loaded scene by the hash of their pixels, so that each picture is loaded once."""

    def __init__(self, client: BulletClient, folder: Path, budget: int = TEXTURE_BUDGET) -> None:
        self._client = client
        self._folder = folder
        self._budget = budget
        self._ids: dict[str, int] = {}

    def has_room(self, count: int) -> bool:
        """Whether `count` more textures fit into the budget; if not, reload the scene."""
        return len(self._ids) + count <= self._budget

    def load(self, picture: Image.Image) -> int:
        """The texture id of a picture."""
        pixels = as_texture(picture)
        key = hashlib.sha256(pixels.tobytes()).hexdigest()
        if key not in self._ids:
            path = self._folder / f"{key}.png"
            Image.fromarray(pixels).save(path)
            self._ids[key] = self._client.loadTexture(str(path))
            path.unlink()
        return self._ids[key]
