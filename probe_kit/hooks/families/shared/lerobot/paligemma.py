"""The parts that lerobot's policies on PaliGemma share: sizes, tokenizer, pictures in the prompt."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from transformers import AutoTokenizer

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.shared.lerobot.pipelines import tokenizer_folder, tokenizer_name
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy
from probe_kit.models.lerobot.pi0_keys import EMBEDDING, LM_HEAD
from probe_kit.models.pretrained import load_pretrained

_TOKENIZER = "google/paligemma-3b-pt-224"
_TOKENIZER_FILES = ("tokenizer*", "special_tokens_map.json", "added_tokens.json", "config.json")
LEAST_BYTES = 1_000_000_000
"""Of weights in the released sizes, which have 3 billion parameters or more."""


def _check_small_weights(folder: Path) -> None:
    """A small network that lost its `dims.json` would be built at full size, for minutes, before it is refused."""
    size = sum(file.stat().st_size for file in folder.glob("*.safetensors"))
    if 0 < size < LEAST_BYTES:
        raise CheckpointError(
            f"{folder} has {size / 1e6:,.1f} MB of weights and no dims.json; the released size has "
            "several GB. Put the dims.json beside its config.json, or download the checkpoint again"
        )


def sizes_file(folder: Path) -> Path | None:
    """The `dims.json` of a small checkpoint; None for one of the released size.

    Raises CheckpointError for a small one that lost it.
    """
    sizes = [parent / "dims.json" for parent in (folder, folder.parent) if (parent / "dims.json").is_file()]
    if not sizes:
        _check_small_weights(folder)
    return sizes[0] if sizes else None


class PaliGemmaPolicy(LerobotPolicy):
    """A lerobot policy whose prompt is read by PaliGemma."""

    # pi0_base holds the embedding as `lm_head` alone.
    tied: ClassVar[Mapping[str, str]] = {EMBEDDING: LM_HEAD}

    @cached_property
    def tokenizer(self) -> Any:
        """PaliGemma's, from the checkpoint folder or the hub."""
        if (folder := self._tokenizer_folder()) is not None:
            return load_pretrained(AutoTokenizer, folder)
        repository = tokenizer_name(self.folder) or _TOKENIZER
        try:
            return load_pretrained(AutoTokenizer, checkpoint_folder(repository, _TOKENIZER_FILES))
        except (CheckpointError, OSError, ValueError) as error:
            gated = "gated " if repository == _TOKENIZER else ""
            raise CheckpointError(
                f"{self.folder} has no tokenizer.json and the {gated}{repository} cannot be fetched. Run "
                "`hf auth login`, or put its tokenizer.json and tokenizer_config.json into the checkpoint folder"
            ) from error

    def _tokenizer_folder(self) -> Path | None:
        if (saved := tokenizer_folder(self.folder)) is not None:
            return saved
        places = (self.folder, self.folder.parent / "tokenizer")
        return next((folder for folder in places if (folder / "tokenizer.json").is_file()), None)

    def side_files(self) -> dict[str, Path]:
        """Also the sizes, where they lie beside the folder."""
        files, sizes = super().side_files(), self.folder.parent / "dims.json"
        return {**({"dims.json": sizes} if sizes.is_file() else {}), **files}

    def parts(self) -> dict[str, Path]:
        """The tokenizer, where it lies beside the folder."""
        folder = self._tokenizer_folder()
        return {} if folder is None or folder == self.folder else {"tokenizer": folder}

    @property
    def masked_cameras(self) -> int:
        """All that are not shown."""
        return len(self.config.image_features) - len(self.shown_cameras)

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """Cameras without a picture are masked and lie behind the shown ones."""
        images = [f"image.{camera}" for camera in self.shown_cameras for _ in range(self.tokens_per_camera)]
        return [*images, *[PADDING] * self.tokens_per_camera * self.masked_cameras, *language]

    def patch_order(self) -> NDArray[np.int64]:
        """A token per patch, row by row."""
        return np.arange(self.tokens_per_camera)

    @property
    def tokens_per_camera(self) -> int:
        """Patches of one picture."""
        vision = self.network.model.paligemma_with_expert.paligemma.model.vision_tower.vision_model
        return int(vision.embeddings.num_patches)
