"""Small Prismatic and OpenVLA checkpoints with random weights, in the layout of the released ones."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from tokenizers import Regex, Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Sequence, Split

from probe_kit.models.initialisation import initialise
from probe_kit.models.prismatic import PrismaticConfig, build_prismatic

FUSED, SINGLE = "dinosiglip-vit-so-224px", "siglip-vit-so400m"
TOWER = {"depth": 3, "embed_dim": 16, "num_heads": 2}
_PROMPT = ["in:", "what", "action", "should", "the", "robot", "take", "to", "?", "\n", "out:"]
WORDS = ["<unk>", "<s>", "</s>", "put", "the", "cube", *_PROMPT, "on", "star", "red", "shape"]


def config_values(vision: str = FUSED, language: str = "llama2-7b-pure", **fields: Any) -> dict[str, Any]:
    """The content of a `config.json`."""
    towers = 2 if vision.startswith(("dinosiglip", "dinoclip")) else 1
    action = {"q01": [-0.1] * 6 + [0.0], "q99": [0.1] * 6 + [1.0], "mask": [True] * 6 + [False]}
    return {
        "model_type": "openvla",
        "vision_backbone_id": vision,
        "llm_backbone_id": language,
        "image_resize_strategy": "resize-naive",
        "image_sizes": [32 if vision.startswith("in1k") else 28] * towers,
        "timm_model_overrides": [TOWER] * towers,
        "empty_token_id": 29,
        "torch_dtype": "float32",
        "norm_stats": {"bridge_orig": {"action": action}},
        "text_config": {
            "vocab_size": 384,
            "pad_token_id": 320,
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "num_key_value_heads": 4,
            "max_position_embeddings": 256,
        },
        **fields,
    }


def write_checkpoint(folder: Path, shards: int = 1, seed: int = 1, **fields: Any) -> Path:
    """Write config and weights; with more than one shard also the index that names them."""
    folder.mkdir(parents=True, exist_ok=True)
    values = config_values(**fields)
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    network = build_prismatic(PrismaticConfig.from_json(values), torch.float32, device="cpu")
    initialise(network, seed)
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    if shards == 1:
        save_file(tensors, folder / "model.safetensors")
        return folder
    place = {
        name: f"model-{index % shards + 1:05d}-of-{shards:05d}.safetensors" for index, name in enumerate(tensors)
    }
    for file in set(place.values()):
        save_file({name: tensors[name] for name in tensors if place[name] == file}, folder / file)
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": place}), encoding="utf-8")
    return folder


def write_tokenizer(folder: Path) -> Path:
    """A word-level tokenizer; it does not add the beginning of the sequence by itself."""
    tokenizer = Tokenizer(
        WordLevel({word: index for index, word in enumerate(dict.fromkeys(WORDS))}, unk_token="<unk>")
    )
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Sequence([Split(" ", "removed"), Split(Regex(r"\?|\n"), "isolated")])
    tokenizer.add_special_tokens(["<unk>", "<s>", "</s>"])
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"bos_token": {"content": "<s>"}}), encoding="utf-8")
    return folder
