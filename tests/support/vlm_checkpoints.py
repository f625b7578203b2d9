"""Small checkpoints of vision-language models with random weights, in the layout of the released ones."""

import json
import re
from pathlib import Path
from typing import Any

import torch
from torch import nn

from probe_kit.hooks.families.internvl.network import build_internvl
from probe_kit.hooks.families.ovis2_5.network import OvisConfig, build_ovis2_5
from probe_kit.hooks.families.paligemma.network import build_paligemma
from probe_kit.hooks.families.shared.qwen.network import build_qwen2_5_vl, build_qwen3_vl
from probe_kit.models.building import initialise
from tests.support.qwen_checkpoints import ID, SPECIAL, picture_settings, save_sharded, token_ids, write_tokenizer
from tests.support.written_once import written_once

INTERNVL_SPECIAL = (*SPECIAL, "<img>", "</img>", "<IMG_CONTEXT>")
PALIGEMMA_SPECIAL = ("<pad>", "<eos>", "<bos>", "<image>")
VOCABULARY = 272
_TEXT = {
    "vocab_size": VOCABULARY,
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "max_position_embeddings": 2048,
}
_SQUARE = {
    "do_resize": True,
    "do_rescale": True,
    "do_normalize": True,
    "rescale_factor": 1 / 255,
    "resample": 3,
    "image_mean": [0.5, 0.5, 0.5],
    "image_std": [0.25, 0.25, 0.25],
}


@written_once
def write_qwen2_5_vl(folder: Path, seed: int = 1, tied: bool = False, **fields: Any) -> Path:
    """The old flat configuration and the names of released files."""
    vision = {
        "depth": 3, "hidden_size": 32, "intermediate_size": 48, "num_heads": 2, "patch_size": 14,
        "spatial_merge_size": 2, "temporal_patch_size": 2, "window_size": 56, "fullatt_block_indexes": [1],
        "out_hidden_size": 32,
    }  # fmt: skip
    values = {
        "model_type": "qwen2_5_vl", "vision_config": vision, "tie_word_embeddings": tied, **_TEXT, **token_ids(),
        "rope_scaling": {"type": "mrope", "mrope_section": [2, 1, 1]}, **fields,
    }  # fmt: skip
    from transformers import Qwen2_5_VLConfig

    network = build_qwen2_5_vl(Qwen2_5_VLConfig.from_dict(values), torch.float32, "cpu")
    names = ((r"^model\.visual\.", "visual."), (r"^model\.language_model\.", "model."))
    return _write(folder, values, network, seed, names, picture_settings(14, 784, 50176), ID["<|im_end|>"])


@written_once
def write_qwen3_vl(folder: Path, seed: int = 1, tied: bool = True, **fields: Any) -> Path:
    """As Qwen3-VL-4B: output weights tied, DeepStack behind two blocks of the tower."""
    vision = {
        "depth": 3, "hidden_size": 32, "intermediate_size": 48, "num_heads": 2, "patch_size": 16,
        "spatial_merge_size": 2, "temporal_patch_size": 2, "out_hidden_size": 32, "num_position_embeddings": 64,
        "deepstack_visual_indexes": [0, 1],
    }  # fmt: skip
    rope = {"rope_type": "default", "mrope_section": [2, 1, 1], "mrope_interleaved": True}
    text = {**_TEXT, "model_type": "qwen3_vl_text", "head_dim": 8, "rope_theta": 5e6, "rope_scaling": rope}
    values = {
        "model_type": "qwen3_vl", "vision_config": vision, "text_config": text, "tie_word_embeddings": tied,
        **token_ids(), **fields,
    }  # fmt: skip
    from transformers import Qwen3VLConfig

    network = build_qwen3_vl(Qwen3VLConfig.from_dict(values), torch.float32, "cpu")
    return _write(folder, values, network, seed, (), picture_settings(16, 4096, 65536), ID["<|im_end|>"])


@written_once
def write_internvl(folder: Path, seed: int = 1, large: bool = False, **fields: Any) -> Path:
    """Tiles of 28 pixels, of four patches each, one position per tile. large: the kind of tower that 38B has."""
    vision = {
        "model_type": "internvl_vision", "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": [28, 28], "patch_size": [14, 14], "layer_scale_init_value": 0.5,
        "attention_bias": not large, "use_qk_norm": large, "norm_type": "rms_norm" if large else "layer_norm",
    }  # fmt: skip
    number = 256 + INTERNVL_SPECIAL.index("<IMG_CONTEXT>")
    text = {**_TEXT, "model_type": "qwen3", "head_dim": 8, "eos_token_id": ID["<|im_end|>"]}
    values = {
        "model_type": "internvl", "vision_config": vision, "text_config": text, "image_token_id": number,
        "downsample_ratio": 0.5, **fields,
    }  # fmt: skip
    from transformers import InternVLConfig

    network = build_internvl(InternVLConfig.from_dict(values), torch.float32, "cpu")
    settings = {**_SQUARE, "size": {"height": 28, "width": 28}, "min_patches": 1, "max_patches": 12,
                "crop_to_patches": False}  # fmt: skip
    return _write(folder, values, network, seed, _LANGUAGE_LAST, settings, None, INTERNVL_SPECIAL)


