"""lerobot's own `MolmoAct2Policy` at the size a checkpoint has, and its flow from noise that is given.

lerobot's constructor downloads and loads weights; here the network is built empty. Its flow draws noise for a
whole batch at once and may replay a CUDA graph, which runs no hook. `flow_actions` calls the same modules without
both.

Source: arXiv 2605.02881, through lerobot's `MolmoAct2Policy`.
"""

import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import Any, cast

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.molmoact2 import modeling_molmoact2
from lerobot.policies.molmoact2.configuration_molmoact2 import MolmoAct2Config
from lerobot.policies.molmoact2.modeling_molmoact2 import MolmoAct2Policy
from lerobot.policies.molmoact2.molmoact2_hf_model.configuration_molmoact2 import MolmoAct2Config as NetworkConfig
from lerobot.policies.molmoact2.molmoact2_hf_model.inference import _ActionFlowInputs
from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import MolmoAct2ForConditionalGeneration
from torch import Tensor

from probe_kit.models.building import build_empty, replaced
from probe_kit.models.lerobot.pi05 import Gate
from probe_kit.models.pretrained import load_pretrained
from probe_kit.models.prompt_kv import PromptKV
from probe_kit.models.sizes_only import building_device

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
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
"""What the released configurations say of sizes: Molmo2-ER on Qwen3-4B, an expert of 0.58 billion parameters."""
_PARTS = ("msa", "mca", "mlp")
"""What a block of the expert adds: self-attention, attention to the prompt, MLP."""


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
    """lerobot's policy as `lerobots_policy` builds it, with modules that lerobot has not.

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
    """A `MolmoAct2Policy` in eval mode with uninitialised weights and CUDA graphs off.

    network: the configuration in the VLM's own folder `folder`.
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
    with replaced(modeling_molmoact2, replacements):
        policy = MolmoAct2Policy(config)
    policy.eval()
    policy._set_inference_cuda_graph_enabled(False)
    return cast(MolmoAct2Policy, policy)


def full_size_molmoact2() -> MolmoAct2Policy:
    """The released size, on the meta device."""
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
    """(B, T, D): lerobot's block, each of its three parts gated as it is added."""
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
    """(B, H, 32) from noise of that shape: lerobot's flow, one inference.

    inputs: what lerobot's processor packs. padded: (B, 32) True for numbers that no action has.
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
