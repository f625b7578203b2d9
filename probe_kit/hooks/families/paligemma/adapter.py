"""The adapter for PaliGemma: image, beginning of sequence, question, newline, with bidirectional attention."""

from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor
from transformers import PaliGemmaConfig

from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.families.paligemma.network import FILE_NAMES, SquarePictures, build_paligemma
from probe_kit.hooks.families.shared.loading import Recipe
from probe_kit.hooks.families.shared.taps import TOWER, Stack
from probe_kit.hooks.families.shared.text import QuestionFrame
from probe_kit.hooks.families.shared.vlm import Pictures, VisionLanguageModel
from probe_kit.models.decoding import LeftPacked
from probe_kit.models.embedded import embedded_checkpoint

_FIRST_POSITION = 1


class PaliGemma(VisionLanguageModel):
    """A loaded PaliGemma."""

    family: ClassVar[str] = "paligemma"
    frame: ClassVar[QuestionFrame] = QuestionFrame("", "<bos>", "<bos>", "\n")
    recipe: ClassVar[Recipe] = Recipe(PaliGemmaConfig.from_dict, build_paligemma, FILE_NAMES)
    picture_token: ClassVar[str | None] = "<image>"

    @cached_property
    def vision(self) -> Stack:
        """The vision tower; the last site enters the norm that ends it."""
        tower, width = self.network.model.vision_tower.vision_model, self.network.config.vision_config.hidden_size
        layers, norm = tower.encoder.layers, tower.post_layernorm
        return Stack(layers, norm, int(width), None, "layer_norm1", stream_fields=TOWER)

    @cached_property
    def pictures(self) -> SquarePictures:
        """The processor of pictures into squares."""
        return SquarePictures.from_folder(self.loaded.folder, int(self.network.config.vision_config.image_size))

    def picture_ids(self, height: int, width: int) -> list[int]:
        """Return the ids at a picture's positions, as many for every size.

        A picture is shrunk to the tower's square.
        """
        del height, width
        vision = self.network.config.vision_config
        return [int(self.network.config.image_token_id)] * (vision.image_size // vision.patch_size) ** 2

    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """Return `pixel_values` (B, 3, S, S)."""
        return {"pixel_values": self.pictures.pixels(pictures).to(self.loaded.device)}

    def positions(self, packed: LeftPacked, picture_inputs: dict[str, Tensor]) -> Tensor:
        """Return positions (B, T), counted from one."""
        del picture_inputs
        return packed.positions(_FIRST_POSITION)

    def other_inputs(self, packed: LeftPacked) -> dict[str, Tensor]:
        """Return `token_type_ids`, and `attention_mask` (B, 1, T, T), True where a query sees a key.

        A type of zero marks a position of the prompt, which attends both ways. transformers makes the same mask of
        the types by `torch.vmap`, which takes longer than all else in a pass of the embedded network. It makes
        another kind of mask for an attention other than torch's own, and is left to it then.
        """
        types = {"token_type_ids": torch.zeros_like(packed.ids)}
        if self.text_config._attn_implementation != "sdpa":  # transformers has no public name for it
            return types
        by_query = packed.mask.bool()[:, None, None, :].expand(-1, 1, packed.ids.shape[1], -1)
        return {**types, "attention_mask": by_query.contiguous()}


def load_vlm_tiny(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    weights_seed: int = 0,
) -> PaliGemma:
    """Load the embedded VLM: PaliGemma at 0.61 million parameters, trained on the prompts of `probe-kit ask`."""
    location = checkpoint or str(embedded_checkpoint("vlm-tiny"))
    vlm = PaliGemma.load(location, device, dtype, random_weights, weights_seed=weights_seed)
    vlm.card = replace(vlm.card, family="vlm-tiny", checkpoint=checkpoint or EMBEDDED)
    return vlm
