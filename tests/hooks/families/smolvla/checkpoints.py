"""Small SmolVLA checkpoints with random weights, in lerobot's layout, with the VLM's files in a folder inside."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import save_file
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Sequence, Split

from probe_kit.hooks.families.smolvla.adapter import build_smolvla
from probe_kit.models.building import initialise
from tests.support.lerobot_units import write_units
from tests.support.written_once import written_once

SPECIAL = [
    "<pad>", "<eos>", "<bos>", "<unk>", "<fake_token_around_image>", "<image>", "<end_of_utterance>",
    "<global-img>",
]  # fmt: skip
WORDS = ["put", "the", "cube", "on", "star", "red", "blue", "shape", "\n"]
IMAGES = "observation.images."


@written_once
def write_smolvla(folder: Path, cameras: tuple[str, ...] = ("top",), seed: int = 1, **fields: Any) -> Path:
    """A policy of two blocks of width 32; `fields` go into its configuration."""
    from lerobot.configs.policies import PreTrainedConfig

    folder.mkdir(parents=True, exist_ok=True)
    _write_vlm(folder / "vlm")
    (folder / "config.json").write_text(json.dumps(_config(cameras) | fields), encoding="utf-8")
    config: Any = PreTrainedConfig.from_pretrained(folder)
    network = build_smolvla(config, folder)
    initialise(network, seed)
    tensors = {name: tensor.clone().contiguous() for name, tensor in network.state_dict().items()}
    save_file(tensors, folder / "model.safetensors")
    for feature, size in (("observation.state", 8), ("action", 7)):
        rng = np.random.default_rng(size)
        mean, deviation = rng.normal(0, 0.1, size), rng.uniform(0.5, 2, size)
        write_units(folder, feature, "MEAN_STD", {"mean": mean, "std": deviation})
    return folder


def _config(cameras: tuple[str, ...]) -> dict[str, Any]:
    pictures = {f"{IMAGES}{camera}": {"type": "VISUAL", "shape": [3, 24, 32]} for camera in cameras}
    return {
        "type": "smolvla",
        "input_features": {**pictures, "observation.state": {"type": "STATE", "shape": [8]}},
        "output_features": {"action": {"type": "ACTION", "shape": [7]}},
        "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
        "chunk_size": 4,
        "n_action_steps": 4,
        "max_state_dim": 8,
        "max_action_dim": 7,
        "resize_imgs_with_padding": [16, 16],
        "tokenizer_max_length": 12,
        "num_steps": 3,
        "vlm_model_name": "vlm",
        "load_vlm_weights": False,
        "num_vlm_layers": 2,
        "self_attn_every_n_layers": 2,
        "device": "cpu",
    }


def _write_vlm(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    words = {word: number for number, word in enumerate([*SPECIAL, *WORDS])}
    tokenizer = Tokenizer(WordLevel(words, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Sequence([Split(" ", "removed"), Split("\n", "isolated")])
    tokenizer.add_special_tokens(SPECIAL)
    tokenizer.save(str(folder / "tokenizer.json"))
    names = ("pad", "eos", "bos", "unk", "fake_image", "image", "end_of_utterance", "global_image")
    special_tokens = {f"{name}_token": token for name, token in zip(names, SPECIAL, strict=True)}
    _write(
        folder / "tokenizer_config.json",
        {"tokenizer_class": "TokenizersBackend", "model_max_length": 64, **special_tokens},
    )
    processor = {"image_processor_type": "SmolVLMImageProcessor", "size": {"longest_edge": 16}}
    video = {"video_processor_type": "SmolVLMVideoProcessor", "size": {"longest_edge": 16}}
    _write(
        folder / "processor_config.json",
        {
            "processor_class": "SmolVLMProcessor",
            "image_seq_len": 1,
            "image_processor": processor,
            "video_processor": video,
        },
    )
    text = {
        "model_type": "llama", "hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4,
        "num_key_value_heads": 2, "head_dim": 8, "intermediate_size": 48, "vocab_size": len(words),
        "max_position_embeddings": 128, "pad_token_id": 0, "bos_token_id": 2, "eos_token_id": 1,
    }  # fmt: skip
    vision = {
        "model_type": "smolvlm_vision", "hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
        "intermediate_size": 24, "patch_size": 4, "image_size": 16,
    }  # fmt: skip
    _write(
        folder / "config.json",
        {
            "model_type": "smolvlm",
            "architectures": ["SmolVLMForConditionalGeneration"],
            "image_token_id": words["<image>"],
            "pad_token_id": 0,
            "scale_factor": 2,
            "tie_word_embeddings": False,
            "text_config": text,
            "vision_config": vision,
        },
    )


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content), encoding="utf-8")
