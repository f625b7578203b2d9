"""InternVL: transformers' own network, its tiles and its released sizes. Nothing here listens or answers."""

from probe_kit.models.internvl.network import FILE_NAMES, build_internvl, full_size_internvl
from probe_kit.models.internvl.pictures import TiledPictures

__all__ = ["FILE_NAMES", "TiledPictures", "build_internvl", "full_size_internvl"]
