"""Small InternVLA-M1 checkpoints with random weights, in the layout of the released ones.

A run's folder with `config.yaml`, `dataset_statistics.json` and `checkpoints/steps_7_pytorch_model.pt`; beside it
the folder of the vision-language model with configuration, tokenizer and processor.
"""

import json
from pathlib import Path
from typing import Any

import torch
import yaml

from probe_kit.hooks.families.internvla.network import InternVLAConfig, InternVLANetwork, build_internvla
from probe_kit.models.building import initialise
from tests.support.qwen_checkpoints import ID, VOCABULARY, picture_settings, token_ids, write_tokenizer

COT = "Your task is {instruction}. Find the key objects first."


def vlm_values(**text: Any) -> dict[str, Any]:
    """The content of the vision-language model's `config.json`: four blocks of Qwen2.5-VL."""
    vision = {
        "depth": 2,
        "hidden_size": 32,
        "intermediate_size": 48,
        "num_heads": 2,
        "patch_size": 14,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
        "window_size": 112,
        "fullatt_block_indexes": [1],
        "out_hidden_size": 48,
    }
    sizes = {
        "vocab_size": VOCABULARY,
        "hidden_size": 48,
        "intermediate_size": 64,
        "num_hidden_layers": 4,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "max_position_embeddings": 4096,
        "rope_theta": 1000000.0,
        "rope_scaling": {"type": "mrope", "mrope_section": [2, 2, 2]},
        "pad_token_id": ID["<|endoftext|>"],
        **text,
    }
    return {
        "model_type": "qwen2_5_vl",
        "vision_config": vision,
        "text_config": sizes,
        "tie_word_embeddings": True,
        **token_ids(),
    }


def run_values(base: str = "Qwen/Qwen2.5-VL-3B-Instruct", **fields: Any) -> dict[str, Any]:
    """The content of `config.yaml`; the head predicts four actions, the queries read the last two states."""
    framework = {
        "framework_py": "InternVLA-M1",
        "qwenvl": {"base_vlm": base},
        "dino": {"dino_backbone": "dinov2_vits14"},
        "layer_qformer": {
            "qformer_start_layer": 3,
            "qformer_end_layer": 5,
            "num_query_tokens": 6,
            "input_dim": 48,
            "ouptput_dim": 32,
            "grad_scale": 0.5,
        },
        "action_model": {
            "action_model_type": "DiT-B",
            "action_hidden_dim": 32,
            "action_dim": 7,
            "future_action_window_size": 3,
            "past_action_window_size": 0,
        },
        **fields,
    }
    return {"framework": framework, "datasets": {"vla_data": {"CoT_prompt": COT, "image_size": [224, 224]}}}


def dims_values() -> dict[str, Any]:
    """The content of `dims.json`: smaller parts than the named ones."""
    return {
        "dino": {"embed_dim": 24, "depth": 2, "num_heads": 3, "img_size": 70, "patch_size": 14, "px": 56},
        "dit": {"depth": 3, "token_size": 32, "num_heads": 4},
        "qformer_heads": 4,
    }


def config(vlm: dict[str, Any] | None = None, **fields: Any) -> InternVLAConfig:
    """The configuration all of this makes."""
    return InternVLAConfig.from_values(run_values(**fields) | dims_values(), vlm or vlm_values(), "test")


def network(seed: int = 1) -> InternVLANetwork:
    """A network with random weights."""
    built = build_internvla(config(), torch.float32, device="cpu")
    initialise(built, seed)
    return built


def statistics() -> dict[str, Any]:
    """The content of `dataset_statistics.json`."""
    action = {"q01": [-0.04] * 6 + [0.0], "q99": [0.05] * 6 + [1.0], "mask": [True] * 6 + [False]}
    wide = action | {"q99": [0.5] * 6 + [1.0]}
    return {"bridge_dataset": {"action": action}, "fractal20220817_data": {"action": wide}}


def write_vlm(folder: Path, **text: Any) -> Path:
    """Configuration, tokenizer and processor of the vision-language model; no weights."""
    write_tokenizer(folder)
    (folder / "config.json").write_text(json.dumps(vlm_values(**text)), encoding="utf-8")
    settings = picture_settings(14, 3136, 12845056)
    (folder / "preprocessor_config.json").write_text(json.dumps(settings), encoding="utf-8")
    return folder


def write_checkpoint(folder: Path, seed: int = 1, side: int = 224) -> Path:
    """A run's folder; the weights as a pickled state dict. side: of the pictures it asks for, in pixels."""
    run = folder / "run"
    (run / "checkpoints").mkdir(parents=True)
    values = run_values(base=str(write_vlm(folder / "vlm")))
    values["datasets"]["vla_data"]["image_size"] = [side, side]
    (run / "config.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    (run / "dims.json").write_text(json.dumps(dims_values()), encoding="utf-8")
    (run / "dataset_statistics.json").write_text(json.dumps(statistics()), encoding="utf-8")
    torch.save(network(seed).state_dict(), run / "checkpoints" / "steps_7_pytorch_model.pt")
    return run
