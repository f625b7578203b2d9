"""The adapters for pi0 and pi0.5, and the settings of pi0's evaluations.

Prefix: every camera's patches, then the language, one bidirectional block; in pi0.5 a prompt with the
instruction and the state as digits. Suffix: in pi0 the state, then the action chunk; in pi0.5 the action chunk,
with the time of the flow step in the expert's adaptive norms.

lerobot of early 2025 kept statistics among the weights or left them to the evaluation; it padded pictures on
the left and top.

Source of pi0.5: arXiv 2504.16054, through lerobot's `PI05Policy`.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_files import load_json
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE, without_revision
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.model import Unembedding
from probe_kit.hooks.contract.observation import ARM_NUMBERS, laid_out
from probe_kit.hooks.families.pi0.network import (
    Pi0Size,
    build_pi0,
    build_pi05,
    current_pi0_keys,
    current_pi05_keys,
)
from probe_kit.hooks.families.shared.kinds import STATE, PictureFit
from probe_kit.hooks.families.shared.lerobot.flow import (
    GatelessNorm,
    LerobotFlow,
    PaliGemmaPolicy,
    StatePrompt,
    TiedHead,
    sizes_file,
)
from probe_kit.hooks.families.shared.lerobot.normaliser import (
    FILES,
    NO_STATISTICS,
    Normaliser,
    StatisticsFile,
    statistics_in,
)
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP, Inert
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy
from probe_kit.hooks.families.shared.lerobot.window import PictureWindow, padded_top_left, squash
from probe_kit.hooks.families.shared.taps import Note, Stack, flow_stacks, recording_weights, returned_weights
from probe_kit.models.embedded import embedded_checkpoint

_MARKS = ("resize_imgs_with_padding", "num_steps", "proj_width", "train_state_proj", "attention_implementation")
"""Fields that only old files have."""
_RENAMED = {"resize_imgs_with_padding": "image_resolution", "num_steps": "num_inference_steps"}
_FIXED = {"adapt_to_pi_aloha": False, "use_delta_joint_actions_aloha": False}
"""The changes of states and actions that lerobot 0.6 no longer makes; checkpoints that need them are refused."""
_WITHOUT_EFFECT = ("proj_width", "use_cache", "attention_implementation", "train_state_proj")
"""Fields of training, speed, and the expert's width, which the weights say themselves."""


def is_old_layout(config: Mapping[str, Any]) -> bool:
    """Whether lerobot 0.6 would refuse or misread this `config.json` of a pi0."""
    return any(name in config for name in _MARKS)


