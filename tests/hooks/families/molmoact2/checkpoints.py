"""Tiny MolmoAct2 checkpoints in lerobot's layout, with the VLM's files in a folder inside."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import save_file
from tokenizers import AddedToken, Tokenizer
from tokenizers.decoders import ByteLevel as Bytes
from tokenizers.models import BPE
from tokenizers.pre_tokenizers import ByteLevel

from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST
from tests.support.lerobot_units import write_units
from tests.support.written_once import written_once

STATE_TOKENS = 16
ADDED = [
    "<im_patch>", "<im_low>", "<im_start>", "<low_res_im_start>", "<frame_start>", "<im_end>", "<frame_end>",
    "<im_col>", "<|image|>", "<|video|>", "<|im_start|>", "<|im_end|>", "<|endoftext|>", "<action_output>",
    "<action_start>", "<action_end>", "<state_start>", "<state_end>", "<setup_start>", "<setup_end>",
    "<control_start>", "<control_end>", *(f"<state_{number}>" for number in range(STATE_TOKENS)),
]  # fmt: skip
MASK = np.array([True] * 6 + [False])
"""The gripper stays as it is."""


@written_once
def write_molmoact2(folder: Path, seed: int = 0, cameras: Sequence[str] = ("image",), **fields: Any) -> Path:
    """Two blocks of width 32 that look at crops of 16 pixels; `fields` go into lerobot's configuration."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.molmoact2.configuration_molmoact2 import MolmoAct2Config

    from probe_kit.hooks.families.molmoact2.adapter import build_molmoact2, network_config
    from probe_kit.models.building import initialise

    ids = _write_vlm(folder / "vlm")
    config = MolmoAct2Config(
        input_features={
            **{f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 24, 40)) for name in cameras},
            "observation.state": PolicyFeature(FeatureType.STATE, (len(LOW),)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(MOST),))},
        device="cpu",
        checkpoint_path="vlm",
        chunk_size=4,
        n_action_steps=4,
        num_inference_steps=3,
        model_dtype="float32",
        inference_action_mode="continuous",
        num_state_tokens=STATE_TOKENS,
        max_sequence_length=400,
        setup_type="table",
        control_mode="delta",
        **fields,
    )
    config.save_pretrained(folder)
    (folder / "vlm" / "config.json").write_text(json.dumps(_network(ids)), encoding="utf-8")
    network = build_molmoact2(config, network_config(folder / "vlm"), folder / "vlm")
    initialise(network, seed)
    tensors = {name: tensor.clone().contiguous() for name, tensor in network.state_dict().items()}
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    write_units(folder, "observation.state", "QUANTILES", {"q01": LOW, "q99": HIGH})
    write_units(folder, "action", "QUANTILES", {"q01": LEAST, "q99": MOST, "mask": MASK})
    for file in folder.glob("policy_*processor.json"):
        text = file.read_text(encoding="utf-8")
        for kind in ("unnormalizer", "normalizer"):
            text = text.replace(f'"{kind}_processor"', f'"molmoact2_masked_{kind}"')
        file.write_text(text, encoding="utf-8")
    return folder


def _network(ids: dict[str, int]) -> dict[str, Any]:
    tower = {"hidden_size": 24, "intermediate_size": 32, "num_attention_heads": 3, "num_key_value_heads": 3,
             "head_dim": 8, "attn_implementation": "eager"}  # fmt: skip
    text = {
        "hidden_size": 32,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 8,
        "vocab_size": 256,
        "additional_vocab_size": len(ADDED),
        "num_hidden_layers": 2,
        "intermediate_size": 48,
        "max_position_embeddings": 512,
        "use_qk_norm": True,
        "qk_norm_type": "qwen3",
        "qkv_bias": False,
        "attn_implementation": "eager",
    }
    return {
        "model_type": "molmoact2",
        "vit_config": {**tower, "num_hidden_layers": 3, "image_default_input_size": [16, 16],
                       "image_patch_size": 4, "image_num_pos": 16},
        "adapter_config": {**tower, "vit_layers": [-1, -2], "text_hidden_size": 32},
        "text_config": text,
        "action_expert_config": {"hidden_size": 24, "num_layers": 2, "num_heads": 3, "ffn_multiple_of": 8,
                                 "timestep_embed_dim": 16},
        "max_action_horizon": 4,
        "image_start_token_id": ids["<im_start>"],
        "low_res_image_start_token_id": ids["<low_res_im_start>"],
        "image_end_token_id": ids["<im_end>"],
        "image_low_res_id": ids["<im_low>"],
        "image_patch_id": ids["<im_patch>"],
        "image_col_id": ids["<im_col>"],
        "frame_start_token_id": ids["<frame_start>"],
        "frame_end_token_id": ids["<frame_end>"],
        "action_start_token_id": ids["<action_start>"],
        "action_end_token_id": ids["<action_end>"],
        "eos_token_id": ids["<|im_end|>"],
    }  # fmt: skip


def _write_vlm(folder: Path) -> dict[str, int]:
    """A tokenizer of bytes with the special tokens of the released one, and how pictures become crops."""
    folder.mkdir(parents=True, exist_ok=True)
    alphabet = sorted(ByteLevel.alphabet())
    tokenizer = Tokenizer(BPE({byte: index for index, byte in enumerate(alphabet)}, []))
    tokenizer.pre_tokenizer, tokenizer.decoder = ByteLevel(add_prefix_space=False), Bytes()
    tokenizer.add_special_tokens([AddedToken(token, normalized=False, special=True) for token in ADDED])
    tokenizer.save(str(folder / "tokenizer.json"))
    (folder / "vocab.json").write_text(
        json.dumps({byte: index for index, byte in enumerate(alphabet)}), encoding="utf-8"
    )
    (folder / "merges.txt").write_text("#version: 0.2\n", encoding="utf-8")
    card = {"tokenizer_class": "Qwen2Tokenizer", "eos_token": "<|im_end|>", "pad_token": "<|endoftext|>",
            "unk_token": None, "bos_token": None, "padding_side": "left",
            "additional_special_tokens": ADDED}  # fmt: skip
    (folder / "tokenizer_config.json").write_text(json.dumps(card), encoding="utf-8")
    pictures = {"size": {"height": 16, "width": 16}, "patch_size": 4, "max_crops": 2, "overlap_margins": [1, 1],
                "pooling_size": [2, 2]}  # fmt: skip
    content = {"image_processor": pictures, "video_processor": {}, "use_single_crop_start_token": True}
    (folder / "processor_config.json").write_text(json.dumps(content), encoding="utf-8")
    return {token: tokenizer.token_to_id(token) for token in ADDED}
