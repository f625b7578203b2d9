"""The adapter for MolmoAct2.

Prefix: crops of every picture, then a prompt with the instruction and the state as tokens. Only pictures attend
both ways.
Suffix: the action chunk. Block n of the expert attends to the keys and values of block n of the backbone.

Source: arXiv 2605.02881, through lerobot's `MolmoAct2Policy`.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file
from torch import Tensor, nn

from probe_kit.errors import CaptureError, CheckpointError
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.sites import Site, Stream, kv_stream
from probe_kit.hooks.families.molmoact2 import EXPERT, LAYERWISE
from probe_kit.hooks.families.molmoact2.packing import Packing
from probe_kit.hooks.families.molmoact2.steps import STEPS, in_packed_order, read_steps
from probe_kit.hooks.families.molmoact2.units import SteppedUnits
from probe_kit.hooks.families.shared.attention_weights import Note, recording_weights, shares
from probe_kit.hooks.families.shared.lerobot.config_fields import Inert
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser
from probe_kit.hooks.families.shared.lerobot.packed import PackedPolicy
from probe_kit.hooks.families.shared.lerobot.policy import checked_steps
from probe_kit.hooks.families.shared.lerobot.stacks import Stack
from probe_kit.hooks.verification.outputs import Produce, RecordedRun, stacked
from probe_kit.models.lerobot.molmoact2 import build_molmoact2, flow_actions, network_config, uses_cuda_graphs

_PRECISION = "dtype"


class ExpertStack(Stack):
    """The expert: what a block adds is read behind its gates, and its end in front of the last modulation."""

    def tap(self, site: Site) -> Tap:
        """Return the tap as in other stacks, with two attentions in a block."""
        if site.quantity in ("attention", "cross_attention", "mlp") and site.layer < len(self.layers):
            gate = getattr(self.layers[site.layer], f"{site.quantity}_gate")
            return Tap(gate, self.iterations or 1, "output")
        return super().tap(site)

    def stream(self, name: str) -> Stream:
        """Without heads: keys of its self-attention are its own positions, not the prompt's."""
        return Stream(name, len(self.layers) + 1, self.width, self.iterations, quantities=EXPERT, sums=False)


class TowerStack(Stack):
    """The vision tower, whose last blocks are read in two places and meet no final norm."""

    def stream(self, name: str) -> Stream:
        """The input of each block."""
        return Stream(name, len(self.layers), self.width, part="vision", quantities=("residual",))


