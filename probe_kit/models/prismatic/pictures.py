"""Images to pixel values, bit-identical to the original processor, with PIL and numpy only.

Channels 3k … 3k+2 are what tower k reads: the same pixels, resized to its side and normalised with its own means.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.bounded_json import load_json
from probe_kit._system.optional_dependencies import require
from probe_kit.errors import CheckpointError
from probe_kit.models.prismatic.config import RESIZE_STRATEGIES, PrismaticConfig

Colour = tuple[float, float, float]
_RESAMPLING = {"bicubic": Image.Resampling.BICUBIC, "bilinear": Image.Resampling.BILINEAR}
# Fine-tunes with augmentation saw random crops of nine tenths of the area; their evaluation takes the middle one.
CROP_AREA = 0.9


@dataclass(frozen=True)
class PictureSettings:
    """The preparation of pictures: per tower its side, colour means, deviations and resampling."""

    strategy: str
    sides: tuple[int, ...]
    means: tuple[Colour, ...]
    deviations: tuple[Colour, ...]
    resampling: tuple[str, ...]

    @classmethod
    def of(cls, config: PrismaticConfig, folder: Path) -> "PictureSettings":
        """Read `folder/preprocessor_config.json`, or where there is none the settings of timm's towers.

        Raises CheckpointError for what is not known here.
        """
        file = folder / "preprocessor_config.json"
        settings = cls._from_file(file) if file.is_file() else cls._from_timm(config)
        unknown = {*settings.resampling} - {*_RESAMPLING} | {settings.strategy} - {*RESIZE_STRATEGIES}
        if unknown:
            raise CheckpointError(f"{file}: pictures are prepared with {', '.join(sorted(unknown))}, unknown here")
        if settings.sides != (sides := tuple(tower.image_size for tower in config.towers)):
            raise CheckpointError(f"{file} makes pictures of side {settings.sides}; config.json expects {sides}")
        return settings

    @classmethod
    def _from_file(cls, file: Path) -> "PictureSettings":
        values = load_json(file)
        return cls(
            values["image_resize_strategy"],
            tuple(int(size[-1]) for size in values["input_sizes"]),
            tuple(map(_colour, values["means"])),
            tuple(map(_colour, values["stds"])),
            tuple(values["interpolations"]),
        )

    @classmethod
    def _from_timm(cls, config: PrismaticConfig) -> "PictureSettings":
        cards = [require("timm", "openvla").get_pretrained_cfg(tower.timm_id) for tower in config.towers]
        return cls(
            config.resize,
            tuple(tower.image_size for tower in config.towers),
            tuple(_colour(card.mean) for card in cards),
            tuple(_colour(card.std) for card in cards),
            tuple(card.interpolation for card in cards),
        )


def _colour(values: list[float]) -> Colour:
    red, green, blue = values
    return red, green, blue


def prepare_picture(picture: NDArray[np.uint8], settings: PictureSettings) -> NDArray[np.float32]:
    """(3 per tower, S, S) float32 from (H, W, 3) uint8."""
    image = Image.fromarray(picture)
    if settings.strategy == "letterbox":
        # The original loops over the towers and keeps the last one's colour; the padding is the same for all.
        image = _padded_to_square(image, settings.means[-1])
    fit = _squeezed if settings.strategy == "resize-naive" else _scaled_and_cropped
    towers = zip(settings.sides, settings.means, settings.deviations, settings.resampling, strict=True)
    return np.concatenate([_tower(image, fit, *tower) for tower in towers])


def _tower(
    image: Image.Image,
    fit: Callable[[Image.Image, int, Image.Resampling], Image.Image],
    side: int,
    mean: Colour,
    deviation: Colour,
    resampling: str,
) -> NDArray[np.float32]:
    pixels = np.asarray(fit(image, side, _RESAMPLING[resampling]), np.float32) / np.float32(255)
    normalised = (pixels - np.asarray(mean, np.float32)) / np.asarray(deviation, np.float32)
    return np.asarray(normalised.transpose(2, 0, 1), np.float32)


def _squeezed(image: Image.Image, side: int, resampling: Image.Resampling) -> Image.Image:
    return image.resize((side, side), resampling)


def _scaled_and_cropped(image: Image.Image, side: int, resampling: Image.Resampling) -> Image.Image:
    """The shorter side becomes `side`, the middle of the longer one is kept; rounding as torchvision does it."""
    width, height = image.size
    if width <= height:
        width, height = side, int(side * height / width)
    else:
        width, height = int(side * width / height), side
    column, top = round((width - side) / 2), round((height - side) / 2)
    scaled = image if image.size == (width, height) else image.resize((width, height), resampling)
    return scaled.crop((column, top, column + side, top + side))


def _padded_to_square(image: Image.Image, mean: Colour) -> Image.Image:
    """Centred on the mean colour; a pixel short of square where the sides differ by an odd number."""
    longer = max(image.size)
    column, top = ((longer - side) // 2 for side in image.size)
    red, green, blue = (int(255 * value) for value in mean)
    square = Image.new("RGB", (image.width + 2 * column, image.height + 2 * top), (red, green, blue))
    square.paste(image, (column, top))
    return square


def centre_crop(picture: NDArray[np.uint8], side: int, area: float = CROP_AREA) -> NDArray[np.uint8]:
    """(side, side, 3) uint8: the middle `area` of (H, W, 3) uint8, both sides scaled by √area.

    Bilinear between pixel centres, corners on corners, as TensorFlow's `crop_and_resize` samples.
    """
    factor = np.float32(np.sqrt(area))
    rows, columns = (_samples(extent, side, factor) for extent in picture.shape[:2])
    pixels = picture.astype(np.float32) / np.float32(255)
    cropped = _between(_between(pixels, rows, 0), columns, 1)
    return (np.clip(cropped, 0, 1) * np.float32(255.5)).astype(np.uint8)


def _samples(extent: int, side: int, factor: np.float32) -> NDArray[np.float32]:
    """(side,) where to sample an axis of `extent` pixels."""
    start = (1 - factor) / 2 * (extent - 1)
    step = factor * (extent - 1) / max(1, side - 1)
    return np.asarray(start + np.arange(side) * step, np.float32)


def _between(pixels: NDArray[np.float32], places: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    low = np.floor(places).astype(np.intp)
    high = np.minimum(low + 1, pixels.shape[axis] - 1)
    shape = [1] * pixels.ndim
    shape[axis] = -1
    share = (places - low).reshape(shape)
    below, above = pixels.take(low, axis), pixels.take(high, axis)
    return np.asarray(below + (above - below) * share, np.float32)
