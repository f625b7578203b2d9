"""Images and camera intrinsics, bit-identical to the original processor."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.models.spatialvla.config import SpatialVLAConfig

PREPROCESSOR_FILE = "preprocessor_config.json"
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class PictureSettings:
    """The preparation of pictures.

    side: in pixels, of the square they are squeezed into. resampling: PIL's number. scale: what the bytes are
    multiplied with. mean, deviation: of a normalisation, None for the released models, which normalise inside.
    """

    side: int
    resampling: int = int(Image.Resampling.BICUBIC)
    scale: float = 1 / 255
    mean: Colour | None = None
    deviation: Colour | None = None

    @classmethod
    def of(cls, config: SpatialVLAConfig, folder: Path) -> "PictureSettings":
        """Read `folder/preprocessor_config.json`, or where there is none take the released models' settings.

        Raises CheckpointError for what contradicts the model or is not known here.
        """
        file = folder / PREPROCESSOR_FILE
        values = load_json(file) if file.is_file() else None
        settings = cls(config.side) if values is None else cls._from_json(values, config.side)
        if settings.side != config.side:
            raise CheckpointError(
                f"{file} makes pictures of side {settings.side}; config.json expects {config.side}"
            )
        if settings.resampling not in {int(resampling) for resampling in Image.Resampling}:
            raise CheckpointError(f"{file}: resample is {settings.resampling}, which PIL does not support")
        return settings

    @classmethod
    def _from_json(cls, values: Mapping[str, Any], side: int) -> "PictureSettings":
        size = values.get("size") or {"height": side, "width": side}
        height, width = int(size.get("height", 0)), int(size.get("width", 0))
        normalises = bool(values.get("do_normalize", True))
        return cls(
            side=height if height == width and values.get("do_resize", True) else -1,
            resampling=int(values.get("resample", Image.Resampling.BICUBIC)),
            scale=float(values.get("rescale_factor", 1 / 255)) if values.get("do_rescale", True) else 1.0,
            mean=_colour(values.get("image_mean", (0.5, 0.5, 0.5))) if normalises else None,
            deviation=_colour(values.get("image_std", (0.5, 0.5, 0.5))) if normalises else None,
        )


def _colour(values: Any) -> Colour:
    red, green, blue = values
    return float(red), float(green), float(blue)


def prepare_picture(picture: NDArray[np.uint8], settings: PictureSettings) -> NDArray[np.float32]:
    """(3, S, S) float32 in [0, 1] from (H, W, 3) uint8; proportions are not kept."""
    square = Image.fromarray(picture).resize((settings.side, settings.side), Image.Resampling(settings.resampling))
    pixels = np.asarray(np.asarray(square, np.float64) * settings.scale, np.float32).transpose(2, 0, 1)
    if settings.mean is not None and settings.deviation is not None:
        mean, deviation = (np.array(c, np.float32)[:, None, None] for c in (settings.mean, settings.deviation))
        return np.asarray((pixels - mean) / deviation, np.float32)
    return np.ascontiguousarray(pixels)


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: its matrix (3, 3) in pixels, for pictures of `width` × `height`."""

    matrix: NDArray[np.floating[Any]]
    width: int
    height: int

    def at(self, side: int) -> NDArray[np.float32]:
        """(3, 3) float32 of the same camera for a picture squeezed into a square of `side` pixels."""
        scaled = self.matrix.astype(np.float32)
        scaled[0] *= np.float32(side / self.width)
        scaled[1] *= np.float32(side / self.height)
        return scaled


def known_cameras(values: Mapping[str, Any], source: str) -> dict[str, Intrinsics]:
    """The cameras of the data sets that `intrinsic_config` of a `processor_config.json` names.

    Raises CheckpointError for a matrix that is not a camera's.
    """
    cameras = {}
    for key, entry in values.get("intrinsic_config", {}).items():
        matrix = np.asarray(entry["intrinsic"], np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or np.linalg.det(matrix) == 0:
            raise CheckpointError(f"{source}: intrinsic_config of {key} is not an invertible 3 × 3 matrix")
        cameras[key] = Intrinsics(matrix, int(entry["width"]), int(entry["height"]))
    return cameras
