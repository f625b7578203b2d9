"""The adapter for InternVL: Qwen's chat without a system turn, pictures as tiles."""

from functools import cached_property
from typing import Any, ClassVar

from torch import Tensor
from transformers import InternVLConfig

from probe_kit.errors import UsageError
from probe_kit.hooks.families.internvl.network import FILE_NAMES, TiledPictures, build_internvl
from probe_kit.hooks.families.shared.loading import Loaded, Recipe
from probe_kit.hooks.families.shared.qwen.adapter import ASSISTANT, USER
from probe_kit.hooks.families.shared.taps import TOWER, Stack
from probe_kit.hooks.families.shared.text import QuestionFrame
from probe_kit.hooks.families.shared.vlm import Pictures, VisionLanguageModel

TILES = ("auto", "1")


class InternVL(VisionLanguageModel):
    """A loaded InternVL; its option `tiles` is `auto`, which cuts pictures as released, or `1`, one for each."""

    family: ClassVar[str] = "internvl"
    frame: ClassVar[QuestionFrame] = QuestionFrame(f"{USER}<img>", "</img>\n", USER, ASSISTANT)
    recipe: ClassVar[Recipe] = Recipe(InternVLConfig.from_dict, build_internvl, FILE_NAMES)
    picture_token: ClassVar[str | None] = "<IMG_CONTEXT>"

    def __init__(self, loaded: Loaded[Any], tokenizer: str | None = None, tiles: str = "auto") -> None:
        if tiles not in TILES:
            raise UsageError(f"tiles is {tiles!r}; expected {' or '.join(TILES)}")
        self.tiles = tiles
        super().__init__(loaded, tokenizer, tiles=tiles)

    @cached_property
    def vision(self) -> Stack:
        """The vision tower; the last site is what leaves it. There is a row per tile."""
        tower, width = self.network.model.vision_tower, int(self.network.config.vision_config.hidden_size)
        return Stack(tower.encoder.layer, tower.layernorm, width, None, "layernorm_before", stream_fields=TOWER)

    @property
    def _side(self) -> int:
        return int(self.network.config.vision_config.image_size[0])

    @cached_property
    def pictures(self) -> TiledPictures:
        """The processor of pictures into tiles."""
        return TiledPictures.from_folder(self.loaded.folder, self._side, self.tiles == "auto")

    def picture_ids(self, height: int, width: int) -> list[int]:
        """Return the ids of a picture: per tile its patches after neighbours were joined."""
        config = self.network.config
        patches = self._side // int(config.vision_config.patch_size[0])
        joined = int(patches * float(config.downsample_ratio)) ** 2
        return [int(config.image_token_id)] * (joined * self.pictures.tiles(height, width))

    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """Return `pixel_values` (tiles of all pictures, 3, S, S)."""
        return {"pixel_values": self.pictures.pixels(pictures).to(self.loaded.device)}
