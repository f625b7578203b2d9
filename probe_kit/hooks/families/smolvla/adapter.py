"""The adapter for SmolVLA.

Prefix: per camera its patches (between special tokens, if the checkpoint says so), the language, then one state
token that the rest does not see. Suffix: the action chunk, causal. lerobot drives the layers piecewise and adds in
place, so no layer module ever fires; the norms at their entries do.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.lerobot_flow import LerobotFlow, Stack, flow_stacks
from probe_kit.hooks.policy import Observation
from probe_kit.hooks.roles import PADDING, Roles
from probe_kit.models.smolvla import build_smolvla, current_smolvla_keys


class SmolVLA(LerobotFlow):
    """A loaded SmolVLA."""

    family = "smolvla"
    config_type = "smolvla"
    unread = ("model.vlm_with_expert.vlm.lm_head.weight",)

    def __init__(self, network: Any, folder: Path) -> None:
        super().__init__(network, folder)
        self.role_names = {
            "backbone": (f"image.{self.cameras[0]}", "language", "state", "special", PADDING),
            "expert": ("action",),
        }

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy in float32, without a second download of the VLM's weights."""
        if getattr(config, "dtype", "float32") != "float32":
            raise CheckpointError(
                "SmolVLA runs in float32 here, because lerobot's mixed precision depends on how its VLM was "
                "loaded. Leave --dtype out"
            )
        network: nn.Module = build_smolvla(config, folder)
        return network

    @classmethod
    def current_keys(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Old files' statistics left out."""
        return current_smolvla_keys(tensors)

    def _stacks(self) -> dict[str, Stack]:
        joint = self.network.model.vlm_with_expert
        backbone, expert, vision = joint.vlm.model.text_model, joint.lm_expert, joint.vlm.model.vision_model
        cameras = min(len(self.config.image_features), 1 + self.config.empty_cameras)
        return flow_stacks(backbone, expert, vision, self.iterations, cameras)

    @property
    def iterations(self) -> int:
        """Flow-matching steps per inference."""
        return int(self.config.num_steps)

    @cached_property
    def tokenizer(self) -> Any:
        """The VLM's."""
        return self.network.model.vlm_with_expert.processor.tokenizer

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Of the cameras without a picture, `empty_cameras` are masked and the rest left out, as lerobot does."""
        masked_cameras = min(len(self.config.image_features) - 1, self.config.empty_cameras)
        images = self._camera_labels(f"image.{self.cameras[0]}")
        masked = self._camera_labels(PADDING) * masked_cameras
        suffix = Roles.from_labels(["action"] * self.config.chunk_size)
        backbone = []
        for row in self.language_roles([o.instruction for o in observations]):
            labels = [*images, *masked, *row, "state"]
            labels += [PADDING] * (self.config.prefix_length - len(labels))
            backbone.append(Roles.from_labels(labels))
        return {"backbone": backbone, "expert": [suffix] * len(observations)}

    def _camera_labels(self, role: str) -> list[str]:
        """One camera's positions; the special tokens around a masked picture are not masked."""
        labels = [role] * self.tokens_per_camera
        return ["special", "special", *labels, "special"] if self.config.add_image_special_tokens else labels

    @property
    def tokens_per_camera(self) -> int:
        """Patches after the connector's pixel shuffle."""
        vlm = self.network.model.vlm_with_expert.vlm.config
        patches = (vlm.vision_config.image_size // vlm.vision_config.patch_size) ** 2
        return int(patches // vlm.scale_factor**2)


def load_smolvla(
    checkpoint: str, device: str = "cpu", dtype: str | None = None, random_weights: bool = False
) -> SmolVLA:
    """Load a lerobot SmolVLA checkpoint; see `LerobotFlow.load`."""
    return SmolVLA.load(checkpoint, device, dtype, random_weights)
