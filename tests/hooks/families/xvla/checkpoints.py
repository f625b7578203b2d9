"""Tiny X-VLA checkpoints as lerobot writes them; also with Florence-2 in the layout of its authors."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer
from tokenizers.processors import TemplateProcessing

from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST
from tests.support.qwen_checkpoints import write_tokenizer
from tests.support.written_once import written_once

SPECIAL = ("<pad>", "<s>", "</s>", "<unk>")
CHUNK, TEXT, DOMAINS, DOMAIN = 4, 64, 5, 3
FLORENCE: dict[str, Any] = {
    "vision_config": {
        "embed_dim": [8, 16, 16, 24], "num_heads": [1, 2, 2, 3], "num_groups": [1, 2, 2, 3],
        "depths": [1, 1, 2, 1], "window_size": 4, "projection_dim": 32, "max_position_embeddings": 10,
        "max_temporal_embeddings": 4,
    },
    "text_config": {
        "model_type": "bart", "vocab_size": 272, "d_model": 32, "encoder_layers": 3, "encoder_attention_heads": 4,
        "encoder_ffn_dim": 48, "decoder_layers": 1, "decoder_attention_heads": 4, "decoder_ffn_dim": 48,
        "max_position_embeddings": 128, "pad_token_id": 256, "bos_token_id": 257, "eos_token_id": 258,
        "scale_embedding": False,
    },
    "pad_token_id": 256, "bos_token_id": 257, "eos_token_id": 258, "image_token_id": 271,
}  # fmt: skip


@written_once
def write_xvla(
    folder: Path, seed: int = 0, cameras: Sequence[str] = ("image",), views: int | None = 2, **fields: Any
) -> Path:
    """Three layers of Florence-2's encoder, three blocks of an expert over four actions and two soft prompts.

    views: pictures in the sequence, the missing ones masked. fields: of lerobot's configuration.
    """
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig
    from lerobot.policies.xvla.processor_xvla import XVLAAddDomainIdProcessorStep, make_xvla_pre_post_processors

    from probe_kit.hooks.families.xvla.adapter import build_xvla
    from probe_kit.models.building import initialise

    write_bart_tokenizer(folder)
    config = XVLAConfig(
        input_features={
            **{f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 48, 80)) for name in cameras},
            "observation.state": PolicyFeature(FeatureType.STATE, (len(LOW),)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(MOST),))},
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        },
        device="cpu", florence_config=FLORENCE, tokenizer_name=str(folder), tokenizer_max_length=TEXT,
        chunk_size=CHUNK, n_action_steps=CHUNK, hidden_size=24, depth=3, num_heads=3, num_domains=DOMAINS,
        len_soft_prompts=2, dim_time=8, max_len_seq=160, num_denoising_steps=3, max_state_dim=10, max_action_dim=9,
        action_mode="auto", resize_imgs_with_padding=(64, 64), num_image_views=views, **fields,
    )  # fmt: skip
    network = build_xvla(config)
    initialise(network, seed)
    statistics = {"observation.state": {"min": LOW, "max": HIGH}, "action": {"min": LEAST, "max": MOST}}
    tensors = {
        key: {name: torch.from_numpy(array) for name, array in rows.items()} for key, rows in statistics.items()
    }
    pipelines = make_xvla_pre_post_processors(config, tensors)
    for step in pipelines[0].steps:
        if isinstance(step, XVLAAddDomainIdProcessorStep):
            step.domain_id = DOMAIN
    for pipeline, name in zip(pipelines, ("pre", "post"), strict=True):
        pipeline.save_pretrained(folder, config_filename=f"policy_{name}processor.json")
    config.tokenizer_name = "facebook/bart-large"
    network.save_pretrained(folder)
    file = folder / "policy_preprocessor.json"
    text = file.read_text(encoding="utf-8").replace(json.dumps(str(folder)), json.dumps(config.tokenizer_name))
    file.write_text(text, encoding="utf-8")
    return folder


def write_bart_tokenizer(folder: Path) -> None:
    """A tokenizer of bytes that puts every text between two marks, as BART's does."""
    write_tokenizer(folder, SPECIAL)
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    marks = [("<s>", 257), ("</s>", 258)]
    tokenizer.post_processor = TemplateProcessing(single="<s> $A </s>", pair=None, special_tokens=marks)
    tokenizer.save(str(folder / "tokenizer.json"))
    card = {"tokenizer_class": "PreTrainedTokenizerFast", "pad_token": "<pad>", "bos_token": "<s>",
            "eos_token": "</s>", "unk_token": "<unk>"}  # fmt: skip
    (folder / "tokenizer_config.json").write_text(json.dumps(card), encoding="utf-8")


_AUTHORS = (
    (r"vision_tower\.convs\.(\d+)\.conv\.", r"vision_tower.convs.\1.proj."),
    (r"(vision_tower\.blocks\.\d+\.\d+\.\w+_block)\.conv(\d)\.", r"\1.conv\2.fn.dw."),
    (r"(vision_tower\.blocks\.\d+\.\d+\.(window|channel|spatial)_block)\.norm2\.", r"\1.ffn.norm."),
    (r"(vision_tower\.blocks\.\d+\.\d+\.\w+_block)\.ffn\.(?!norm)", r"\1.ffn.fn.net."),
    (r"(spatial_block)\.norm1\.", r"\1.window_attn.norm."),
    (r"(channel_block)\.norm1\.", r"\1.channel_attn.norm."),
    (r"\.(window|channel)_attn\.(?!norm)", r".\1_attn.fn."),
    (r"multi_modal_projector\.image_proj_norm\.", "image_proj_norm."),
    (r"multi_modal_projector\.image_position_embed\.", "image_pos_embed."),
    (r"multi_modal_projector\.visual_temporal_embed\.", "visual_temporal_embed."),
    (r"language_model\.", "language_model.model."),
)


def to_authors_layout(folder: Path) -> None:
    """Rename Florence-2's tensors in a checkpoint as its authors, and files of 2025, have them."""
    renamed = {}
    for key, value in load_file(folder / "model.safetensors").items():
        if key.startswith("model.vlm."):
            for pattern, replacement in _AUTHORS:
                key = re.sub(pattern, replacement, key)
        if key.endswith("multi_modal_projector.image_projection.weight"):
            key, value = "model.vlm.image_projection", value.T.contiguous()
        renamed[key] = value
    renamed["model.vlm.language_model.final_logits_bias"] = torch.zeros(1, 272)
    save_file(renamed, folder / "model.safetensors")
