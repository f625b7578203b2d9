"""lerobot's own `GrootPolicy` at the size a checkpoint has, and its flow from noise that is given.

lerobot's constructor downloads and loads weights and allows remote code; here the network is built empty, of
transformers' own classes. Its flow draws noise for a whole batch at once; `flow_actions` calls the same modules
with noise that is given.

Source: arXiv 2503.14734 and the released GR00T N1.7, through lerobot's `GrootPolicy`.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from types import SimpleNamespace
from typing import Any, cast

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.groot import groot_n1_7, modeling_groot
from lerobot.policies.groot.configuration_groot import GROOT_N1_7_BACKBONE_MODEL, GrootConfig
from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config, Qwen3Backbone
from lerobot.policies.groot.modeling_groot import GrootPolicy
from torch import Tensor
from transformers import BatchFeature

from probe_kit.errors import CheckpointError
from probe_kit.models.building import build_empty, replaced
from probe_kit.models.sizes_only import building_device

VLM = GROOT_N1_7_BACKBONE_MODEL
"""Whose configuration lerobot holds itself; any other is read from its folder."""


def network_config(values: Mapping[str, Any], config: GrootConfig, vlm: str) -> GR00TN17Config:
    """The network's configuration: the content of its `config.json`, and what lerobot's `config` sets over it.

    vlm: `VLM`, or the folder of the vision-language model's configuration. Raises CheckpointError for another kind
    of backbone.
    """
    network = GR00TN17Config.from_dict(dict(values))
    if network.backbone_model_type != "qwen":
        raise CheckpointError(
            f"the backbone is {network.backbone_model_type!r}; lerobot's GR00T N1.7 has a Qwen3-VL, 'qwen'"
        )
    network.model_name, network.use_flash_attention, network.load_bf16 = vlm, False, False
    if config.num_inference_timesteps is not None:
        network.num_inference_timesteps = config.num_inference_timesteps
    return network


def build_groot(config: GrootConfig, network: GR00TN17Config, device: str = "cpu") -> GrootPolicy:
    """A `GrootPolicy` in eval mode with uninitialised weights; parameters in float32 where `config` says so."""
    device = building_device(device)
    config.device = device
    dtype = torch.float32 if config.model_params_fp32 else torch.bfloat16

    def built(*_: Any, **__: Any) -> Any:
        model = build_empty(
            lambda: GR00TN17(network, {"trust_remote_code": False}, load_backbone_weights=False), dtype, device
        )
        for parameter in model.parameters():  # transformers builds parts in the precision their own files name
            parameter.data = parameter.data.to(dtype)
        return model

    with (
        replaced(modeling_groot, {"GR00TN17": SimpleNamespace(from_pretrained=built)}),
        replaced(groot_n1_7, {"get_backbone_cls": lambda _: Qwen3Backbone}),  # which warns of every other name
    ):
        policy = GrootPolicy(config)
    policy.eval()
    return cast(GrootPolicy, policy)


def full_size_groot() -> GrootPolicy:
    """The size that lerobot's configuration of GR00T N1.7 has by default, on the meta device."""
    picture = PolicyFeature(FeatureType.VISUAL, (3, 256, 256))
    config = GrootConfig(device="cpu", input_features={"observation.images.image": picture})
    return build_groot(config, network_config({}, config, VLM), device="meta")


def flow_actions(policy: Any, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
    """(B, H, D) normalised actions from noise of that shape: lerobot's flow, one inference.

    inputs: what lerobot's processors pack. H, D: the network's own horizon and widest action.
    """
    model, head = policy._groot_model, policy._groot_model.action_head
    placed = {name: _placed(tensor, model) for name, tensor in inputs.items()}
    with _precision(policy, noise.device.type):
        prompt = model.backbone(BatchFeature(placed))
        features = head._encode_features(prompt, BatchFeature(placed))
        read, state = features.backbone_features, features.state_features
        masks = {"image_mask": prompt.image_mask, "backbone_attention_mask": prompt.backbone_attention_mask}
        actions = noise.to(read.dtype)
        for step in range(head.num_inference_timesteps):
            time = int(step / float(head.num_inference_timesteps) * head.num_timestep_buckets)
            times = torch.full((len(noise),), time, device=noise.device)
            noisy = head.action_encoder(actions, times, placed["embodiment_id"])
            if head.config.add_pos_embed:
                noisy = noisy + head.position_embedding(torch.arange(noisy.shape[1], device=noise.device))[None]
            read_by = head.model(
                hidden_states=torch.cat((state, noisy), dim=1),
                encoder_hidden_states=read,
                timestep=times,
                **(masks if head.config.use_alternate_vl_dit else {}),
            )
            velocity = head.action_decoder(read_by, placed["embodiment_id"])[:, -head.action_horizon :]
            actions = actions + 1.0 / head.num_inference_timesteps * velocity
    return actions


def _placed(tensor: Tensor, model: Any) -> Tensor:
    """Return a tensor as the network's own `prepare_input` does: numbers in the precision of its weights."""
    return tensor.to(model.device, model.dtype if tensor.is_floating_point() else tensor.dtype)


def _precision(policy: Any, device: str) -> AbstractContextManager[Any]:
    """The precision in which lerobot runs a checkpoint whose configuration says `use_bf16`."""
    return torch.autocast(device_type=device, dtype=torch.bfloat16, enabled=policy.config.use_bf16)
