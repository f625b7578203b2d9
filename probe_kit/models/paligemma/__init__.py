"""PaliGemma: transformers' own network, its pictures and its released size. Nothing here listens or answers."""

from probe_kit.models.paligemma.network import FILE_NAMES, build_paligemma, full_size_paligemma
from probe_kit.models.paligemma.pictures import SquarePictures

__all__ = ["FILE_NAMES", "SquarePictures", "build_paligemma", "full_size_paligemma"]
