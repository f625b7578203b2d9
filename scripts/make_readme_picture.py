"""The README's picture: `python scripts/make_readme_picture.py DEMO_FOLDER docs/demo.png`."""

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from probe_kit import open_run

MARGIN = 24


def main(demo: Path, target: Path) -> None:
    """Put the first frame of the filmed episode, with its instruction, beside the layer curves."""
    curves = Image.open(demo / "layer_curves.png").convert("RGB")
    with Image.open(demo / "episode.gif") as film:
        frame = film.convert("RGB")
    height = curves.height - 2 * MARGIN - 30
    frame = frame.resize((round(frame.width * height / frame.height), height), Image.Resampling.LANCZOS)
    picture = Image.new("RGB", (frame.width + curves.width + 2 * MARGIN, curves.height), "white")
    picture.paste(frame, (MARGIN, MARGIN + 30))
    picture.paste(curves, (frame.width + 2 * MARGIN, 0))
    instruction = open_run(demo / "run").episodes.iloc[0]["instruction"]
    font = ImageFont.load_default(size=24)
    ImageDraw.Draw(picture).text((MARGIN, MARGIN - 8), f"“{instruction}”", fill="black", font=font)
    picture.resize((1600, round(1600 * picture.height / picture.width)), Image.Resampling.LANCZOS).save(target)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
