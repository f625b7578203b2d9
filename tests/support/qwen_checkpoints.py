"""What small checkpoints built on Qwen's vision-language models share: tokenizer, processor files, sizes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from tokenizers import Tokenizer
from tokenizers.decoders import ByteLevel as ByteLevelDecoder
from tokenizers.models import BPE
from tokenizers.pre_tokenizers import ByteLevel
from torch import Tensor

SPECIAL = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>",
           "<|video_pad|>")  # fmt: skip
"""Their ids follow the 256 bytes."""
ID = {token: 256 + index for index, token in enumerate(SPECIAL)}
VOCABULARY = 272


def write_tokenizer(folder: Path, special: Sequence[str] = SPECIAL) -> Path:
    """Byte-level BPE without merges, as `tokenizer.json`: it knows every word.

    special: tokens whose ids follow the 256 bytes, the first of them padding.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bytes_ = {letter: index for index, letter in enumerate(sorted(ByteLevel.alphabet()))}
    tokenizer = Tokenizer(BPE(bytes_, []))
    tokenizer.pre_tokenizer = ByteLevel(add_prefix_space=False)
    tokenizer.decoder = ByteLevelDecoder()
    tokenizer.add_special_tokens(list(special))
    tokenizer.save(str(folder / "tokenizer.json"))
    settings = {"tokenizer_class": "Qwen2Tokenizer", "eos_token": "<|im_end|>", "pad_token": special[0]}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings), encoding="utf-8")
    return folder


def picture_settings(patch: int, low: int, high: int, **fields: Any) -> dict[str, Any]:
    """The content of a `preprocessor_config.json`. low, high: pixels."""
    return {
        "image_processor_type": "Qwen2VLImageProcessorFast",
        "patch_size": patch,
        "temporal_patch_size": 2,
        "merge_size": 2,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
        "size": {"shortest_edge": low, "longest_edge": high},
        **fields,
    }


def token_ids() -> dict[str, int]:
    """The ids a vision-language model's configuration names."""
    return {
        "image_token_id": ID["<|image_pad|>"],
        "video_token_id": ID["<|video_pad|>"],
        "vision_start_token_id": ID["<|vision_start|>"],
        "vision_end_token_id": ID["<|vision_end|>"],
    }


def save_sharded(tensors: dict[str, Tensor], folder: Path, shards: int) -> None:
    """As `model.safetensors`, or in several files with the index that names them."""
    tensors = {name: tensor.detach().clone().to(torch.float32).contiguous() for name, tensor in tensors.items()}
    if shards == 1:
        save_file(tensors, folder / "model.safetensors")
        return
    file_by_tensor = {
        name: f"model-{index % shards + 1:05d}-of-{shards:05d}.safetensors" for index, name in enumerate(tensors)
    }
    for file in set(file_by_tensor.values()):
        save_file({name: tensors[name] for name in tensors if file_by_tensor[name] == file}, folder / file)
    (folder / "model.safetensors.index.json").write_text(
        json.dumps({"weight_map": file_by_tensor}), encoding="utf-8"
    )
