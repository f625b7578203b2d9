"""Base adapters of models on Qwen's vision-language models: those that answer, and policies."""

from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.contract.model import Policy, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import IMAGE_ROLE, PADDING, Site, Stream
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.qwen.network import (
    QwenInputs,
    QwenPictures,
    image_slots,
    merged_tokens,
    pack_inputs,
)
from probe_kit.hooks.families.shared.taps import TOWER, Stack, decoder_tap, kept_prompt
from probe_kit.hooks.families.shared.text import QuestionFrame, TokenizerFile
from probe_kit.hooks.families.shared.vlm import Pictures, VisionLanguageModel
from probe_kit.hooks.outputs import Arrays
from probe_kit.models.decoding import LeftPacked


def merger_norm(tower: Any) -> Any:
    """Return the norm that reads the last block of one of Qwen's vision towers."""
    return tower.merger.ln_q if hasattr(tower.merger, "ln_q") else tower.merger.norm


class ByPicture:
    """A vision tower that runs over the patches of all pictures at once."""

    _grid: Tensor | None = None
    """The patches of each picture under way along time, height and width, (pictures, 3)."""

    def _by_picture(self, patches: Tensor) -> Tensor:
        """Return patches (patches, D) as (pictures, patches of one, D).

        It is (1, patches, D) where pictures differ in size.
        """
        grid = self._grid
        count = 1 if grid is None or bool((grid != grid[0]).any()) else len(grid)
        return patches.view(count, -1, patches.shape[-1])


class QwenVision(ByPicture):
    """The vision side of `vlm`, one of transformers' Qwen networks.

    Attributes:
        folder: The folder of preprocessor_config.json.
    """

    vlm: Any
    folder: Path
    fast_pictures: ClassVar[bool] = True
    """Whether the model's authors ran the fast one of Qwen's two picture processors."""

    @property
    def tower(self) -> Any:
        """The vision tower of Qwen."""
        return self.vlm.model.visual

    @cached_property
    def vision(self) -> Stack:
        """The tower; the last site is what its merger reads. Patches are in the tower's own order."""
        width, view = int(self.vlm.config.vision_config.hidden_size), {"view": self._by_picture}
        norm = merger_norm(self.tower)
        return Stack(self.tower.blocks, norm, width, None, "norm1", tap_fields=view, stream_fields=TOWER)

    @cached_property
    def pictures(self) -> QwenPictures:
        """The processor of pictures into patches.

        Raises:
            CheckpointError: For a missing file, which it names.
        """
        vision = self.vlm.config.vision_config
        sizes = (int(vision.patch_size), int(vision.temporal_patch_size), int(vision.spatial_merge_size))
        return QwenPictures.from_folder(self.folder, *sizes, fast=self.fast_pictures)


# -- models that answer ---------------------------------------------------------------------------------------

SYSTEM = "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
USER, ASSISTANT = "<|im_start|>user\n", "<|im_end|>\n<|im_start|>assistant\n"


def qwen_frame(system: str = "") -> QuestionFrame:
    """Return Qwen's chat of one turn, behind the `system` turn."""
    return QuestionFrame(f"{system}{USER}<|vision_start|>", "<|vision_end|>", f"{system}{USER}", ASSISTANT)


class QwenVLM(QwenVision, VisionLanguageModel):
    """A VLM on one of transformers' Qwen networks."""

    picture_token: ClassVar[str | None] = "<|image_pad|>"

    def __init__(self, loaded: Loaded[Any], tokenizer: str | None = None, **settings: str) -> None:
        self.vlm, self.folder = loaded.network, loaded.folder
        super().__init__(loaded, tokenizer, **settings)

    def picture_ids(self, height: int, width: int) -> list[int]:
        """Return the ids at a picture's positions, as many as its size demands."""
        count = merged_tokens(self.pictures.grid(height, width), self.pictures.merge)
        return [int(self.network.config.image_token_id)] * count

    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """Return `pixel_values` (N, channels x time x patch x patch) and `image_grid_thw` (B, 3)."""
        pixels, self._grid = self.pictures.patches(pictures)
        device = self.loaded.device
        return {"pixel_values": pixels.to(device), "image_grid_thw": self._grid.to(device)}

    def positions(self, packed: LeftPacked, picture_inputs: dict[str, Tensor]) -> Tensor:
        """Return positions (3, B, T) over time, height and width, as the native class counts; 0 at padding."""
        counted, _ = self.network.model.get_rope_index(
            packed.ids,
            image_grid_thw=picture_inputs.get("image_grid_thw"),
            attention_mask=packed.mask,
            **self.other_inputs(packed),
        )
        positions: Tensor = counted
        return positions

    def other_inputs(self, packed: LeftPacked) -> dict[str, Tensor]:
        """Return `mm_token_type_ids`, 1 at positions of pictures.

        Left out, Qwen2.5-VL silently counts them as text.
        """
        return {"mm_token_type_ids": (packed.ids == int(self.network.config.image_token_id)).long()}


# -- policies -------------------------------------------------------------------------------------------------

BACKBONE_ROLES = (IMAGE_ROLE, "language", "special", PADDING)


