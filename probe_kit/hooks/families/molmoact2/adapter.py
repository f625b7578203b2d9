"""The adapter for MolmoAct2.

Prefix: crops of every picture, then a prompt with the instruction and the state as tokens. Only pictures attend
both ways.
Suffix: the action chunk. Block n of the expert attends to the keys and values of block n of the backbone.

lerobot's constructor downloads and loads weights; here the network is built empty. Its flow draws noise for a
whole batch at once and may replay a CUDA graph, which runs no hook. `flow_actions` calls the same modules without
both.

Source: arXiv 2605.02881, through lerobot's `MolmoAct2Policy`.
"""

import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import Any, ClassVar, cast

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.molmoact2 import modeling_molmoact2
from lerobot.policies.molmoact2.configuration_molmoact2 import MolmoAct2Config
from lerobot.policies.molmoact2.modeling_molmoact2 import MolmoAct2Policy
from lerobot.policies.molmoact2.molmoact2_hf_model.configuration_molmoact2 import MolmoAct2Config as NetworkConfig
from lerobot.policies.molmoact2.molmoact2_hf_model.inference import _ActionFlowInputs
from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import MolmoAct2ForConditionalGeneration
from numpy.typing import NDArray
from safetensors.numpy import load_file
from torch import Tensor, nn

from probe_kit.errors import CaptureError, CheckpointError
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.sites import Site, kv_stream
from probe_kit.hooks.families.molmoact2 import EXPERT, LAYERWISE
from probe_kit.hooks.families.molmoact2.packing import (
    STEPS,
    FramedUnits,
    MolmoActPacking,
    in_packed_order,
    read_steps,
)
from probe_kit.hooks.families.shared.lerobot.flow import PackedPolicy
from probe_kit.hooks.families.shared.lerobot.pipelines import Inert
from probe_kit.hooks.families.shared.lerobot.policy import checked_steps
from probe_kit.hooks.families.shared.loading import DTYPES
from probe_kit.hooks.families.shared.taps import TOWER, Note, Stack, recording_weights, shares
from probe_kit.hooks.outputs import Produce, RecordedRun, stack_layers
from probe_kit.models.building import Gate, build_empty, building_device, replace_attributes
from probe_kit.models.checkpoint_files import load_pretrained
from probe_kit.models.decoding import PromptKV

RELEASED: dict[str, Any] = {
    "text_config": {
        "hidden_size": 2560, "intermediate_size": 9728, "num_hidden_layers": 36, "num_attention_heads": 32,
        "num_key_value_heads": 8, "head_dim": 128, "vocab_size": 154624, "additional_vocab_size": 128,
        "qkv_bias": False, "use_qk_norm": True, "qk_norm_type": "qwen3", "max_position_embeddings": 16384,
        "rope_theta": 5000000.0,
    },
    "vit_config": {
        "hidden_size": 1152, "intermediate_size": 4304, "num_hidden_layers": 27, "num_attention_heads": 16,
        "num_key_value_heads": 16, "head_dim": 72, "image_default_input_size": [378, 378],
        "image_patch_size": 14, "image_num_pos": 729,
    },
    "adapter_config": {
        "hidden_size": 1152, "text_hidden_size": 2560, "intermediate_size": 9728, "num_attention_heads": 16,
        "num_key_value_heads": 16, "head_dim": 72, "vit_layers": [-3, -9],
    },
    "action_expert_config": {
        "hidden_size": 768, "num_heads": 8, "num_layers": 36, "mlp_ratio": 4.0, "ffn_multiple_of": 256,
        "timestep_embed_dim": 256,
    },
    "max_action_dim": 32, "max_action_horizon": 30,
}  # fmt: skip
"""The sizes of the released configurations: Molmo2-ER on Qwen3-4B, an expert of 0.58 billion parameters."""
_PARTS = ("msa", "mca", "mlp")
"""The parts that a block of the expert adds: self-attention, attention to the prompt, MLP."""


def network_config(folder: Path | None = None) -> NetworkConfig:
    """The configuration in the VLM's own folder; without one, that of the released sizes."""
    with warnings.catch_warnings():
        # lerobot calls a check that transformers announces to remove; no user can change that.
        warnings.filterwarnings("ignore", "`rope_config_validation`", FutureWarning)
        config: NetworkConfig = (
            NetworkConfig(**RELEASED) if folder is None else load_pretrained(NetworkConfig, folder)
        )
    return config


