"""InternVL: transformers' own network, its tiles and its released sizes. Contains no capture code."""

from probe_kit.models.internvl.network import FILE_NAMES, build_internvl, full_size_internvl
from probe_kit.models.internvl.pictures import TiledPictures

__all__ = ["FILE_NAMES", "TiledPictures", "build_internvl", "full_size_internvl"]
