"""The adapter for GR00T N1.7.

Backbone: a chat with every picture, through the first layers of a Qwen3-VL. Bridge: a norm, then blocks that
attend among all tokens of the chat. Expert: the state and the noisy actions, at every denoising step; its blocks
attend by turns to the end of the bridge and to themselves.

Source: arXiv 2503.14734 and the released GR00T N1.7, through lerobot's `GrootPolicy`.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from probe_kit.errors import UsageError
from probe_kit.hooks.families.groot import BRIDGE, INTERVENTIONS
from probe_kit.hooks.families.groot.network import (
    GrootChoice,
    PartFolders,
    build_groot,
    check_version,
    flow_actions,
    is_nvidias,
    network_config,
    nvidias_config,
)
from probe_kit.hooks.families.groot.packing import GrootPacking, NvidiasPictures, Steps, lerobots_rule, read_steps
from probe_kit.hooks.families.groot.units import action_units, state_units
from probe_kit.hooks.families.shared.kinds import IMAGES
from probe_kit.hooks.families.shared.lerobot.flow import PackedPolicy
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser
from probe_kit.hooks.families.shared.lerobot.pipelines import PACKING_STEP, read_views, step_fields
from probe_kit.hooks.families.shared.qwen.adapter import merger_norm
from probe_kit.hooks.families.shared.taps import TOWER, Stack
from probe_kit.hooks.outputs import Produce, RecordedRun, numpy_of
from probe_kit.models.checkpoint_files import renamed_tensors

_MODEL = "_groot_model."
_EMBEDDING = f"{_MODEL}backbone.model.model.language_model.embed_tokens.weight"
_HEAD = f"{_MODEL}backbone.model.lm_head.weight"


_DIFFUSERS = {"attention": "attn1", "heads": "attn1.to_out.0", "mlp": "ff"}
"""The paths of what a block of diffusers adds: its one attention, to the prompt or itself, and its MLP."""


def _lerobots_names(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors by lerobot's names, also of NVIDIA's files."""
    return renamed_tensors(tensors, lambda name: name if name.startswith(_MODEL) else f"{_MODEL}{name}")


def _without_unread_views(config: Any, folder: Path) -> tuple[str, ...]:
    """Take the pictures that lerobot's packing leaves out from the configuration, and return their names."""
    views = step_fields(folder).get(PACKING_STEP, {}).get("video_modality_keys")
    packed = read_views(list(config.image_features), views) if views else list(config.image_features)
    unread = tuple(name for name in config.image_features if name not in packed and name.startswith(IMAGES))
    config.input_features = {name: entry for name, entry in config.input_features.items() if name not in unread}
    return tuple(name.removeprefix(IMAGES) for name in unread)