def build_molmoact2(
    config: MolmoAct2Config, network: NetworkConfig, folder: Path, device: str = "cpu"
) -> MolmoAct2Policy:
    """Build lerobot's policy as `lerobots_policy` does, with modules that lerobot has not.

    Each block of the expert gets one per part that it adds: `attention_gate`, `cross_attention_gate`, `mlp_gate`.
    The prompt's keys and values pass through `prompt_kv`. Results stay lerobot's, bit for bit.
    """
    policy = lerobots_policy(config, network, folder, device)
    backbone: Any = policy._backbone()
    backbone.prompt_kv = PromptKV(len(backbone.transformer.blocks))
    for block in backbone.action_expert.blocks:
        attach_gates(block)
    return policy


def lerobots_policy(
    config: MolmoAct2Config, network: NetworkConfig, folder: Path, device: str = "cpu"
) -> MolmoAct2Policy:
    """Build a `MolmoAct2Policy` in eval mode with uninitialised weights and CUDA graphs off.

    Args:
        config: The configuration of lerobot.
        network: The configuration of the VLM.
        folder: The VLM's own folder.
        device: The device of the weights.
    """
    device = building_device(device)
    config.device, config.checkpoint_path = device, str(folder)
    dtype = DTYPES[config.model_dtype]

    def built(*_: Any, **__: Any) -> Any:
        return build_empty(lambda: MolmoAct2ForConditionalGeneration(network), dtype, device)

    replacements = {
        "_resolve_checkpoint_location": lambda *_, **__: str(folder),
        "HFMolmoAct2Config": SimpleNamespace(from_pretrained=lambda *_, **__: network),
        "MolmoAct2ForConditionalGeneration": SimpleNamespace(from_pretrained=built),
        "_strict_load_safetensors_weights": lambda *_: None,
    }
    with replace_attributes(modeling_molmoact2, replacements):
        policy = MolmoAct2Policy(config)
    policy.eval()
    policy._set_inference_cuda_graph_enabled(False)
    return cast(MolmoAct2Policy, policy)


def full_size_molmoact2() -> MolmoAct2Policy:
    """Build the released size, on the meta device."""
    picture = PolicyFeature(FeatureType.VISUAL, (3, 256, 256))
    config = MolmoAct2Config(device="cpu", input_features={"observation.images.image": picture})
    return build_molmoact2(config, network_config(), Path(), device="meta")


def attach_gates(block: Any) -> None:
    """Give a block of the expert the modules where its gates act."""
    block.attention_gate, block.cross_attention_gate, block.mlp_gate = Gate(), Gate(), Gate()
    block.forward = MethodType(_gated_forward, block)


