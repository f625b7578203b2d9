"""Small SpatialVLA checkpoints with random weights, in the layout of the released ones."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from tokenizers import AddedToken, Tokenizer
from tokenizers.decoders import ByteFallback, Fuse
from tokenizers.decoders import Replace as Unreplace
from tokenizers.decoders import Sequence as Decoders
from tokenizers.models import BPE
from tokenizers.normalizers import Replace

from probe_kit.hooks.families.spatialvla.network import SpatialVLAConfig, SpatialVLANetwork, build_spatialvla
from probe_kit.models.building import initialise
from tests.support.written_once import written_once

SIDE = 42
BINS: dict[str, Any] = {
    "translation": {"theta_bins": 3, "phi_bins": 4, "r_bins": 2},
    "rotation": {"roll_bins": 2, "pitch_bins": 3, "yaw_bins": 2},
    "gripper": 2,
    "total": 38,
}
_LIMITS = {"theta": (0, np.pi), "phi": (-np.pi, np.pi), "r": (0, 3**0.5)}
_LETTERS = [chr(code) for code in range(ord("!"), ord("~") + 1)]
_MERGES = [
    ("▁", "t"),
    ("h", "e"),
    ("▁t", "he"),
    ("c", "u"),
    ("b", "e"),
    ("cu", "be"),
    ("▁", "cube"),
    ("o", "n"),
    ("\n", "\n"),
]
_SPECIAL = ["<pad>", "<eos>", "<bos>", "<unk>"]
_BYTES = [f"<0x{byte:02X}>" for byte in range(256)]
WORDS = [*_SPECIAL, "\n", *_BYTES, "▁", *_LETTERS, *(left + right for left, right in _MERGES)]
IMAGE = len(WORDS)
FIRST_ACTION = IMAGE + 1


def config_values(**fields: Any) -> dict[str, Any]:
    """The content of a `config.json`."""
    actions = int(BINS["total"])
    return {
        "model_type": "spatialvla",
        "architectures": ["SpatialVLAForConditionalGeneration"],
        "image_token_index": IMAGE,
        "action_token_begin_idx": FIRST_ACTION,
        "spatial_token_num": actions,
        "use_spatial_token": True,
        "use_vision_zoe": True,
        "ego3d_patch_reso": 2,
        "n_freqs": 3,
        "projection_dim": 32,
        "bos_token_id": 2,
        "eos_token_id": 1,
        "pad_token_id": 0,
        "tie_word_embeddings": True,
        "torch_dtype": "float32",
        "text_config": _text(FIRST_ACTION + actions),
        "vision_config": {
            "model_type": "siglip_vision_model",
            "hidden_size": 24,
            "image_size": SIDE,
            "intermediate_size": 40,
            "num_attention_heads": 2,
            "num_hidden_layers": 2,
            "patch_size": 14,
            "projection_dim": 32,
            "vision_use_head": False,
        },
        "vision_zoe_config": _depth(),
        **fields,
    }


def _text(vocabulary: int) -> dict[str, Any]:
    return {
        "model_type": "gemma2",
        "attn_logit_softcapping": 50.0,
        "final_logit_softcapping": 30.0,
        "head_dim": 8,
        "hidden_activation": "gelu_pytorch_tanh",
        "hidden_size": 32,
        "intermediate_size": 48,
        "num_attention_heads": 4,
        "num_hidden_layers": 3,
        "num_key_value_heads": 2,
        "query_pre_attn_scalar": 8,
        "rope_theta": 10000.0,
        "sliding_window": 4096,
        "tie_word_embeddings": False,
        "vocab_size": vocabulary,
    }


def _depth() -> dict[str, Any]:
    return {
        "model_type": "zoedepth",
        "backbone_config": {
            "model_type": "beit",
            "hidden_size": 8,
            "image_size": 384,
            "intermediate_size": 16,
            "num_attention_heads": 2,
            "num_hidden_layers": 4,
            "out_features": ["stage1", "stage2", "stage3", "stage4"],
            "reshape_hidden_states": False,
            "use_relative_position_bias": True,
        },
        "backbone_hidden_size": 8,
        "bin_configurations": [
            {"name": "nyu", "n_bins": 4, "min_depth": 0.001, "max_depth": 10.0},
            {"name": "kitti", "n_bins": 4, "min_depth": 0.001, "max_depth": 80.0},
        ],
        "bin_embedding_dim": 8,
        "bottleneck_features": 8,
        "fusion_hidden_size": 8,
        "neck_hidden_sizes": [4, 4, 8, 8],
        "num_attractors": [4, 2, 2, 1],
        "num_patch_transformer_layers": 4,
        "num_relative_features": 4,
        "patch_transformer_hidden_size": 128,
        "patch_transformer_intermediate_size": 16,
        "patch_transformer_num_attention_heads": 4,
    }


def edges() -> dict[str, dict[str, list[float]]]:
    """The `bin_policy` of a `processor_config.json`: uneven edges, finer around the middle."""
    policy: dict[str, dict[str, list[float]]] = {}
    for group in ("translation", "rotation"):
        for name, count in BINS[group].items():
            low, high = _LIMITS.get(name.removesuffix("_bins"), (-1, 1))
            even = np.linspace(-1, 1, int(count) + 1)
            uneven = even * np.abs(even) ** 0.4
            policy.setdefault(group, {})[name] = ((low + high) / 2 + uneven * (high - low) / 2).tolist()
    return policy


def processor_values(**fields: Any) -> dict[str, Any]:
    """The content of a `processor_config.json`."""
    statistics = {"q01": [-0.03] * 6 + [0.0], "q99": [0.03] * 6 + [1.0], "mask": [True] * 6 + [False]}
    camera = {"width": 640, "height": 480, "intrinsic": [[623.588, 0, 319.501], [0, 623.588, 239.545], [0, 0, 1]]}
    return {
        "processor_class": "SpatialVLAProcessor",
        "action_chunk_size": 4,
        "action_config": {"distribution": "gaussian", "num_bins": BINS, "use_spherical": True},
        "bin_policy": edges(),
        "intrinsic_config": {"bridge_orig/1.0.0": camera, "default": camera},
        "min_sigma": 0.0,
        "num_obs_steps": 1,
        "obs_delta": 1,
        "statistics": {"bridge_orig/1.0.0": {"action": statistics}},
        **fields,
    }


def preprocessor_values(side: int = SIDE, **fields: Any) -> dict[str, Any]:
    """The content of a `preprocessor_config.json`."""
    return {
        "image_processor_type": "SiglipImageProcessor",
        "do_convert_rgb": None,
        "do_normalize": False,
        "do_rescale": True,
        "do_resize": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_seq_length": (side // 14) ** 2,
        "image_std": [0.5, 0.5, 0.5],
        "resample": 3,
        "rescale_factor": 0.00392156862745098,
        "size": {"height": side, "width": side},
        **fields,
    }


def network(seed: int = 1, **fields: Any) -> SpatialVLANetwork:
    """A network with random weights that prefers action ids, as a trained one does, its own not yet embedded."""
    built = build_spatialvla(SpatialVLAConfig.from_json(config_values(**fields)), torch.float32, device="cpu")
    initialise(built, seed)
    with torch.no_grad():
        built.language_model.lm_head.weight[:FIRST_ACTION] *= 0.2
    return built


@written_once
def write_checkpoint(
    folder: Path,
    shards: int = 2,
    seed: int = 1,
    processor: dict[str, Any] | None = None,
    **fields: Any,
) -> Path:
    """Write every file of a released checkpoint. processor: changes to `processor_config.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    built = network(seed, **fields)
    _write(folder / "config.json", config_values(**fields))
    _write(folder / "processor_config.json", processor_values(**(processor or {})))
    _write(folder / "preprocessor_config.json", preprocessor_values(built.config.side))
    write_tokenizer(folder)
    tensors = {name: tensor.contiguous() for name, tensor in built.state_dict().items()}
    file_by_tensor = {
        name: f"model-{index % shards + 1:05d}-of-{shards:05d}.safetensors" for index, name in enumerate(tensors)
    }
    for file in set(file_by_tensor.values()):
        save_file({name: tensors[name] for name in tensors if file_by_tensor[name] == file}, folder / file)
    size = sum(tensor.nbytes for tensor in tensors.values())
    _write(
        folder / "model.safetensors.index.json", {"metadata": {"total_size": size}, "weight_map": file_by_tensor}
    )
    return folder


def write_tokenizer(folder: Path, more: tuple[str, ...] = ()) -> Path:
    """A byte-fallback BPE tokenizer with the released files' added tokens, and `more` before the actions."""
    tokenizer = Tokenizer(
        BPE(
            {word: index for index, word in enumerate(WORDS)},
            _MERGES,
            unk_token="<unk>",
            byte_fallback=True,
            fuse_unk=True,
        )
    )
    tokenizer.normalizer = Replace(" ", "▁")
    tokenizer.decoder = Decoders([Unreplace("▁", " "), ByteFallback(), Fuse()])
    added = ["<image>", *more, *(f"<ACTION{index:05d}>" for index in range(BINS["total"]))]
    tokenizer.add_special_tokens([AddedToken(token, normalized=False) for token in (*_SPECIAL, *added)])
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    special_tokens = {"bos_token": "<bos>", "eos_token": "<eos>", "pad_token": "<pad>", "unk_token": "<unk>"}
    _write(folder / "special_tokens_map.json", special_tokens)
    _write(folder / "added_tokens.json", {token: IMAGE + index for index, token in enumerate(added)})
    tokenizer_settings = {"tokenizer_class": "GemmaTokenizer", "add_bos_token": False, "add_eos_token": False}
    _write(folder / "tokenizer_config.json", {**special_tokens, **tokenizer_settings, "image_token": "<image>"})
    return folder


def _write(file: Path, values: dict[str, Any]) -> None:
    file.write_text(json.dumps(values), encoding="utf-8")