class QwenVLA(QwenVision, Policy):
    """A policy whose backbone is one of transformers' Qwen vision-language models.

    Subclasses define the model's inputs, and what follows the backbone.
    """

    def __init__(self, vlm: Any, folder: Path, tokenizer: str | None, device: str) -> None:
        """Make the adapter.

        Args:
            vlm: One of transformers' `Qwen…VLForConditionalGeneration`.
            folder: The folder of tokenizer.json and preprocessor_config.json.
            tokenizer: Another folder of tokenizer.json; None for `folder`.
            device: The device of the network.
        """
        self.vlm, self.folder, self.device = vlm, folder, device
        self._tokenizer_folder = folder if tokenizer is None else Path(tokenizer).expanduser()

    @property
    def language(self) -> Any:
        """The decoder."""
        return self.vlm.model.language_model

    def backbone_stream(self) -> Stream:
        """The decoder's stream."""
        text = self.vlm.config.text_config
        heads = int(text.num_attention_heads)
        return Stream("backbone", len(self.language.layers) + 1, int(text.hidden_size), heads=heads)

    def backbone_kv(self) -> Stream:
        """The decoder's keys and values."""
        return kept_prompt(self.vlm.config.text_config)

    # -- what a family decides ---------------------------------------------------------------------------

    @property
    @abstractmethod
    def units(self) -> Any:
        """The statistics that give actions their units.

        Raises:
            CheckpointError: If there are none.
        """

    @abstractmethod
    def text(self, instruction: str) -> str:
        """The whole prompt with one image slot."""

    @abstractmethod
    def look(self, observation: Observation) -> Any:
        """Return the picture (H, W, 3) uint8 that the processor gets."""

    def units_or_reason(self) -> Any:
        """Return the units, or why there are none: a checkpoint without them can be captured and cannot act."""
        try:
            return self.units
        except CheckpointError as error:
            return str(error)

    def patched_picture(self, observation: Observation) -> Any:
        """Return the picture (H, W, 3) uint8 that is cut into patches.

        It is another one than that of `look` where the authors resize once more before.
        """
        return self.look(observation)

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def tokenizer(self) -> TokenizerFile:
        """The checkpoint's tokenizer.

        Raises:
            CheckpointError: For a missing file, and for one of another model.
        """
        tokenizer = TokenizerFile(self._tokenizer_folder)
        tokenizer.check_present()
        tokenizer.check_vocabulary(int(self.vlm.config.text_config.vocab_size))
        return tokenizer

    def prompt(self, instruction: str) -> list[int]:
        """Return the ids of the whole prompt, one for the picture."""
        ids: list[int] = self.tokenizer.encoding(self.text(instruction)).ids
        return ids

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt, one for the picture."""
        return [tuple(self.prompt(instruction)) for instruction in instructions]

    def rows(self, observations: Sequence[Observation]) -> list[list[int]]:
        """Return per observation the ids the backbone gets, the picture's as often as its size demands.

        Raises:
            InstructionError: For a prompt that is too long.
        """
        limit = int(self.vlm.config.text_config.max_position_embeddings)
        rows = []
        for observation in observations:
            grid = self.pictures.grid(*self.look(observation).shape[:2])
            count = merged_tokens(grid, self.pictures.merge)
            row = image_slots(self.prompt(observation.instruction), self._image_token, [count])
            if len(row) > limit:
                raise InstructionError(f"a prompt makes {len(row)} positions; this model has {limit}. Shorten it")
            rows.append(row)
        return rows

    def inputs(self, observations: Sequence[Observation]) -> QwenInputs:
        """The observations as the backbone reads them, on the model's device.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        for observation in observations:
            checked_picture(observation.image)
        pixels, grid = self.pictures.patches([self.patched_picture(observation) for observation in observations])
        padding = self.vlm.config.text_config.pad_token_id
        packed = pack_inputs(
            self.rows(observations), pixels, grid, self._image_token, 0 if padding is None else int(padding)
        )
        self._grid = packed.grid
        return packed.to(self.device)

    @property
    def _image_token(self) -> int:
        return int(self.vlm.config.image_token_id)

    # -- capture -----------------------------------------------------------------------------------------

    def backbone_roles(self, observations: Sequence[Observation]) -> list[Roles]:
        """The roles of chat marks, picture and text, with padding behind where another prompt is longer."""
        rows, special = self.rows(observations), self.tokenizer.special

        def role(number: int) -> str:
            if number == self._image_token:
                return IMAGE_ROLE
            return "special" if number in special else "language"

        return Roles.padded([list(map(role, row)) for row in rows])

    def backbone_tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the final norm, or a block's output."""
        return decoder_tap(self.language.layers, self.language.norm, site)


def recorded_inputs(policy: QwenVLA, recorded: Arrays) -> QwenInputs:
    """Return the packed prompts of a golden reference, which the next inference of the policy is about."""
    names = ("in_input_ids", "in_attention_mask", "in_pixel_values", "in_image_grid_thw")
    ids, mask, pixels, grid = (torch.from_numpy(recorded[name]) for name in names)
    policy._grid = grid
    return QwenInputs(ids, mask, pixels, grid, int(policy.vlm.config.image_token_id))
