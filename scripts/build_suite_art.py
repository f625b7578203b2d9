"""Renders the icons of the embedded suite into `probe_kit/suite/art/` (developers only, needs `resvg-py`).

    npm pack @iconify-json/fluent-emoji-flat@1.2.6 @iconify-json/ic@1.2.4
    python scripts/build_suite_art.py FOLDER_WITH_BOTH_TGZ

Which icons are wanted is read from the generators. The two sheets, their index and the checksums in NOTICE.md are
written anew; the licence texts beside them are kept by hand.
"""

import hashlib
import io
import json
import sys
import tarfile
from pathlib import Path
from typing import Any

import resvg_py
from PIL import Image

from probe_kit.suite.generators.drawing import CELL_PIXELS, COLUMNS, FOLDER
from probe_kit.suite.generators.living_world import CREATURES, THINGS
from probe_kit.suite.generators.public_info import PICTOGRAMS
from probe_kit.suite.generators.traffic import ROAD_SIGN_ICONS

FLUENT_PACKAGE = "iconify-json-fluent-emoji-flat-1.2.6.tgz"
MATERIAL_PACKAGE = "iconify-json-ic-1.2.4.tgz"
COLORS = 256  # of the whole colour sheet, opacity included

NOTICE = """# Where this art comes from

The pictures in this folder were rendered, without any other change, from two icon sets that are published as
packages of the npm registry. `scripts/build_suite_art.py` made them.

- `fluent.png`: Fluent Emoji Flat by Microsoft Corporation, MIT (`LICENSE-fluent.txt`),
  from `@iconify-json/fluent-emoji-flat` 1.2.6, package sha256 `{fluent}`
- `material.png`: Google Material Icons 1.0.32 by the Material Design Authors, Apache-2.0 (`LICENSE-material.txt`),
  from `@iconify-json/ic` 1.2.4, package sha256 `{material}`

sha256 of `fluent.png`: `{fluent_sheet}`
sha256 of `material.png`: `{material_sheet}`
"""


def main(packages: Path) -> None:
    """Writes sheets, index and notice from the two packages in a folder."""
    fluent = sorted({creature.icon for creature in CREATURES} | set(THINGS))
    material = sorted({pictogram.icon for pictogram in PICTOGRAMS} | set(ROAD_SIGN_ICONS))
    fluent_set, material_set = read_set(packages / FLUENT_PACKAGE), read_set(packages / MATERIAL_PACKAGE)
    colored = sheet([render(fluent_set, name) for name in fluent])
    colored = colored.quantize(COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    colored.save(FOLDER / "fluent.png", optimize=True)
    masks = [render(material_set, f"baseline-{name}").getchannel("A") for name in material]
    sheet(masks).quantize(16).save(FOLDER / "material.png", optimize=True)
    index = json.dumps({"fluent": fluent, "material": material}, indent=1)
    (FOLDER / "index.json").write_text(f"{index}\n", encoding="utf-8")
    notice = NOTICE.format(
        fluent=sha256(packages / FLUENT_PACKAGE),
        material=sha256(packages / MATERIAL_PACKAGE),
        fluent_sheet=sha256(FOLDER / "fluent.png"),
        material_sheet=sha256(FOLDER / "material.png"),
    )
    (FOLDER / "NOTICE.md").write_text(notice, encoding="utf-8")


def read_set(package: Path) -> dict[str, Any]:
    """The icon set inside an npm package."""
    with tarfile.open(package) as archive:
        member = archive.extractfile("package/icons.json")
        assert member is not None, package
        icons: dict[str, Any] = json.load(member)
    return icons


def render(icons: dict[str, Any], name: str) -> Image.Image:
    """One icon in black or its own colours, RGBA."""
    alias = icons.get("aliases", {}).get(name, {"parent": name})
    side = icons["height"]
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {side} {side}">'
        f"{icons['icons'][alias['parent']]['body']}</svg>"
    )
    png = resvg_py.svg_to_bytes(svg_string=svg, width=CELL_PIXELS, height=CELL_PIXELS)
    return Image.open(io.BytesIO(bytes(png))).convert("RGBA")


def sheet(cells: list[Image.Image]) -> Image.Image:
    """All cells in rows."""
    rows = -(-len(cells) // COLUMNS)
    image = Image.new(cells[0].mode, (COLUMNS * CELL_PIXELS, rows * CELL_PIXELS))
    for number, cell in enumerate(cells):
        row, column = divmod(number, COLUMNS)
        image.paste(cell, (column * CELL_PIXELS, row * CELL_PIXELS))
    return image


def sha256(path: Path) -> str:
    """Hex digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