@written_once
def write_paligemma(folder: Path, seed: int = 1, vocabulary: int = VOCABULARY, **fields: Any) -> Path:
    """Pictures of 28 pixels; output weights tied."""
    vision = {
        "model_type": "siglip_vision_model", "hidden_size": 24, "intermediate_size": 44, "num_hidden_layers": 2,
        "num_attention_heads": 2, "patch_size": 14, "image_size": 28, "projection_dim": 32,
        "vision_use_head": False,
    }  # fmt: skip
    text = {**_TEXT, "model_type": "gemma", "num_key_value_heads": 1, "head_dim": 8, "vocab_size": vocabulary}
    number = 256 + PALIGEMMA_SPECIAL.index("<image>")
    values = {
        "model_type": "paligemma", "vision_config": vision, "text_config": text, "image_token_index": number,
        "projection_dim": 32, "hidden_size": 32, **fields,
    }  # fmt: skip
    from transformers import PaliGemmaConfig

    network = build_paligemma(PaliGemmaConfig.from_dict(values), torch.float32, "cpu")
    settings = {**_SQUARE, "size": {"height": 28, "width": 28}}
    end = 256 + PALIGEMMA_SPECIAL.index("<eos>")
    return _write(folder, values, network, seed, _LANGUAGE_LAST, settings, end, PALIGEMMA_SPECIAL)


@written_once
def write_ovis2_5(folder: Path, seed: int = 1, vision: dict[str, Any] | None = None, **fields: Any) -> Path:
    """A hundred visual words; pictures as large as the released ones, whose limits are in no file."""
    tower = {
        "hidden_size": 32, "intermediate_size": 44, "num_hidden_layers": 2, "num_attention_heads": 2,
        "num_channels": 3, "patch_size": 32, "hidden_stride": 2, "image_size": 128, "window_size": 192,
        "temporal_patch_size": 1, "layer_norm_eps": 1e-6, "hidden_act": "gelu_pytorch_tanh", "use_rope": True,
        "preserve_original_pe": True, "fullatt_block_indexes": None, **(vision or {}),
    }  # fmt: skip
    text = {**_TEXT, "model_type": "qwen3", "head_dim": 8, "eos_token_id": ID["<|im_end|>"]}
    values = {
        "model_type": "ovis2_5", "llm_config": text, "vit_config": tower, "visual_vocab_size": 100, **fields,
    }  # fmt: skip
    network = build_ovis2_5(OvisConfig.from_values(values), torch.float32, "cpu")
    return _write(folder, values, network, seed, (), {**_SQUARE, "resample": 2}, None)


_LANGUAGE_LAST = (
    (r"^lm_head\.", "language_model.lm_head."),
    (r"^model\.language_model\.", "language_model.model."),
    (r"^model\.(vision_tower|multi_modal_projector)\.", r"\1."),
)


def _write(
    folder: Path,
    values: dict[str, Any],
    network: nn.Module,
    seed: int,
    names: tuple[tuple[str, str], ...],
    settings: dict[str, Any],
    end: int | None,
    special: tuple[str, ...] = SPECIAL,
) -> Path:
    """names: from the network's tensors to those of released files. end: for generation_config.json, if any."""
    folder.mkdir(parents=True, exist_ok=True)
    initialise(network, seed)
    tensors, written_ids = {}, set()
    for name, tensor in network.state_dict(keep_vars=True).items():
        if id(tensor) in written_ids:
            continue
        written_ids.add(id(tensor))
        for pattern, replacement in names:
            name = re.sub(pattern, replacement, name)
        tensors[name] = tensor
    save_sharded(tensors, folder, 1)
    write_tokenizer(folder, special)
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    (folder / "preprocessor_config.json").write_text(json.dumps(settings), encoding="utf-8")
    if end is not None:
        (folder / "generation_config.json").write_text(json.dumps({"eos_token_id": end}), encoding="utf-8")
    return folder
