"""PaliGemma: transformers' own network, its image processing and its released size. Contains no capture code."""

from probe_kit.models.paligemma.network import FILE_NAMES, build_paligemma, full_size_paligemma
from probe_kit.models.paligemma.pictures import SquarePictures

__all__ = ["FILE_NAMES", "SquarePictures", "build_paligemma", "full_size_paligemma"]
