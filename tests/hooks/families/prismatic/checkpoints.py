"""Small Prismatic and OpenVLA checkpoints with random weights, in the layout of the released ones."""

import json
from pathlib import Path
from string import ascii_letters
from typing import Any

import torch
from safetensors.torch import save_file
from tokenizers import Regex, Tokenizer, decoders
from tokenizers.models import BPE, WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Sequence, Split

from probe_kit.hooks.families.prismatic.network import PrismaticConfig, build_prismatic
from probe_kit.models.building import initialise
from tests.support.written_once import written_once

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


@written_once
def write_checkpoint(folder: Path, shards: int = 1, seed: int = 1, **fields: Any) -> Path:
    """Write config, tokenizer and weights; with more than one shard also the index that names them."""
    write_letters(folder)
    values = config_values(**fields)
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    network = build_prismatic(PrismaticConfig.from_json(values), torch.float32, device="cpu")
    initialise(network, seed)
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    if shards == 1:
        save_file(tensors, folder / "model.safetensors")
        return folder
    file_by_tensor = {
        name: f"model-{index % shards + 1:05d}-of-{shards:05d}.safetensors" for index, name in enumerate(tensors)
    }
    for file in set(file_by_tensor.values()):
        save_file({name: tensors[name] for name in tensors if file_by_tensor[name] == file}, folder / file)
    (folder / "model.safetensors.index.json").write_text(
        json.dumps({"weight_map": file_by_tensor}), encoding="utf-8"
    )
    return folder


RELEASED_ID = "TRI-ML/prismatic-vlms/prism-dinosiglip-224px+7b"
_FUSED_LAYERS = {"fc1": "0", "fc2": "2", "fc3": "4"}
_TIMM = ("vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224.webli")


def write_hub_file(cache: Path, repository: str, name: str) -> Path:
    """Where the hub's cache keeps a file of a repository; the caller writes it."""
    root = cache / f"models--{repository.replace('/', '--')}"
    (root / "refs").mkdir(parents=True, exist_ok=True)
    (root / "refs" / "main").write_text("0" * 40, encoding="utf-8")
    file = root / "snapshots" / ("0" * 40) / name
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def write_release(cache: Path, seed: int = 1, towers_inside: bool = False, published_side: int = 28) -> Path:
    """A hub cache with TRI-ML's layout: a run's folder in one repository, and timm's towers in theirs.

    towers_inside: in the file of the run, as after full fine-tuning. published_side: of the pictures that timm's
    towers were published for. Returns the folder of the run; its tensors are those of `write_checkpoint`.
    """
    plain = config_values()
    network = build_prismatic(PrismaticConfig.from_json(plain), torch.float32, device="cpu")
    initialise(network, seed)
    parts: dict[str, dict[str, torch.Tensor]] = {"projector": {}, "llm_backbone": {}, "vision_backbone": {}}
    for name, tensor in network.state_dict().items():
        module, _, remainder = name.partition(".")
        if module == "projector":
            layer, _, kind = remainder.partition(".")
            parts["projector"][f"projector.{_FUSED_LAYERS[layer]}.{kind}"] = tensor
        elif module == "language_model":
            parts["llm_backbone"][f"llm.{remainder}"] = tensor
        else:
            tower, _, kind = remainder.partition(".")
            theirs = {"featurizer": "dino_featurizer", "fused_featurizer": "siglip_featurizer"}[tower]
            parts["vision_backbone"][f"{theirs}.{kind.replace('scale_factor', 'gamma')}"] = tensor
    towers = parts["vision_backbone"]
    if not towers_inside:
        del parts["vision_backbone"]
        for begin, timm_id in zip(("dino_featurizer.", "siglip_featurizer."), _TIMM, strict=True):
            tower_tensors = {
                name.removeprefix(begin): tensor for name, tensor in towers.items() if name.startswith(begin)
            }
            patches = (published_side // 14) ** 2
            shape = (1, patches, tower_tensors["pos_embed"].shape[-1])
            if published_side != 28:
                tower_tensors["pos_embed"] = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
            save_file(
                {name: tensor.contiguous() for name, tensor in tower_tensors.items()},
                write_hub_file(cache, f"timm/{timm_id}", "model.safetensors"),
            )
    repository, _, model = RELEASED_ID.rpartition("/")
    weights = write_hub_file(cache, repository, f"{model}/checkpoints/latest-checkpoint.pt")
    torch.save({"model": parts}, weights)
    inside = ("image_sizes", "timm_model_overrides", "text_config", "torch_dtype")
    run = {
        "type": model,
        "model_id": model,
        "arch_specifier": "no-align+fused-gelu-mlp",
        "vision_backbone_id": FUSED,
        "llm_backbone_id": "llama2-7b-pure",
        "image_resize_strategy": "resize-naive",
        "llm_max_length": 2048,
        **{name: plain[name] for name in inside},  # what makes it small
    }
    run["text_config"] = {**plain["text_config"], "rms_norm_eps": 1e-6}
    folder = weights.parents[1]
    (folder / "config.json").write_text(json.dumps({"model": run, "stage": "finetune"}), encoding="utf-8")
    write_hub_file(cache, repository, "prism-clip+7b/config.json").write_text("{}", encoding="utf-8")
    write_tokenizer(write_hub_file(cache, "openvla/openvla-7b", "config.json").parent)
    return folder


def write_letters(folder: Path) -> Path:
    """A tokenizer that knows every text: byte b has id 3 + b, a letter with the space before it one of its own."""
    bytes_of = {chr(byte) if byte < 128 else f"<0x{byte:02X}>": 3 + byte for byte in range(256)}
    merges = [(" ", letter) for letter in ascii_letters]
    pairs = {" " + letter: 259 + number for number, letter in enumerate(ascii_letters)}
    special = {"<unk>": 0, "<s>": 1, "</s>": 2}
    tokenizer = Tokenizer(BPE(special | bytes_of | pairs, merges, unk_token="<unk>", byte_fallback=True))
    tokenizer.decoder = decoders.Sequence([decoders.ByteFallback(), decoders.Fuse()])
    return _save(tokenizer, folder)


def write_tokenizer(folder: Path) -> Path:
    """A word-level tokenizer."""
    tokenizer = Tokenizer(
        WordLevel({word: index for index, word in enumerate(dict.fromkeys(WORDS))}, unk_token="<unk>")
    )
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Sequence([Split(" ", "removed"), Split(Regex(r"\?|\n"), "isolated")])
    return _save(tokenizer, folder)


def _save(tokenizer: Tokenizer, folder: Path) -> Path:
    """The file does not add the beginning of a text."""
    tokenizer.add_special_tokens(["<unk>", "<s>", "</s>"])
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"bos_token": {"content": "<s>"}}), encoding="utf-8")
    return folder
