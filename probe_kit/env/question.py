"""The question of one episode in one layout: instruction, decoded pictures, correct side."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from PIL import Image

from probe_kit.errors import SceneError
from probe_kit.suite.items import LAYOUTS, Episode, Item, Layout, Side, other_side

_SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class Question:
    """An instruction with the picture of each side in one layout.

    pictures: RGB images by the side they lie on *in this layout*. side_correct: likewise.
    """

    name: str
    instruction: str
    pictures: Mapping[Side, Image.Image]
    side_correct: Side
    layout: Layout

    @classmethod
    def from_item(cls, item: Item, layout: Layout) -> Self:
        """The question of an item. An item without hashes is taken as it is.

        Raises SuiteError if a picture is missing or broken, or has other pixels than the item says.
        """
        from probe_kit.suite.pictures import load_picture

        episode = Episode(item, _checked(layout))
        left, right = (load_picture(episode.picture(side), episode.pixels_sha256(side) or None) for side in _SIDES)
        return cls(
            episode.episode_id, item.instruction, {"left": left, "right": right}, episode.side_correct, layout
        )

    @classmethod
    def built_in(cls, layout: Layout = "original") -> Self:
        """Two plain pictures for trying the environment without a suite: blue is correct, orange is wrong."""
        side: Side = "left" if _checked(layout) == "original" else "right"
        blue, orange = (Image.new("RGB", (64, 64), color) for color in ("royalblue", "darkorange"))
        pictures = {side: blue, other_side(side): orange}
        return cls(f"built-in:{layout[0]}", "Put the cube on the blue picture", pictures, side, layout)


def _checked(layout: Layout) -> Layout:
    if layout not in LAYOUTS:
        raise SceneError(f"layout {layout!r} does not exist; expected one of {', '.join(LAYOUTS)}.")
    return layout
