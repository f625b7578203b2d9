"""The picture of README and start page: one question on the table, and the layer curves of the same run."""

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from probe_kit import open_run

TARGET = Path(__file__).parents[1] / "docs" / "demo.png"
MADE_FROM = "probe_kit.probes"
"""Key of the text in the PNG that says which probe results it shows."""
WIDTH, MARGIN, HEADING = 1600, 24, 56


def draw_picture(demo: Path, probes: str, target: Path = TARGET) -> None:
    """Put the first frame of the filmed episode, with its instruction, beside the layer curves."""
    curves = Image.open(demo / "layer_curves.png").convert("RGB")
    curves = curves.resize((WIDTH, round(WIDTH * curves.height / curves.width)), Image.Resampling.LANCZOS)
    with Image.open(demo / "episode.gif") as film:
        frame = film.convert("RGB")
    height = curves.height - 2 * MARGIN - HEADING
    frame = frame.resize((round(frame.width * height / frame.height), height), Image.Resampling.LANCZOS)
    picture = Image.new("RGB", (frame.width + curves.width + 2 * MARGIN, curves.height), "white")
    picture.paste(frame, (MARGIN, MARGIN + HEADING))
    picture.paste(curves, (frame.width + 2 * MARGIN, 0))
    instruction = open_run(demo / "run").episodes.iloc[0]["instruction"]
    font = ImageFont.load_default(size=40)
    ImageDraw.Draw(picture).text((MARGIN, MARGIN - 4), f"“{instruction}”", fill="black", font=font)
    origin = PngInfo()
    origin.add_text(MADE_FROM, probes)
    height = round(WIDTH * picture.height / picture.width)
    picture.resize((WIDTH, height), Image.Resampling.LANCZOS).save(target, pnginfo=origin, optimize=True)
