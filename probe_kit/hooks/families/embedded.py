"""The embedded models as ordinary checkpoints: a pi0 of 0.84 million parameters, and a PaliGemma of its size.

Their weights are in `probe_kit/models/checkpoints`, with model cards; `scripts/train_vlm_tiny.py` makes those of
the VLM, and `scripts/train_embedded_policy.py` those of the policy from it.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from numpy.typing import ArrayLike
from safetensors.numpy import save_file as save_numpy
from safetensors.torch import save_file
from transformers import PaliGemmaConfig

from probe_kit.hooks.families.paligemma.network import CROP, build_paligemma
from probe_kit.hooks.families.pi0.network import Pi0Size, build_pi0
from probe_kit.hooks.families.shared.lerobot.paligemma import GemmaSize, SiglipSize
from probe_kit.models.building import initialise
from probe_kit.models.embedded.words import END, IMAGE_TOKEN, SPECIAL, VOCABULARY, write_tokenizer

SIZE = Pi0Size(
    vlm=GemmaSize(width=96, depth=3, mlp_dim=192, num_heads=8, num_kv_heads=1, head_dim=16),
    expert=GemmaSize(width=64, depth=3, mlp_dim=128, num_heads=8, num_kv_heads=1, head_dim=16),
    vision=SiglipSize(hidden=96, layers=3, heads=4, inter=192, patch=16),
    vocab_size=VOCABULARY,
)
IMAGE_SIDE = 96
CHUNK = 16
TEXT_TOKENS = 16
CAMERA = "observation.images.base"
LOOKED_AT = (70, 20, 310, 620)
"""The part of the 480 x 640 camera picture that holds both tiles of every preset: top, left, height, width."""
ACTION_DIMS = (0, 1, 2, 6)
"""Action dimensions that the policy decides: x, y, z and the gripper. It never turns the hand."""
IDLE_DIMS = (3, 4, 5)

Statistics = Mapping[str, tuple[ArrayLike, ArrayLike]]
"""Mean and standard deviation per feature, in metres, radians and openness (1 open, 0 closed)."""

GUESSED: Statistics = {
    "action": ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5], [0.02, 0.02, 0.02, 0.0, 0.0, 0.0, 0.5]),
    "observation.state": ([0.32, 0.03, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5], [0.06, 0.09, 0.05, 0.1, 0.1, 0.1, 1.0, 0.5]),
}
"""Approximate statistics of the scripted expert; for policies with random weights."""


def new_pi0_tiny(seed: int) -> PI0Policy:
    """Return the policy with seeded random weights, which are 0 in the action dimensions it does not decide.

    A dimension whose statistics have no spread is restored to its mean, whatever the network says. Without weights
    into and out of it, its flow noise disturbs nothing.
    """
    policy = build_pi0(_config(), SIZE)
    initialise(policy, seed)
    idle = list(IDLE_DIMS)
    with torch.no_grad():
        policy.model.action_in_proj.weight[:, idle] = 0.0
        policy.model.action_out_proj.weight[idle] = 0.0
        policy.model.action_out_proj.bias[idle] = 0.0
    return policy


def write_checkpoint(
    folder: Path, policy: PI0Policy, statistics: Statistics, note: str, dtype: torch.dtype = torch.float32
) -> None:
    """Write config, dimensions, tokenizer, statistics and weights in lerobot's layout.

    Args:
        folder: Folder to write, which is created.
        policy: Policy with its weights.
        statistics: Mean and deviation of state and action.
        note: Description of the weights, which goes into the metadata of their file.
        dtype: Type in which the weights are stored.
    """
    folder.mkdir(parents=True, exist_ok=True)
    policy.config.save_pretrained(folder)
    (folder / "dims.json").write_text(json.dumps(SIZE.to_json(), indent=1), encoding="utf-8")
    write_tokenizer(folder, TEXT_TOKENS)
    _write_statistics(folder, statistics)
    save_file(
        {name: tensor.to(dtype).contiguous() for name, tensor in policy.state_dict().items()},
        folder / "model.safetensors",
        metadata={"format": "pt", "probe_kit.weights": note},
    )


def _config() -> PI0Config:
    return PI0Config(
        input_features={
            CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 480, 640)),
            "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        },
        device="cpu",
        push_to_hub=False,
        chunk_size=CHUNK,
        n_action_steps=4,
        max_state_dim=8,
        max_action_dim=7,
        image_resolution=(IMAGE_SIDE, IMAGE_SIDE),
        tokenizer_max_length=TEXT_TOKENS,
    )


def _write_statistics(folder: Path, statistics: Statistics) -> None:
    arrays = {
        f"{feature}.{name}": np.asarray(values, np.float32)
        for feature, pair in statistics.items()
        for name, values in zip(("mean", "std"), pair, strict=True)
    }
    modes = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
    for pipeline, step in (("policy_preprocessor", "normalizer"), ("policy_postprocessor", "unnormalizer")):
        state_file = f"{pipeline}_step_0_{step}_processor.safetensors"
        save_numpy(arrays, folder / state_file)
        entry: dict[str, Any] = {
            "registry_name": f"{step}_processor",
            "config": {"eps": 1e-8, "norm_map": modes},
            "state_file": state_file,
        }
        steps = [_window(), entry] if pipeline == "policy_preprocessor" else [entry]
        (folder / f"{pipeline}.json").write_text(
            json.dumps({"name": pipeline, "steps": steps}, indent=1), encoding="utf-8"
        )


def _window() -> dict[str, Any]:
    config = {"crop_params_dict": {CAMERA: LOOKED_AT}, "resize_size": (IMAGE_SIDE, IMAGE_SIDE)}
    return {"registry_name": "image_crop_resize_processor", "config": config}


# -- vlm-tiny -------------------------------------------------------------------------------------------------

MOST_TOKENS = 128
"""The most tokens of a whole prompt, the picture's 36 included."""
CAMERA_PICTURE = (480, 640)