class MolmoAct2(PackedPolicy):
    """A loaded MolmoAct2."""

    family = "molmoact2"
    config_type = "molmoact2"
    newer_fields: ClassVar[Inert] = {
        "norm_stats_path": (None,),
        **dict.fromkeys(("train_mode_vlm", "compile_model", "llm_residual_dropout")),
    }
    known_steps = STEPS
    interventions = LAYERWISE
    unread = ("model.lm_head.weight",)

    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    suffix_roles = ("action",)

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        super().__init__(network, folder, checkpoint)
        text = network.model.config.text_config
        self.passages = network._backbone().prompt_kv
        self.prompt_kv = kv_stream(int(text.num_hidden_layers), int(text.num_key_value_heads * text.head_dim))

    # -- loading -----------------------------------------------------------------------------------------

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """A newer lerobot calls the precision of the weights `dtype`. Raises CheckpointError for two of them."""
        renamed = {name: value for name, value in values.items() if name != _PRECISION}
        if (newer := values.get(_PRECISION)) is None:
            return renamed
        if renamed.setdefault("model_dtype", newer) != newer:
            raise CheckpointError(
                f"{path} says model_dtype: {renamed['model_dtype']!r} and dtype: {newer!r}. Keep the one that its "
                "weights were trained in"
            )
        return renamed

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Any) -> Any:
        """lerobot's configuration, with what the processor files say: lerobot packs as they do.

        checkpoint_path: then the folder of the VLM's configuration and tokenizer.
        """
        config = super().parse_config(folder, evaluation)
        config.steps = read_steps(folder, config)
        for name, value in config.steps.packing.items():
            setattr(config, name, value)
        config.input_features = in_packed_order(config, folder)
        config.checkpoint_path = str(inside_or_hub(folder, config.checkpoint_path))
        return config

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy of the size that the VLM's configuration has. Raises CheckpointError."""
        if config.enable_lora_vlm:
            raise CheckpointError(f"{folder} holds LoRA adapters; merge them into its weights with lerobot first")
        if config.action_mode == "discrete":
            raise CheckpointError(f"{folder} was trained for discrete actions only; the flow expert acts here")
        config.model_dtype = config.dtype = getattr(config, "dtype", None) or config.model_dtype
        config.inference_action_mode = "continuous"
        vlm_folder = Path(config.checkpoint_path)
        try:
            network: nn.Module = build_molmoact2(config, network_config(vlm_folder), vlm_folder)
        except (FileNotFoundError, ValueError) as error:
            if not config.norm_tag:
                raise
            raise CheckpointError(
                f"{folder} names the statistics {config.norm_tag!r}, which {vlm_folder} does not have ({error}). "
                "Put its norm_stats.json there"
            ) from error
        return network

    def parts(self) -> dict[str, Path]:
        """The VLM's configuration and tokenizer."""
        return {"vlm": Path(self.config.checkpoint_path)}

    def own_units(self, feature: str, kind: str) -> SteppedUnits | None:
        """The units of lerobot's steps: numbers that a mask leaves unscaled, clamps, and frames of joints."""
        units, steps = super().own_units(feature, kind), self.config.steps
        if units is None:
            return None
        assert isinstance(units, Normaliser)
        numbers = self._state_numbers if kind == "STATE" else self._action_numbers
        stored = load_file(self.folder / units.source) if units.mode != "IDENTITY" else {}
        unscaled = _of_width(~stored.get(f"{feature}.mask", np.ones(0, bool)).astype(bool), numbers)
        if kind != "STATE":
            return SteppedUnits(units, unscaled, steps.clamps_action, unscaled, steps.action_frame)
        unclamped = unscaled if steps.unclamped is None else _of_width(steps.unclamped, numbers)
        return SteppedUnits(units, unscaled, steps.clamps_state, unclamped, steps.state_frame)

    # -- acting ------------------------------------------------------------------------------------------

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """See the base. Raises CaptureError for CUDA graphs."""
        self._check_graphs()
        end = flow_actions(self.network, batch, noise, batch["action_dim_is_pad"])
        return end[..., : self._action_numbers]

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Actions of a chunk, and the widest action."""
        return self.config.chunk_size, self.config.expected_max_action_dim

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Computed once more: block n of the expert on the keys of block n of the backbone."""
        blocks = self.network._backbone().action_expert.blocks
        return recording_weights([block.cross_attn for block in blocks], note, _on_the_prompt)

    @property
    def _action_numbers(self) -> int:
        return int(self.config.output_features["action"].shape[0])

    def _check_graphs(self) -> None:
        if uses_cuda_graphs(self.network):
            raise CaptureError(
                "CUDA graphs of this MolmoAct2 are on: a replayed graph runs no hook, and captures would be old. "
                "Call network._set_inference_cuda_graph_enabled(False)"
            )

    # -- the prompt --------------------------------------------------------------------------------------

    @cached_property
    def packing(self) -> Packing:
        """lerobot's packing."""
        return Packing(self.config, self._action_numbers)

    # -- capture -----------------------------------------------------------------------------------------

    def _stacks(self) -> dict[str, Stack]:
        backbone = self.network._backbone()
        text, expert, tower = backbone.transformer, backbone.action_expert, backbone.vision_backbone.image_vit
        steps = int(self.config.num_inference_steps or backbone.config.flow_matching_num_steps)
        checked_steps(steps, self.folder)
        last = expert.final_layer.norm
        return {
            "backbone": Stack(text.blocks, text.ln_f, text.config.hidden_size, None, "attn_norm"),
            "expert": ExpertStack(expert.blocks, last, expert.config.hidden_size, steps, "self_norm"),
            "vision": TowerStack(
                tower.transformer.resblocks, last, tower.config.hidden_size, None, "attention_norm"
            ),
        }

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the final norm, or what a block adds behind its gate."""
        self._check_graphs()
        return super().tap(site)

    # -- verification ------------------------------------------------------------------------------------

    def watched(self) -> dict[str, nn.Module]:
        """The velocity."""
        return {"velocity": self.network._backbone().action_expert.final_layer}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """The backbone without its end, which only its final norm reads."""
        return {"backbone_resid": lambda: stacked(run.tape, self.streams["backbone"])[0, :-1]}


def _on_the_prompt(attention: Any, inputs: tuple[Any, ...], keywords: dict[str, Any], _: Any) -> Tensor:
    """(B, H, chunk, T): weights of the expert's actions on the prompt, whose kernel returns none."""
    queries = attention.q_proj(inputs[0]).unflatten(-1, (attention.num_heads, -1)).transpose(1, 2)
    if attention.q_norm is not None:
        queries = attention.q_norm(queries)
    keys = attention._as_heads(keywords["kv_k"]).transpose(1, 2)
    return shares(queries, keys, attention.head_dim**-0.5, {"attention_mask": keywords.get("attn_mask")})


def _of_width(marked: NDArray[np.bool_], numbers: int) -> NDArray[np.bool_]:
    """(numbers,), or nothing marked where it is of another width, as in lerobot."""
    return marked if marked.shape == (numbers,) else np.zeros(numbers, bool)
