"""Small Xiaomi-Robotics-R0 checkpoints with random weights, in the layout of the released ones."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from probe_kit.hooks.families.xiaomi.network import XiaomiConfig, build_xiaomi
from probe_kit.models.building import initialise
from tests.support.qwen_checkpoints import (
    ID,
    VOCABULARY,
    picture_settings,
    save_sharded,
    token_ids,
    write_tokenizer,
)
from tests.support.written_once import written_once

ROBOTS = {"bridge_delta": 4, "fractal_delta": 3, "libero_all": 10}
"""Steps of a chunk."""
NUMBERS = 32


def config_values(**fields: Any) -> dict[str, Any]:
    """The content of a `config.json`: two layers of flow transformer behind four of Qwen3-VL."""
    vision = {
        "depth": 3,
        "hidden_size": 32,
        "intermediate_size": 48,
        "num_heads": 2,
        "patch_size": 16,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
        "out_hidden_size": 48,
        "num_position_embeddings": 64,
        "deepstack_visual_indexes": [0, 1],
    }
    text = {
        "vocab_size": VOCABULARY,
        "hidden_size": 48,
        "intermediate_size": 64,
        "num_hidden_layers": 4,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 16,
        "max_position_embeddings": 4096,
        "rope_theta": 5000000.0,
        "rope_scaling": {"rope_type": "default", "mrope_section": [4, 2, 2], "mrope_interleaved": True},
        "pad_token_id": ID["<|endoftext|>"],
    }
    return {
        "architectures": ["MiBoTForActionGeneration"],
        "model_type": "mibot",
        "torch_dtype": "float32",
        "vlm_config": {"vision_config": vision, "text_config": text, "tie_word_embeddings": True, **token_ids()},
        "dit_config": {"hidden_size": 64, "num_hidden_layers": 2, "head_dim": 16, "num_key_value_heads": 2},
        "state_length": 1,
        "state_dim": NUMBERS,
        "action_length": 30,
        "action_dim": NUMBERS,
        **fields,
    }


def action_config(robots: dict[str, int] | None = None) -> dict[str, Any]:
    """Per robot mean and deviation of every step: seven numbers in use, the rest zero."""
    rng = np.random.default_rng(3)
    content = {}
    for robot, steps in (robots or ROBOTS).items():
        mean, deviation = np.zeros((steps, NUMBERS)), np.zeros((steps, NUMBERS))
        mean[:, :7] = rng.normal(0, 0.01, (steps, 7))
        deviation[:, :7] = rng.uniform(0.01, 0.03, (steps, 7))
        mean[:, 6], deviation[:, 6] = 0.5, 0.5
        content[robot] = {"mean": mean.tolist(), "std": deviation.tolist()}
    return content


@written_once
def write_checkpoint(folder: Path, shards: int = 2, seed: int = 1, **fields: Any) -> Path:
    """Configuration, weights, tokenizer, processor. fields: of config.json."""
    folder.mkdir(parents=True, exist_ok=True)
    values = config_values(**fields)
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    write_tokenizer(folder)
    settings = picture_settings(
        16, 65536, 16777216, processor_class="MiBotProcessor", action_config=action_config()
    )
    (folder / "preprocessor_config.json").write_text(json.dumps(settings), encoding="utf-8")
    network = build_xiaomi(XiaomiConfig.from_json(values), torch.float32, device="cpu")
    initialise(network, seed)
    tensors = {name: tensor for name, tensor in network.state_dict().items() if name != "vlm.lm_head.weight"}
    save_sharded(tensors, folder, shards)
    return folder
