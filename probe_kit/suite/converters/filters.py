"""Filters of pictures and instructions that may become items."""

import unicodedata
from collections.abc import Callable

import numpy as np
from PIL import Image

from probe_kit.suite.converters.options import ConvertOptions
from probe_kit.suite.wording import side_words

_LEAST_EDGE_ENERGY = 0.25  # of the original, after a picture was as small as on the screen


def picture_problem(image: Image.Image, options: ConvertOptions, least_side: int | None = None) -> str | None:
    """Why the picture cannot be used, None if it can."""
    if min(image.size) < (options.min_side if least_side is None else least_side):
        return "picture too small"
    if max(image.size) > options.max_aspect * min(image.size):
        return "picture too long"
    grey = np.asarray(image.convert("L"), np.float64)
    if max(grey.std(), np.asarray(image, np.float64).std(axis=(0, 1)).max()) < options.min_spread:
        return "picture nearly blank"
    if options.legible_at is not None and _edges_lost(image, options.legible_at):
        return "picture not legible on a tile"
    return None


def _edges_lost(image: Image.Image, tile: int) -> bool:
    small = image.resize((tile, tile), Image.Resampling.LANCZOS).resize(image.size, Image.Resampling.BICUBIC)
    return _edge_energy(small) < _LEAST_EDGE_ENERGY * _edge_energy(image)


def _edge_energy(image: Image.Image) -> float:
    grey = np.asarray(image.convert("L"), np.float64)
    return float(sum((np.diff(grey, axis=axis) ** 2).sum() for axis in (0, 1)))


def text_problem(instruction: str, phrase: str, options: ConvertOptions) -> str | None:
    """Why the instruction cannot be used, None if it can."""
    text = unicodedata.normalize("NFKC", instruction)
    checks: dict[str, Callable[[], bool]] = {
        "instruction has too many words": lambda: len(text.split()) > options.max_words,
        "instruction too long": lambda: len(text) > options.max_characters,
        "instruction is more than one sentence": lambda: any(
            mark in text.rstrip(".") for mark in (". ", "? ", "! ", "\n")
        ),
        "instruction ends with a period": lambda: text.endswith("."),
        "instruction is not plain ASCII": lambda: (
            not options.allow_unicode and not (text.isascii() and text.isprintable())
        ),
        "instruction names no object": lambda: not phrase.strip(),
        "instruction names a side": lambda: bool(side_words(text)),
    }
    return next((reason for reason, failed in checks.items() if failed()), None)