def current_config(config: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the same settings under today's names; `source` names the file of the config in messages.

    Raises:
        CheckpointError: For a setting that is no longer supported.
    """
    wrong = {name: config[name] for name, value in _FIXED.items() if config.get(name, value) != value}
    if wrong:
        raise CheckpointError(
            f"{source} asks for {', '.join(f'{name}={value}' for name, value in wrong.items())}, which changes "
            "states and actions and is not supported; use a checkpoint without it"
        )
    dropped = {*_WITHOUT_EFFECT, *_FIXED}
    current = {_RENAMED.get(name, name): value for name, value in config.items() if name not in dropped}
    if current.get("image_resolution", True) is None:
        del current["image_resolution"]  # pictures as they are given; they are given at today's default
    return current


EVALUATED_WITH: Mapping[str, str] = {"juexzz/INTACT-pi0-finetune-bridge": "bridge"}
"""Checkpoints whose units only their evaluation has, and the shipped statistics that it has."""


class Pi0(PaliGemmaPolicy, LerobotFlow):
    """A loaded pi0."""

    family = "pi0"
    config_type = "pi0"
    takes_unread = True
    known_steps: ClassVar[tuple[str, ...]] = (CROP, "pi0_new_line_processor")
    unread = tuple(f"model.paligemma_with_expert.{part}.lm_head.weight" for part in ("paligemma", "gemma_expert"))
    current_names = current_pi0_keys

    other_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    suffix_roles: ClassVar[tuple[str, ...]] = ("state", "action")

    # -- what an evaluation decides ------------------------------------------------------------------------

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the fields of `config.json` under today's names, also of lerobot's older layout."""
        return current_config(values, str(path)) if is_old_layout(values) else values

    def further_settings(self) -> dict[str, str]:
        """The settings that the evaluation decides."""
        evaluation, settings = self.evaluation, {}
        if (file := self._statistics) is not None:
            settings["statistics"] = file.sha256
        elif evaluation.statistics is not None:
            settings["statistics"] = evaluation.statistics
        if self.picture != "padded":
            settings["picture"] = self.picture
        if evaluation.openness != "measured":
            settings["openness"] = evaluation.openness
        return settings

    def units_of(self, feature: str, kind: str) -> Normaliser:
        """Return the checkpoint's own units; where it has none, those of its evaluation.

        Raises:
            CheckpointError: If there are both, or neither.
        """
        requested = self.evaluation.statistics
        if (
            requested is not None
            and (units := self._stored(feature, kind)) is not None
            and units.mode != "IDENTITY"
        ):
            raise CheckpointError(
                f"{self.checkpoint} holds the statistics of its {feature} itself ({units.source}), and "
                f"{requested} were given too; leave -M statistics out"
            )
        if requested == NO_STATISTICS:
            nothing = np.zeros(0, np.float32)
            return Normaliser("IDENTITY", nothing, nothing, 0.0, "-M statistics=none")
        if self._statistics is not None:
            part: Literal["proprio", "action"] = "proprio" if kind == "STATE" else "action"
            action_numbers = int(self.config.output_features["action"].shape[0])
            return self._statistics.bounds(part, self.state_numbers if kind == "STATE" else action_numbers)
        if (units := self.own_units(feature, kind)) is not None:
            return units
        raise CheckpointError(
            f"{self.checkpoint} leaves the units of its {feature} to its evaluation and has no "
            f"{' or '.join(FILES)}. Pass -M statistics=bridge, or a FILE with p01 and p99 of action and "
            "proprio, or none if its numbers are metres and radians"
        )

    def _stored(self, feature: str, kind: str) -> Normaliser | None:
        try:
            return self.own_units(feature, kind)
        except CheckpointError:
            return None

    @cached_property
    def _statistics(self) -> StatisticsFile | None:
        """The chosen statistics; for a checkpoint without own ones, its folder's or evaluation's.

        None in every other case.
        """
        source = self.evaluation.statistics
        if source is None and self._stored(STATE, "STATE") is None and self._stored("action", "ACTION") is None:
            source = statistics_in(self.folder) or EVALUATED_WITH.get(str(without_revision(self.checkpoint)))
        return None if source in (None, NO_STATISTICS) else StatisticsFile.read(str(source))

    @cached_property
    def picture(self) -> PictureFit:
        """The way pictures get their size: as requested, or as the checkpoint's layout implies."""
        if self.evaluation.picture is not None:
            return self.evaluation.picture
        if self._statistics is not None:
            return "squashed"
        values = load_json(self.folder / CONFIG_FILE)
        return "padded-top-left" if is_old_layout(values) else "padded"

    def look(self, camera: str, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Return pictures (B, 3, H, W) in [0, 1]; squashed and padded ones at the network's resolution."""
        if self.picture == "padded":
            return super().look(camera, images)
        if self.window(camera) != PictureWindow():
            raise CheckpointError(
                f"{self.checkpoint} looks at a part of its pictures; -M picture={self.picture} cannot be combined "
                "with that. Leave it out"
            )
        height, width = self.config.image_resolution
        if self.picture == "squashed":
            return super().look(camera, [squash(image, (height, width)) for image in images])
        return padded_top_left(super().look(camera, images), (height, width))

    def laid_out(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return seven numbers where the evaluation's statistics are of seven."""
        seven = self.evaluation.statistics is not None or self._statistics is not None
        return laid_out(states, self.state_numbers if seven else ARM_NUMBERS, self.evaluation.openness)

    # -- the network -----------------------------------------------------------------------------------------

    @classmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy at the size `dims.json` gives, or at the released size."""
        sizes = sizes_file(folder)
        return cls.network_of(config, None if sizes is None else Pi0Size.from_file(sizes))

    @classmethod
    def network_of(cls, config: Any, size: Pi0Size | None) -> Any:
        """Build lerobot's policy of this size; None for the released one."""
        return build_pi0(config, size)

    def _stacks(self) -> dict[str, Stack]:
        joint = self._joint
        backbone, expert = joint.paligemma.model.language_model, joint.gemma_expert.model
        vision = joint.paligemma.model.vision_tower.vision_model
        return flow_stacks(backbone, expert, vision, self.iterations)

    @property
    def word_head(self) -> Unembedding:
        """PaliGemma's final norm, and its embedding, which its head shares; pi0 itself puts out no words."""
        decoder = self._joint.paligemma.model.language_model
        return Unembedding(("backbone",), GatelessNorm(decoder.norm), TiedHead(decoder.embed_tokens))

    @property
    def _joint(self) -> Any:
        return self.network.model.paligemma_with_expert

    @property
    def iterations(self) -> int:
        """The number of flow-matching steps per inference."""
        return int(self.config.num_inference_steps)

    def suffix_labels(self) -> list[str]:
        """Return the labels of the state, then of the chunk."""
        return ["state", *["action"] * self.config.chunk_size]

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Record the weights that lerobot's expert returns, which attends eagerly."""
        acting = [label == "action" for label in self.suffix_labels()]

        def note_acting(block: int, iteration: int, weights: Tensor) -> None:
            note(block, iteration, weights[:, :, acting, : weights.shape[-1] - len(acting)])

        return recording_weights(
            [layer.self_attn for layer in self._joint.gemma_expert.model.layers], note_acting, returned_weights
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
    """Load the embedded default: pi0 at 0.84 million parameters, trained to act on Color and Shape.

    Args:
        checkpoint: Folder or hub id; None for the embedded one.
        device: Device in torch's spelling, such as `cuda:0`.
        dtype: float32 or bfloat16; None takes what the checkpoint's config says.
        random_weights: Whether the weights are drawn instead of read.
        weights_seed: Seed of random weights.
        name: Name of the embedded checkpoint and of the family.
    """
    location = checkpoint or str(embedded_checkpoint(name))
    policy = Pi0.load(location, device, dtype, random_weights, weights_seed)
    policy.card = replace(policy.card, family=name, checkpoint=checkpoint or EMBEDDED)
    return policy


load_pi0_tiny_early = partial(load_pi0_tiny, name="pi0-tiny-early")
"""The embedded default before its training: the VLM's backbone and a random expert."""
load_pi0_tiny_state = partial(load_pi0_tiny, name="pi0-tiny-state")
"""The embedded default, trained to act on State too."""


class Pi05(StatePrompt, Pi0):
    """A loaded pi0.5."""

    family = "pi05"
    config_type = "pi05"
    takes_unread = False
    newer_fields: ClassVar[Inert] = {
        "use_visual_memory": (False,),
        "use_proprioceptive_memory": (False,),
        "rtc_training_max_delay": (0,),
        **dict.fromkeys(("memory_frames", "memory_stride", "memory_temporal_attention_every")),
    }
    known_steps = (
        CROP,
        "pi05_prepare_state_tokenizer_processor_step",
    )

    prompt_end = "Action: "
    current_names = current_pi05_keys
    suffix_roles = ("action",)

    @classmethod
    def network_of(cls, config: Any, size: Pi0Size | None) -> Any:
        """Build lerobot's policy of this size."""
        return build_pi05(config, size)

    def _stacks(self) -> dict[str, Stack]:
        stacks = super()._stacks()
        gates = {"attention": "attention_gate", "mlp": "mlp_gate"}  # behind which a block's additions are read
        return {**stacks, "expert": replace(stacks["expert"], added=gates)}

    suffix_labels = LerobotPolicy.suffix_labels
