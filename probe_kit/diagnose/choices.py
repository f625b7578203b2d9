"""Defaults of a diagnosis, without imports."""

FRAMES = 24
ITEMS_PER_FRAME = 2
"""Items of a category that are extracted for every frame: two of them share their pictures, and are one group."""
