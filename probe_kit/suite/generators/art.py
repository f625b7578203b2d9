"""Icons: small pictures rendered once by `scripts/build_suite_art.py` and shipped with their licences.

`suite/art/` holds two sheets of 128 px cells, `fluent.png` in colour and `material.png` as grey masks, and
`index.json` with the icon names in the order of the cells. `suite/art/NOTICE.md` says where they come from.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probe_kit.suite.generators.palette import RGB
from probe_kit.suite.pictures import stored_picture

FOLDER = Path(__file__).parents[1] / "art"
CELL_PIXELS = 128
COLUMNS = 12


def color_icon(name: str) -> Image.Image:
    """A Fluent icon, RGBA, 128 px square."""
    return _cell("fluent", name)


def mask_icon(name: str) -> Image.Image:
    """A Material icon as opacity, grey, 128 px square."""
    return _cell("material", name)


@cache
def mean_color(name: str) -> RGB:
    """Average colour of the opaque part of a Fluent icon."""
    pixels = np.asarray(color_icon(name), np.float64).reshape(-1, 4)
    red, green, blue = np.average(pixels[:, :3], axis=0, weights=pixels[:, 3])
    return round(red), round(green), round(blue)


@cache
def _cell(sheet: str, name: str) -> Image.Image:
    row, column = divmod(_index()[sheet].index(name), COLUMNS)
    x, y = column * CELL_PIXELS, row * CELL_PIXELS
    return _sheet(sheet).crop((x, y, x + CELL_PIXELS, y + CELL_PIXELS))


@cache
def _index() -> dict[str, Any]:
    index: dict[str, Any] = json.loads((FOLDER / "index.json").read_text(encoding="utf-8"))
    return index


@cache
def _sheet(name: str) -> Image.Image:
    return stored_picture(FOLDER / f"{name}.png", "RGBA" if name == "fluent" else "L")
