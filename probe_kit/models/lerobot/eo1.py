"""lerobot's own `EO1Policy` at the size a checkpoint has, its prompts, and its flow from noise that is given.

Source: arXiv 2508.21112 (EO-1), through lerobot's `EO1Policy`.
"""

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.eo1 import processor_eo1
from lerobot.policies.eo1.configuration_eo1 import EO1Config
from lerobot.policies.eo1.modeling_eo1 import EO1Policy
from lerobot.policies.eo1.processor_eo1 import EO1QwenProcessorStep
from torch import Tensor, nn
from transformers import Qwen2_5_VLProcessor

from probe_kit.errors import CheckpointError
from probe_kit.models.building import build_empty, fill_rotary, replaced
from probe_kit.models.pretrained import load_pretrained
from probe_kit.models.prompt_kv import PromptKV
from probe_kit.models.qwen import qwen2_5_vl_config
from probe_kit.models.sizes_only import building_device


def build_eo1(config: EO1Config, device: str = "cpu") -> EO1Policy:
    """An `EO1Policy` in eval mode with uninitialised weights; `config.dtype` is that of the Qwen2.5-VL."""
    config.device = building_device(device)
    config.pretrained_path = config.pretrained_path or Path()  # else lerobot downloads the weights of Qwen2.5-VL
    policy = cast(EO1Policy, build_empty(lambda: EO1Policy(config), torch.float32, config.device))
    vlm: Any = policy.model.vlm_backbone
    vlm.to(getattr(torch, config.dtype))
    fill_rotary(vlm)
    prompt_kv = PromptKV(int(vlm.config.text_config.num_hidden_layers))
    policy.model.prompt_kv = prompt_kv

    def send(_: nn.Module, __: Any, keywords: Mapping[str, Any], output: Any) -> None:
        if keywords.get("pixel_values") is not None:  # the prompt; steps of the flow read no picture
            prompt_kv(output.past_key_values.layers)

    vlm.model.register_forward_hook(send, with_kwargs=True)
    return policy


def full_size_eo1() -> EO1Policy:
    """EO-1 on Qwen2.5-VL-3B, on the meta device."""
    config = EO1Config(
        device="cpu",
        dtype="float32",
        vlm_config=qwen2_5_vl_config("3B").to_dict(),
        input_features={"observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))},
    )
    return build_eo1(config, "meta")


def chat_step(folder: Path, fields: Mapping[str, Any]) -> EO1QwenProcessorStep:
    """lerobot's step that reads a chat. folder: of the processor's files.

    Raises CheckpointError for files without a chat template.
    """
    logging.getLogger("transformers.processing_utils").addFilter(_is_news)
    safely = SimpleNamespace(from_pretrained=partial(load_pretrained, Qwen2_5_VLProcessor))
    with replaced(processor_eo1, {"Qwen2_5_VLProcessor": safely}):
        step = EO1QwenProcessorStep(**{**fields, "processor_name": str(folder)})
    if step._processor.chat_template is None:
        raise CheckpointError(f"{folder} has no chat_template, and EO-1 reads a chat. Take Qwen2.5-VL's own files")
    return step


def _is_news(record: logging.LogRecord) -> bool:
    """Whether transformers says something else than, at every chat, how lerobot should give its keywords."""
    return "processor_kwargs" not in record.getMessage()


def flow_actions(policy: Any, batch: Mapping[str, Any], noise: Tensor) -> Tensor:
    """(B, chunk, D) normalised actions: lerobot's `predict_action_chunk`, which draws its noise itself."""
    policy.model.sample_noise = lambda *_: noise
    try:
        return cast(Tensor, policy.predict_action_chunk(dict(batch)))
    finally:
        del policy.model.sample_noise