def new_vlm_tiny(seed: int) -> Any:
    """Return a `PaliGemmaForConditionalGeneration` with seeded random weights, on the CPU, in eval mode."""
    network = build_paligemma(_vlm_config(), torch.float32, "cpu")
    initialise(network, seed)
    return network


def write_vlm_tiny(folder: Path, network: Any, note: str) -> None:
    """Write config, tokenizer, picture settings and weights in transformers' layout.

    Args:
        folder: Folder to write, which is created.
        network: A `PaliGemmaForConditionalGeneration` with its weights.
        note: Description of the weights, which goes into the metadata of their file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network.config.save_pretrained(folder)
    (folder / "generation_config.json").write_text(json.dumps({"eos_token_id": END}, indent=1), encoding="utf-8")
    (folder / "preprocessor_config.json").write_text(json.dumps(_pictures(), indent=1), encoding="utf-8")
    write_tokenizer(folder, MOST_TOKENS)
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    del tensors["lm_head.weight"]  # tied
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt", "probe_kit.weights": note})


def _vlm_config() -> PaliGemmaConfig:
    text = {
        "model_type": "gemma",
        "hidden_size": SIZE.vlm.width,
        "intermediate_size": SIZE.vlm.mlp_dim,
        "num_hidden_layers": SIZE.vlm.depth,
        "num_attention_heads": SIZE.vlm.num_heads,
        "num_key_value_heads": SIZE.vlm.num_kv_heads,
        "head_dim": SIZE.vlm.head_dim,
        "vocab_size": VOCABULARY,
        "max_position_embeddings": MOST_TOKENS,
        "hidden_activation": "gelu_pytorch_tanh",
        "pad_token_id": SPECIAL.index("<pad>"),
        "bos_token_id": SPECIAL.index("<bos>"),
        "eos_token_id": END,
    }
    vision = {
        "model_type": "siglip_vision_model",
        "hidden_size": SIZE.vision.hidden,
        "intermediate_size": SIZE.vision.inter,
        "num_hidden_layers": SIZE.vision.layers,
        "num_attention_heads": SIZE.vision.heads,
        "patch_size": SIZE.vision.patch,
        "image_size": IMAGE_SIDE,
        "projection_dim": SIZE.vlm.width,
        "vision_use_head": False,
    }
    return PaliGemmaConfig(
        text_config=text,
        vision_config=vision,
        projection_dim=SIZE.vlm.width,
        hidden_size=SIZE.vlm.width,
        image_token_index=IMAGE_TOKEN,
        architectures=["PaliGemmaForConditionalGeneration"],
    )


def _pictures() -> dict[str, Any]:
    """Return SigLIP's own settings, and the part of a picture that is used."""
    height, width = CAMERA_PICTURE
    top, column, rows, columns = LOOKED_AT
    return {
        "image_processor_type": "SiglipImageProcessor",
        "do_resize": True,
        "do_rescale": True,
        "rescale_factor": 1 / 255,
        "do_normalize": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
        "resample": 2,
        "size": {"height": IMAGE_SIDE, "width": IMAGE_SIDE},
        CROP: [top / height, column / width, rows / height, columns / width],
    }