def _gated_forward(
    block: Any,
    x: Tensor,
    conditioning: Tensor,
    *,
    cross_kv: tuple[Tensor, Tensor],
    self_attn_mask: Tensor | None = None,
    attn_mask: Tensor | None = None,
    is_causal: bool = False,
    modulation: tuple[Tensor, ...] | None = None,
    rope_cache: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Run lerobot's block, each of its three parts gated as it is added, and return (B, T, D)."""
    chunks = block.modulation(conditioning).chunk(9, dim=1) if modulation is None else modulation
    shift, scale, gate = (dict(zip(_PARTS, chunks[first::3], strict=True)) for first in range(3))

    def modulated(norm: Any, part: str) -> Tensor:
        return cast(Tensor, norm(x) * (1 + scale[part].unsqueeze(1)) + shift[part].unsqueeze(1))

    attended = block.self_attn(
        modulated(block.self_norm, "msa"), attn_mask=self_attn_mask, is_causal=is_causal, rope_cache=rope_cache
    )
    x = x + block.attention_gate(attended, gate["msa"].unsqueeze(1))
    read = block.cross_attn(
        modulated(block.cross_norm, "mca"), kv_k=cross_kv[0], kv_v=cross_kv[1], attn_mask=attn_mask
    )
    x = x + block.cross_attention_gate(read, gate["mca"].unsqueeze(1))
    written: Tensor = x + block.mlp_gate(block.mlp(modulated(block.ff_norm, "mlp")), gate["mlp"].unsqueeze(1))
    return written


def flow_actions(policy: Any, inputs: Mapping[str, Tensor], noise: Tensor, padded: Tensor) -> Tensor:
    """Return (B, H, 32) from noise of that shape: lerobot's flow, one inference.

    Args:
        policy: The policy of lerobot.
        inputs: The tensors that lerobot's processor packs.
        noise: (B, H, 32).
        padded: (B, 32) True for numbers that no action has.
    """
    backbone, model_inputs = policy._backbone(), policy._model_inputs(inputs)
    steps = int(policy.config.num_inference_steps or backbone.config.flow_matching_num_steps)
    with _precision(policy):
        outputs = backbone(**model_inputs, use_cache=True)
        backbone.prompt_kv(outputs.past_key_values.layers)
        states = backbone._extract_kv_states(outputs.past_key_values)
        mask = backbone._get_encoder_attention_mask(model_inputs["input_ids"], model_inputs.get("attention_mask"))
        gate, depth = backbone._depth_gate_from_condition(
            input_ids=model_inputs["input_ids"], encoder_attention_mask=mask, layer_kv_states=states
        )
        states = backbone._apply_depth_gate_to_layer_kv_states(states, depth, gate)
        expert, rows, device = backbone._require_action_expert(), len(noise), noise.device
        start = backbone._mask_action_dim_tensor(
            noise.to(expert.action_embed.weight.dtype),
            action_dim_is_pad=padded,
            enabled=backbone.config.mask_action_dim_padding,
        )
        context = expert.prepare_context(
            encoder_kv_states=states,
            encoder_attention_mask=mask,
            batch_size=rows,
            seq_len=start.shape[1],
            device=device,
            dtype=start.dtype,
        )
        times = [torch.full((rows,), step / steps, device=device) for step in range(steps)]
        # Computed anew: what lerobot keeps between calls would outlive a change of weights.
        modulations = expert.prepare_modulation_cache(times)
        end: Tensor = backbone._run_action_flow_loop(_ActionFlowInputs(start, context, modulations, padded), steps)
    return end


def _precision(policy: Any) -> AbstractContextManager[Any]:
    """The precision in which lerobot runs a checkpoint with weights in half precision."""
    dtype = DTYPES[policy.config.model_dtype]
    device = next(policy.parameters()).device.type
    return nullcontext() if dtype == torch.float32 else torch.autocast(device_type=device, dtype=dtype)


def uses_cuda_graphs(policy: Any) -> bool:
    """Whether lerobot would replay recorded kernels, past every hook."""
    network = policy._hf_model()
    managers = (policy._backbone().action_cuda_graph_manager, network.depth_decode_cuda_graph_manager)
    return any(getattr(manager, "enabled", False) for manager in managers)


# -- the adapter ----------------------------------------------------------------------------------------------

_PRECISION = "dtype"


_GATES = {quantity: f"{quantity}_gate" for quantity in ("attention", "cross_attention", "mlp")}
"""The gates behind which the parts that a block of the expert adds are read."""


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

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        super().__init__(network, folder, checkpoint)
        text = network.model.config.text_config
        self.passages = network._backbone().prompt_kv
        self.prompt_kv = kv_stream(int(text.num_hidden_layers), int(text.num_key_value_heads * text.head_dim))

    # -- loading -----------------------------------------------------------------------------------------

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the fields of `config.json`; a newer lerobot calls the precision of the weights `dtype`.

        Raises:
            CheckpointError: For two different precisions.
        """
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
        """Return lerobot's configuration, with what the processor files say: lerobot packs as they do.

        Its `checkpoint_path` is then the folder of the VLM's configuration and tokenizer.
        """
        config = super().parse_config(folder, evaluation)
        read_steps(config, folder)
        config.input_features = in_packed_order(config, folder)
        config.checkpoint_path = str(inside_or_hub(folder, config.checkpoint_path))
        return config

    @classmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy of the size that the VLM's configuration has.

        Raises:
            CheckpointError: For LoRA adapters, for a policy of discrete actions only, and for missing statistics.
        """
        if config.enable_lora_vlm:
            raise CheckpointError(f"{folder} holds LoRA adapters; merge them into its weights with lerobot first")
        if config.action_mode == "discrete":
            raise CheckpointError(f"{folder} was trained for discrete actions only; the flow expert acts here")
        config.model_dtype = config.dtype = getattr(config, "dtype", None) or config.model_dtype
        config.inference_action_mode = "continuous"
        vlm_folder = Path(config.checkpoint_path)
        try:
            return build_molmoact2(config, network_config(vlm_folder), vlm_folder)
        except (FileNotFoundError, ValueError) as error:
            if not config.norm_tag:
                raise
            raise CheckpointError(
                f"{folder} names the statistics {config.norm_tag!r}, which {vlm_folder} does not have ({error}). "
                "Put its norm_stats.json there"
            ) from error

    def parts(self) -> dict[str, Path]:
        """Return the folder of the VLM's configuration and tokenizer."""
        return {"vlm": Path(self.config.checkpoint_path)}

    def own_units(self, feature: str, kind: str) -> FramedUnits | None:
        """Return the units of lerobot's steps: numbers that a mask leaves unscaled, clamps, frames of joints."""
        units, config = super().own_units(feature, kind), self.config
        if units is None:
            return None
        is_state = kind == "STATE"
        numbers = self.state_numbers if is_state else self._action_numbers
        stored = load_file(self.folder / units.source) if units.mode != "IDENTITY" else {}
        plain = _mask_of_width(~stored.get(f"{feature}.mask", np.ones(0, bool)).astype(bool), numbers)
        clamped = np.full(numbers, config.clamps_state if is_state else config.clamps_action)
        if is_state:
            clamped &= ~(plain if config.unclamped is None else _mask_of_width(config.unclamped, numbers))
        frame = config.state_frame if is_state else config.action_frame
        statistics = (units.mode, units.low, units.high, units.eps, units.source)
        return FramedUnits(*statistics, plain=plain, clamped=clamped, frame=frame, stored=units.stored)

    # -- acting ------------------------------------------------------------------------------------------

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return the actions as the base does.

        Raises:
            CaptureError: If CUDA graphs are on.
        """
        self._check_graphs()
        end = flow_actions(self.network, batch, noise, batch["action_dim_is_pad"])
        return end[..., : self._action_numbers]

    @property
    def noise_shape(self) -> tuple[int, int]:
        """The shape of one row's noise: actions of a chunk, and the widest action."""
        return self.config.chunk_size, self.config.expected_max_action_dim

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Record attention that is computed once more.

        Block n of the expert attends to the keys of block n of the backbone.
        """
        blocks = self.network._backbone().action_expert.blocks
        return recording_weights([block.cross_attn for block in blocks], note, _on_the_prompt)

    def _check_graphs(self) -> None:
        if uses_cuda_graphs(self.network):
            raise CaptureError(
                "CUDA graphs of this MolmoAct2 are on: a replayed graph runs no hook, and captures would be old. "
                "Call network._set_inference_cuda_graph_enabled(False)"
            )

    # -- the prompt --------------------------------------------------------------------------------------

    @cached_property
    def packing(self) -> MolmoActPacking:
        """The packing of lerobot."""
        return MolmoActPacking(self.config, self._action_numbers)

    # -- capture -----------------------------------------------------------------------------------------

    def _stacks(self) -> dict[str, Stack]:
        backbone = self.network._backbone()
        text, expert, tower = backbone.transformer, backbone.action_expert, backbone.vision_backbone.image_vit
        steps = int(self.config.num_inference_steps or backbone.config.flow_matching_num_steps)
        checked_steps(steps, self.folder)
        # Keys of the expert's self-attention are its own positions, not the prompt's: it declares no heads. Its
        # end is read in front of the last modulation.
        last, gated = expert.final_layer.norm, {"quantities": EXPERT, "sums": False, "heads": 0}
        # The tower's last blocks are read in two places and meet no final norm.
        seeing = tower.transformer.resblocks
        width, fields = tower.config.hidden_size, {**TOWER, "layers": len(seeing)}
        return {
            "backbone": Stack(text.blocks, text.ln_f, text.config.hidden_size, None, "attn_norm"),
            "expert": Stack(
                expert.blocks, last, expert.config.hidden_size, steps, "self_norm", _GATES, stream_fields=gated
            ),
            "vision": Stack(seeing, last, width, None, "attention_norm", stream_fields=fields),
        }

    def tap(self, site: Site) -> Tap:
        """Return the first norm of the block the site enters, the final norm, or what a block adds, gated.

        Raises:
            CaptureError: If CUDA graphs are on.
        """
        self._check_graphs()
        return super().tap(site)

    # -- verification ------------------------------------------------------------------------------------

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return the module of the velocity."""
        return {"velocity": self.network._backbone().action_expert.final_layer}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return the backbone without its end, which only its final norm reads."""
        return {"backbone_resid": lambda: stack_layers(run.activations, self.streams["backbone"])[0, :-1]}


def _on_the_prompt(attention: Any, inputs: tuple[Any, ...], keywords: dict[str, Any], _: Any) -> Tensor:
    """Return the weights (B, H, chunk, T) of the expert's actions on the prompt, whose kernel returns none."""
    queries = attention.q_proj(inputs[0]).unflatten(-1, (attention.num_heads, -1)).transpose(1, 2)
    if attention.q_norm is not None:
        queries = attention.q_norm(queries)
    keys = attention._as_heads(keywords["kv_k"]).transpose(1, 2)
    return shares(queries, keys, attention.head_dim**-0.5, {"attention_mask": keywords.get("attn_mask")})


def _mask_of_width(marked: NDArray[np.bool_], numbers: int) -> NDArray[np.bool_]:
    """Return a mask (numbers,), or nothing marked where it is of another width, as in lerobot."""
    return marked if marked.shape == (numbers,) else np.zeros(numbers, bool)
