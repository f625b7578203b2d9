"""Small Magma checkpoints in the layout of the released one: tokenizer, processor files, shards and their index.

`steered` weights put out seven action tokens and the end of the turn, whatever the picture, while which tokens
depends on picture and instruction: a few features that no block writes to carry the place in the action. Other
weights are random, and so is what they put out.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from tokenizers import AddedToken, Tokenizer, decoders, pre_tokenizers, processors
from tokenizers.models import BPE
from torch import Tensor

from probe_kit.hooks.families.magma.network import (
    BEGINNING,
    END_OF_TURN,
    IMAGE,
    IMAGE_END,
    IMAGE_START,
    UNUSED_WEIGHTS,
    MagmaConfig,
    MagmaNetwork,
    build_magma,
)
from probe_kit.models.building import initialise
from tests.support.written_once import written_once

BINS, STEPS = 256, 7
VOCABULARY = 2 * BINS
SPECIAL = (
    BEGINNING, "<|end_of_text|>", "<|start_header_id|>", "<|end_header_id|>", END_OF_TURN, "<pad>",
    IMAGE, IMAGE_START, IMAGE_END,
)  # fmt: skip
IDS = {token: VOCABULARY + index for index, token in enumerate(SPECIAL)}
LAYER_SCALE = "vision_tower.clip_vision_model.trunk.stages.2.blocks.1.gamma"
_LEADING = 16
"""How far a steered choice is ahead of all others."""


def config_values(**fields: Any) -> dict[str, Any]:
    """The content of a `config.json`; `vision` and `text` change the parts inside it."""
    vision, text = fields.pop("vision", {}), fields.pop("text", {})
    return {
        "architectures": ["MagmaForCausalLM"],
        "model_type": "magma",
        "image_token_index": IDS[IMAGE],
        "mm_use_image_start_end": True,
        "pad_token_id": IDS["<pad>"],
        "tokenizer_vocab_size": VOCABULARY,
        "torch_dtype": "float32",
        "text_config": {
            "model_type": "llama",
            "vocab_size": 544,
            "hidden_size": 64,
            "intermediate_size": 96,
            "num_hidden_layers": 3,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "max_position_embeddings": 1024,
            "rms_norm_eps": 1e-5,
            "rope_theta": 500000.0,
            "bos_token_id": IDS[BEGINNING],
            "eos_token_id": IDS[END_OF_TURN],
            "pad_token_id": IDS["<pad>"],
            **text,
        },
        "vision_config": {
            "vision_backbone": "convnextxxlarge",
            "img_anyres_strategy": "crop",
            "img_size": 64,
            "max_num_crops": 4,
            "mm_hidden_size": 32,
            "mm_projector_type": "mlp2x_gelu",
            "mm_use_im_start_end": False,
            "open_clip_embed_dim": 12,
            "timm_overrides": {"depths": [1, 1, 2, 1], "dims": [8, 16, 24, 32]},
            "vision_feature_layer": "clip_vis_dense",
            **vision,
        },
        **fields,
    }


def small_network(steered: bool = False, seed: int = 1, **fields: Any) -> MagmaNetwork:
    """A network with weights from `seed`, its layer scales of order one as trained ones are."""
    network = build_magma(MagmaConfig.from_json(config_values(**fields)), torch.float32, device="cpu")
    initialise(network, seed)
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in network.named_parameters():
        if name.endswith(".gamma"):
            parameter.data = 0.4 + torch.rand(parameter.shape, generator=generator)
    if steered:
        _steer(network)
    return network.requires_grad_(False)


def action_ids(step: int) -> Tensor:
    """The ids that steered weights choose from at one step of an action."""
    return torch.arange(VOCABULARY - BINS + step, VOCABULARY, STEPS)


@torch.no_grad()
def _steer(network: MagmaNetwork) -> None:
    """Feature k is one at the tokens of step k - 1 (at the prompt's end for k = 0) and chooses those of step k."""
    model = network.language_model.model
    embeddings, head = model.embed_tokens.weight, network.language_model.lm_head.weight
    carrying = STEPS + 1
    for matrix in (embeddings.T, head.T, network.multi_modal_projector.proj[-1].weight):
        matrix[:carrying] = 0
    network.multi_modal_projector.row_seperator[..., :carrying] = 0
    for block in model.layers:
        block.self_attn.o_proj.weight[:carrying] = 0
        block.mlp.down_proj.weight[:carrying] = 0
    newline = pre_tokenizers.ByteLevel.alphabet()
    embeddings[sorted(newline).index("Ċ"), 0] = 1
    head[:, :carrying] = -_LEADING
    for step in range(STEPS):
        embeddings[action_ids(step), step + 1] = 1
        head[action_ids(step), step] = _LEADING
    head[IDS[END_OF_TURN], STEPS] = _LEADING


def weights(network: MagmaNetwork, head: bool = True) -> dict[str, Tensor]:
    """What the file of `network` holds, with the contrastive head that is never read."""
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    if head:
        width, features = network.config.vision.head_width, network.vision_tower.width
        shapes = {UNUSED_WEIGHTS[0]: (width, features)} | dict.fromkeys(UNUSED_WEIGHTS[1:], (features,))
        tensors |= {name: torch.full(shape, 0.5) for name, shape in shapes.items()}
    return tensors


@written_once
def write_checkpoint(
    folder: Path,
    steered: bool = True,
    shards: int = 2,
    seed: int = 1,
    tensors: dict[str, Tensor] | None = None,
    **fields: Any,
) -> Path:
    """Write every file of a checkpoint; `tensors` instead of those of a small network."""
    folder.mkdir(parents=True, exist_ok=True)
    values = config_values(**fields)
    vision = values["vision_config"]
    preprocessor = {
        "anyres_strategy": "crop",
        "base_img_size": vision["img_size"],
        "num_crops": vision["max_num_crops"],
        "image_mean": [0.48145466, 0.4578275, 0.40821073],
        "image_std": [0.26862954, 0.26130258, 0.27577711],
        "image_processor_type": "MagmaImageProcessor",
    }
    for name, content in (
        ("config.json", values),
        ("preprocessor_config.json", preprocessor),
        ("generation_config.json", {"bos_token_id": IDS[BEGINNING], "eos_token_id": IDS[END_OF_TURN]}),
    ):
        (folder / name).write_text(json.dumps(content), encoding="utf-8")
    write_tokenizer(folder)
    if tensors is None:
        tensors = weights(small_network(steered, seed, **fields))
    _write_weights(folder, tensors, shards)
    return folder


def _write_weights(folder: Path, tensors: dict[str, Tensor], shards: int) -> None:
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


def write_tokenizer(folder: Path) -> Path:
    """Bytes, then as many ids that name action bins, then the added tokens of Llama 3 and Magma."""
    characters = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {token: index for index, token in enumerate(characters)}
    vocabulary |= {f"<action {index}>": index for index in range(len(vocabulary), VOCABULARY)}
    tokenizer = Tokenizer(BPE(vocab=vocabulary, merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens([AddedToken(token, special=True, normalized=False) for token in SPECIAL])
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{BEGINNING} $A", special_tokens=[(BEGINNING, IDS[BEGINNING])]
    )
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    names = {"bos_token": BEGINNING, "eos_token": END_OF_TURN, "pad_token": "<pad>"}
    (folder / "tokenizer_config.json").write_text(json.dumps(names), encoding="utf-8")
    return folder
