"""The adapter for pi0.

Prefix: every camera's patches, then the language, one bidirectional block.
Suffix: the state, then the action chunk.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor, nn

from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.families.pi0.evaluated import EvaluatedPi0
from probe_kit.hooks.families.shared.attention_weights import Note, recording_weights, returned
from probe_kit.hooks.families.shared.lerobot.paligemma import PaliGemmaPolicy, sizes_file
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP
from probe_kit.hooks.families.shared.lerobot.stacks import Stack, flow_stacks
from probe_kit.models.embedded.folder import embedded_checkpoint
from probe_kit.models.lerobot.pi0 import Pi0Size, build_pi0
from probe_kit.models.lerobot.pi0_keys import current_pi0_keys


class Pi0(PaliGemmaPolicy, EvaluatedPi0):
    """A loaded pi0."""

    family = "pi0"
    config_type = "pi0"
    takes_unread = True
    known_steps: ClassVar[tuple[str, ...]] = (CROP, "pi0_new_line_processor")
    unread = tuple(f"model.paligemma_with_expert.{part}.lm_head.weight" for part in ("paligemma", "gemma_expert"))

    other_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    suffix_roles: ClassVar[tuple[str, ...]] = ("state", "action")

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy at the size `dims.json` gives, or at the released size."""
        sizes = sizes_file(folder)
        return cls.network_of(config, None if sizes is None else Pi0Size.from_file(sizes))

    @classmethod
    def network_of(cls, config: Any, size: Pi0Size | None) -> nn.Module:
        """lerobot's policy of this size; None for the released one."""
        network: nn.Module = build_pi0(config, size)
        return network

    @classmethod
    def current_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
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

    def suffix_labels(self) -> list[str]:
        """The state, then the chunk."""
        return ["state", *["action"] * self.config.chunk_size]

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """lerobot's expert attends eagerly, and returns its weights."""
        acting = [label == "action" for label in self.suffix_labels()]

        def note_acting(block: int, iteration: int, weights: Tensor) -> None:
            note(block, iteration, weights[:, :, acting, : weights.shape[-1] - len(acting)])

        return recording_weights(
            [layer.self_attn for layer in self._joint.gemma_expert.model.layers], note_acting, returned
        )


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
    location = checkpoint or str(embedded_checkpoint(name))
    policy = Pi0.load(location, device, dtype, random_weights, weights_seed)
    policy.card = replace(policy.card, family=name, checkpoint=checkpoint or EMBEDDED)
    return policy


load_pi0_tiny_early = partial(load_pi0_tiny, name="pi0-tiny-early")
"""The embedded default before its training: the VLM's backbone and a random expert."""
load_pi0_tiny_state = partial(load_pi0_tiny, name="pi0-tiny-state")
"""The embedded default, trained to act on State too."""