class Groot(PackedPolicy):
    """A loaded GR00T N1.7.

    It takes one observation per call: its bridge reads padding, which changes the actions.
    """

    family = "groot"
    config_type = "groot"
    choice = GrootChoice
    known_steps = None
    interventions = INTERVENTIONS
    unread = (_HEAD,)
    tied: ClassVar[Mapping[str, str]] = {_EMBEDDING: _HEAD}
    current_names = _lerobots_names

    other_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    suffix_roles = ("state", "action")
    word_roles = ("language",)

    # -- loading -----------------------------------------------------------------------------------------

    @classmethod
    def load(
        cls,
        checkpoint: str,
        device: str = "cpu",
        dtype: str | None = None,
        random_weights: bool = False,
        weights_seed: int = 0,
        **options: Any,
    ) -> Self:
        """Load as `LerobotPolicy.load` does; dtype bfloat16 is lerobot's autocast around float32 weights."""
        policy = super().load(checkpoint, device, dtype, random_weights, weights_seed, **options)
        execute = min(int(policy.network._action_queue_steps), policy.chunk)
        policy.card = replace(policy.card, chunk=policy.chunk, execute=execute, batch=1)
        return policy

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Any) -> Any:
        """Return lerobot's configuration, also for NVIDIA's layout.

        Raises:
            UsageError: For an option that has no use.
        """
        if is_nvidias(folder):
            config = nvidias_config(folder, evaluation.embodiment)
        elif evaluation.embodiment is not None:
            raise UsageError(
                f"-M embodiment={evaluation.embodiment} belongs to NVIDIA's layout; {folder} is lerobot's, which "
                "names its own. Leave it out"
            )
        else:
            config = super().parse_config(folder, evaluation)
            config.unread_pictures = _without_unread_views(config, folder)
        config.resize, config.letterbox = evaluation.resize, evaluation.letterbox
        config.places = PartFolders.of(folder, config.base_model_path, evaluation.vlm)
        return config

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the fields as they are.

        Raises:
            CheckpointError: For a fine-tune of an older GR00T.
        """
        check_version(values, path)
        return values

    @classmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy of the size that the base model's configuration has.

        Raises:
            CheckpointError: For another kind of backbone.
        """
        if (dtype := getattr(config, "dtype", None)) is not None:
            config.use_bf16 = dtype == "bfloat16"
            config.model_params_fp32 = config.model_params_fp32 or dtype == "float32"
        config.dtype = "bfloat16" if config.use_bf16 else "float32"
        if (folder / config.base_model_path).is_dir():
            config.base_model_path = str(config.places.base)
        return build_groot(config, network_config(config.places.network, config, config.places.model_name))

    def parts(self) -> dict[str, Path]:
        """Return the folders of the base model and of the vision-language model."""
        return {"base": self.config.places.base, "vlm": self.config.places.vlm}

    def further_settings(self) -> dict[str, str]:
        """Return the embodiment whose statistics and weights are read, and how pictures are resized."""
        encode = self._steps.encode
        return {
            "embodiment": str(self.config.embodiment_tag),
            "resize": "nvidia" if isinstance(encode, NvidiasPictures) else "lerobot",
            "letterbox": str(bool(encode.letter_box_transform)),
        }

    @cached_property
    def _steps(self) -> Steps:
        return read_steps(self.folder, self.config, self.config.resize, self.config.letterbox)

    def own_units(self, feature: str, kind: str) -> Normaliser:
        """Return the units in the processors.

        Raises:
            CheckpointError: For statistics that are missing, or do not fit.
        """
        del feature
        steps = self._steps
        if kind == "STATE":
            return state_units(steps.pack, self.state_numbers, steps.source, steps.fields)
        return action_units(steps.decode, self._action_numbers, steps.source, steps.fields)

    @property
    def predicts_relative(self) -> bool:
        """Whether the base says so, or NVIDIA's statistics."""
        return super().predicts_relative or bool(getattr(self._steps.decode, "use_relative_action", False))

    def _notes(self) -> tuple[str, ...]:
        frames = int(self._steps.pack.video_horizon or 1)
        video = f"reads {frames} frames of a video: the one picture is given {frames} times, as lerobot does"
        encode = self._steps.encode
        rule = encode.rule if isinstance(encode, NvidiasPictures) else lerobots_rule(encode)
        bars = "with black bars to a square first" if encode.letter_box_transform else "without letterbox"
        unread = getattr(self.config, "unread_pictures", ())
        views = (f"lerobot leaves out {', '.join(unread)} (video_modality_keys)",) if unread else ()
        return (*super()._notes(), *views, *((video,) if frames > 1 else ()), f"pictures: {bars}, {rule}")

    # -- acting ------------------------------------------------------------------------------------------

    @cached_property
    def chunk(self) -> int:
        """The number of actions of an inference that have a meaning for this embodiment."""
        widest = torch.empty(1, self._head.action_horizon, 1)
        length = int(self.network._resolve_prediction_horizon(widest))
        steps = (getattr(self._steps.decode, "modality_config", None) or {}).get("action", {}).get("delta_indices")
        return min(length, len(steps)) if steps else length

    @property
    def _head(self) -> Any:
        return self.network._groot_model.action_head

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return the steps and numbers that this embodiment has."""
        return flow_actions(self.network, batch, noise)[:, : self.chunk, : self._action_numbers]

    @property
    def noise_shape(self) -> tuple[int, int]:
        """The shape of one row's noise: the network's whole horizon, and its widest action."""
        return self._head.action_horizon, self._head.action_dim

    # -- the prompt --------------------------------------------------------------------------------------

    @cached_property
    def packing(self) -> GrootPacking:
        """The packing of lerobot."""
        return GrootPacking(self._steps, self.config.places.vlm)

    def suffix_labels(self) -> list[str]:
        """Return the labels of the state, then of the network's whole horizon."""
        return ["state", *["action"] * int(self._head.action_horizon)]

    # -- capture -----------------------------------------------------------------------------------------

    def _stacks(self) -> dict[str, Stack]:
        backbone, head = self.network._groot_model.backbone, self._head
        text, tower, dit = backbone.language_model, backbone.visual, head.model
        stacks = {
            # What the bridge's norm reads is the end of the backbone: Qwen's own last norm is not read. DeepStack
            # adds pictures between its first blocks.
            "backbone": Stack(
                text.layers, head.vlln, int(text.config.hidden_size), None, stream_fields={"sums": False}
            )
        }
        if (blocks := getattr(head.vl_self_attention, "transformer_blocks", None)) is not None:
            # No norm stands behind its blocks: the output of the whole is the last residual.
            bridge, fields = head.vl_self_attention, {"part": "bridge", "quantities": BRIDGE, "heads": 0}
            width = int(bridge.inner_dim)
            stacks["bridge"] = Stack(
                blocks, bridge, width, None, "norm1", _DIFFUSERS, "output", stream_fields=fields
            )
        steps, heads = int(head.num_inference_timesteps), int(dit.transformer_blocks[0].attn1.heads)
        stacks["expert"] = Stack(
            dit.transformer_blocks,
            dit.norm_out,
            int(dit.inner_dim),
            steps,
            "norm1",
            _DIFFUSERS,
            stream_fields={"heads": heads},
        )
        # The tower runs over the patches of all pictures of an observation at once.
        width, view = int(backbone.model.config.vision_config.hidden_size), {"view": lambda patches: patches[None]}
        stacks["vision"] = Stack(
            tower.blocks, merger_norm(tower), width, None, "norm1", tap_fields=view, stream_fields=TOWER
        )
        return stacks

    # -- verification ------------------------------------------------------------------------------------

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return the module of the velocity."""
        return {"velocity": self._head.action_decoder}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return the end of the backbone, and velocities without the state's position."""
        end, horizon = self.streams["backbone"].sites()[-1], run.recorded["in_noise"].shape[1]
        return {
            "backbone_end": lambda: numpy_of(run.activations[end]),
            "velocity": lambda: run.outputs("velocity")[:, :, -horizon:],
        }
