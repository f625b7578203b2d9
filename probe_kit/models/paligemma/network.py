"""PaliGemma's network, built empty from a configuration."""

from typing import Any

import torch
from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration

from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.naming import LANGUAGE_FIRST

FILE_NAMES = LANGUAGE_FIRST


def build_paligemma(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """The network in eval mode; see `build_empty`. What no checkpoint holds is computed on the CPU."""
    network: Any = build_empty(lambda: PaliGemmaForConditionalGeneration(config), dtype, device)
    language = network.model.language_model
    fill_decoder_rotary(language)
    embedding = language.embed_tokens
    embedding.embed_scale = torch.tensor(embedding.scalar_embed_scale)
    embeddings = network.model.vision_tower.vision_model.embeddings
    embeddings.position_ids = torch.arange(embeddings.num_positions).expand((1, -1))
    network.tie_weights()
    return network


def full_size_paligemma() -> Any:
    """PaliGemma 3B for pictures of 224 pixels, on the meta device."""
    text = {
        "model_type": "gemma",
        "hidden_size": 2048,
        "intermediate_size": 16384,
        "num_hidden_layers": 18,
        "num_attention_heads": 8,
        "num_key_value_heads": 1,
        "head_dim": 256,
        "vocab_size": 257216,
    }
    vision = {
        "model_type": "siglip_vision_model",
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 27,
        "num_attention_heads": 16,
        "patch_size": 14,
        "image_size": 224,
        "projection_dim": 2048,
        "vision_use_head": False,
    }
    config = PaliGemmaConfig(text_config=text, vision_config=vision, projection_dim=2048, hidden_size=2048)
    return build_paligemma(config, torch.float32)
