"""The adapter for Ovis2.5: Qwen's chat without a system turn, and an empty thought before the answer."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.families.ovis2_5.network import (
    PICTURE,
    PICTURE_BEGINS,
    PICTURE_ENDS,
    OvisConfig,
    OvisPictures,
    build_ovis2_5,
)
from probe_kit.hooks.families.shared.loading import Recipe
from probe_kit.hooks.families.shared.qwen.adapter import ASSISTANT, USER, ByPicture
from probe_kit.hooks.families.shared.taps import NOTHING, TOWER, Stack
from probe_kit.hooks.families.shared.text import QuestionFrame
from probe_kit.hooks.families.shared.vlm import Pictures, VisionLanguageModel
from probe_kit.hooks.outputs import Produce, numpy_of


class Ovis25(ByPicture, VisionLanguageModel):
    """A loaded Ovis2.5."""

    family: ClassVar[str] = "ovis2.5"
    frame: ClassVar[QuestionFrame] = QuestionFrame(USER, "\n", USER, f"{ASSISTANT}<think>\n\n</think>\n\n")
    recipe: ClassVar[Recipe] = Recipe(OvisConfig.from_values, build_ovis2_5)
    marks: ClassVar[int] = 1
    stream_tolerance: ClassVar[float] = 1e-4  # pictures enter through a softmax over visual words

    @property
    def language(self) -> Any:
        """The decoder."""
        return self.network.llm.model

    @property
    def causal(self) -> Any:
        """The language model with its head."""
        return self.network.llm

    @property
    def text_config(self) -> Any:
        """The language model's configuration."""
        return self.network.config.text

    @cached_property
    def vision(self) -> Stack:
        """The vision tower; the last site is what the last block puts out. Patches are word by word."""
        blocks, view = self.network.visual_tokenizer.vit.vision_model.encoder.layers, {"view": self._by_picture}
        width = self.network.config.vision.width
        return Stack(blocks, blocks[-1], width, None, "layer_norm1", NOTHING, "output", view, TOWER)

    @cached_property
    def pictures(self) -> OvisPictures:
        """The processor of pictures into patches.

        Raises:
            CheckpointError: For a missing file, which it names.
        """
        return OvisPictures.from_folder(self.loaded.folder, self.network.config.vision)

    def picture_ids(self, height: int, width: int) -> list[int]:
        """Return the ids at a picture's positions, as many as its size demands, between two marks."""
        return [PICTURE_BEGINS, *[PICTURE] * self.pictures.tokens(height, width), PICTURE_ENDS]

    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """Return `pixel_values` (N, 3 x patch x patch) and `image_grid_thw` (B, 3)."""
        pixels, self._grid = self.pictures.patches(pictures)
        device = self.loaded.device
        return {"pixel_values": pixels.to(device), "image_grid_thw": self._grid.to(device)}

    def further_outputs(self, first: Prompt, produced: Mapping[str, Produce]) -> dict[str, Produce]:
        """Return the visual words, and patches in the order of the authors' code."""

        def vision() -> NDArray[Any]:
            return produced["vision_resid_row0"]()[:, _windows_first(self)]

        @torch.inference_mode()
        def words() -> NDArray[Any]:
            inputs = self.picture_inputs([first.observation.image])
            probabilities = self.network.visual_tokenizer(inputs["pixel_values"], inputs["image_grid_thw"])
            missing = self.network.config.words - probabilities.shape[1]
            return np.pad(numpy_of(probabilities), ((0, 0), (0, missing)))

        return {"vision_resid_row0": vision, "visual_probabilities_row0": words}


def _windows_first(model: Ovis25) -> NDArray[np.intp]:
    """The order of the current pictures' patches in the authors' code, window by window."""
    vision = model.network.config.vision
    side = vision.window // vision.stride // vision.patch
    assert model._grid is not None
    _, rows, columns = (model._grid[0] // torch.tensor([1, vision.stride, vision.stride])).tolist()
    row, column = np.divmod(np.arange(rows * columns), columns)
    order = np.lexsort((column % side, row % side, column // side, row // side))
    joined = vision.stride**2
    return np.asarray((order[:, None] * joined + np.arange(joined)).ravel())
