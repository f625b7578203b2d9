"""The adapter for pi0.

Prefix: every camera's patches, then the language, one bidirectional block.
Suffix: the state, then the action chunk.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import AutoTokenizer

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import side_files
from probe_kit.hooks.checkpoints.hub import unreachable
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.pi0.evaluated import EvaluatedPi0
from probe_kit.hooks.families.shared.attention_weights import Note, recording_weights, returned
from probe_kit.hooks.families.shared.lerobot.evaluation import Evaluation, Picture
from probe_kit.hooks.families.shared.lerobot.stacks import Stack, flow_stacks
from probe_kit.models.embedded.folder import embedded_checkpoint
from probe_kit.models.lerobot.pi0 import Pi0Size, build_pi0
from probe_kit.models.lerobot.pi0_keys import current_pi0_keys

_TOKENIZER = "google/paligemma-3b-pt-224"


LEAST_BYTES = 1_000_000_000
"""Of weights in the released size, which have 3.5 billion parameters."""


def _check_small_weights(folder: Path) -> None:
    """A small network that lost its `dims.json` would be built at full size, for minutes, before it is refused."""
    found = sum(file.stat().st_size for file in folder.glob("*.safetensors"))
    if 0 < found < LEAST_BYTES:
        raise CheckpointError(
            f"{folder} has {found / 1e6:,.1f} MB of weights and no dims.json; pi0 in its released size has "
            "several GB. Put the dims.json beside its config.json, or download the checkpoint again"
        )


class Pi0(EvaluatedPi0):
    """A loaded pi0."""

    family = "pi0"
    config_type = "pi0"
    unread = tuple(f"model.paligemma_with_expert.{part}.lm_head.weight" for part in ("paligemma", "gemma_expert"))

    other_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    suffix_roles: ClassVar[tuple[str, ...]] = ("state", "action")

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy at the size `dims.json` gives, or at the released size."""
        sizes = [place / "dims.json" for place in (folder, folder.parent) if (place / "dims.json").is_file()]
        if not sizes:
            _check_small_weights(folder)
        return cls.network_of(config, Pi0Size.from_file(sizes[0]) if sizes else None)

    @classmethod
    def network_of(cls, config: Any, size: Pi0Size | None) -> nn.Module:
        """lerobot's policy of this size; None for the released one."""
        network: nn.Module = build_pi0(config, size)
        return network

    @classmethod
    def current_keys(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Old layouts brought to today's."""
        return current_pi0_keys(tensors)

    def _stacks(self) -> dict[str, Stack]:
        joint = self._joint
        backbone, expert = joint.paligemma.model.language_model, joint.gemma_expert.model
        vision = joint.paligemma.model.vision_tower.vision_model
        return flow_stacks(backbone, expert, vision, self.iterations)

    @property
    def _joint(self) -> Any:
        return self.network.model.paligemma_with_expert

    @property
    def iterations(self) -> int:
        """Flow-matching steps per inference."""
        return int(self.config.num_inference_steps)

    @cached_property
    def tokenizer(self) -> Any:
        """PaliGemma's, from the checkpoint folder or the hub."""
        if (place := self._tokenizer_folder()) is not None:
            return AutoTokenizer.from_pretrained(place)
        try:
            return AutoTokenizer.from_pretrained(_TOKENIZER, local_files_only=bool(unreachable()))
        except OSError as error:
            raise CheckpointError(
                f"{self.folder} has no tokenizer.json and the gated {_TOKENIZER} cannot be fetched. Run "
                "`hf auth login`, or put its tokenizer.json and tokenizer_config.json into the checkpoint folder"
            ) from error

    def _tokenizer_folder(self) -> Path | None:
        places = (self.folder, self.folder.parent / "tokenizer")
        return next((place for place in places if (place / "tokenizer.json").is_file()), None)

    def side_files(self) -> dict[str, Path]:
        """Also the sizes and the tokenizer, where they lie beside the folder."""
        found = super().side_files()
        sizes, text = self.folder.parent / "dims.json", self._tokenizer_folder()
        if "dims.json" not in found and sizes.is_file():
            found["dims.json"] = sizes
        if text is not None and text != self.folder:
            found |= side_files(text, "tokenizer/")
        return found

    @property
    def masked_cameras(self) -> int:
        """All that are not shown."""
        return len(self.config.image_features) - len(self.shown)

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """Cameras without a picture are masked and lie behind the shown ones."""
        images = [f"image.{camera}" for camera in self.shown for _ in range(self.tokens_per_camera)]
        return [*images, *[PADDING] * self.tokens_per_camera * self.masked_cameras, *language]

    def suffix_labels(self) -> list[str]:
        """The state, then the chunk."""
        return ["state", *["action"] * self.config.chunk_size]

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """lerobot's expert attends eagerly, and returns its weights."""
        acting = [label == "action" for label in self.suffix_labels()]

        def own(block: int, iteration: int, weights: Tensor) -> None:
            note(block, iteration, weights[:, :, acting, : weights.shape[-1] - len(acting)])

        return recording_weights(
            [layer.self_attn for layer in self._joint.gemma_expert.model.layers], own, returned
        )

    def patch_order(self) -> NDArray[np.int64]:
        """A token per patch, row by row."""
        return np.arange(self.tokens_per_camera)

    @property
    def tokens_per_camera(self) -> int:
        """Patches of one picture."""
        vision = self.network.model.paligemma_with_expert.paligemma.model.vision_tower.vision_model
        return int(vision.embeddings.num_patches)


def load_pi0(
    checkpoint: str,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    statistics: str | None = None,
    picture: Picture | None = None,
    openness: str = "measured",
    unread: str = "",
    weights_seed: int = 0,
) -> Pi0:
    """Load a lerobot pi0 checkpoint, of today's layout or that of early 2025; see `LerobotFlow.load`.

    statistics, picture, openness, unread: see `Evaluation`; unread is comma-separated.
    """
    names = tuple(name for name in unread.split(",") if name)
    evaluation = Evaluation(statistics, picture, openness, names)
    return Pi0.load(checkpoint, device, dtype, random_weights, weights_seed, evaluation)


def check_pi0_words(checkpoint: str, instructions: Sequence[str], *, unread: str = "", **_: Any) -> None:
    """See `Family.words`; of the options only `unread` decides what the text is read with."""
    Pi0.check_words(checkpoint, instructions, Evaluation(unread=tuple(name for name in unread.split(",") if name)))


def load_pi0_tiny(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    weights_seed: int = 0,
    *,
    name: str = "pi0-tiny",
) -> Pi0:
    """The embedded default: pi0 at 0.84 million parameters, trained to act on Color and Shape.

    name: of the embedded checkpoint.
    """
    place = checkpoint or str(embedded_checkpoint(name))
    policy = Pi0.load(place, device, dtype, random_weights, weights_seed)
    policy.card = replace(policy.card, family=name, checkpoint=checkpoint or "embedded")
    return policy


load_pi0_tiny_early = partial(load_pi0_tiny, name="pi0-tiny-early")
"""The embedded default before its training: the VLM's backbone and a random expert."""
load_pi0_tiny_state = partial(load_pi0_tiny, name="pi0-tiny-state")
"""The embedded default, trained to act on State too."""
