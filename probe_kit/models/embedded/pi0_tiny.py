"""The embedded policy: a pi0 of 0.84 million parameters, stored as an ordinary lerobot checkpoint.

Its weights lie in `checkpoints/` beside this file, with a model card; `scripts/train_embedded_policy.py` makes
them of the embedded VLM.
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

from probe_kit.models.embedded.words import VOCABULARY, write_tokenizer
from probe_kit.models.initialisation import initialise
from probe_kit.models.lerobot.pi0 import GemmaSize, Pi0Size, SiglipSize, build_pi0

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
"""Of the 480 x 640 camera picture, the part that holds both tiles of every preset: top, left, height, width."""
ACTION_DIMS = (0, 1, 2, 6)
"""What the policy decides: x, y, z and the gripper. It never turns the hand."""
IDLE_DIMS = (3, 4, 5)

Statistics = Mapping[str, tuple[ArrayLike, ArrayLike]]
"""Mean and standard deviation per feature, in metres, radians and openness (1 open, 0 closed)."""

GUESSED: Statistics = {
    "action": ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5], [0.02, 0.02, 0.02, 0.0, 0.0, 0.0, 0.5]),
    "observation.state": ([0.32, 0.03, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5], [0.06, 0.09, 0.05, 0.1, 0.1, 0.1, 1.0, 0.5]),
}
"""About what the scripted expert does; for policies with random weights."""


def new_pi0_tiny(seed: int) -> PI0Policy:
    """The policy with seeded random weights, deaf and dumb in the action dimensions it does not decide.

    A dimension whose statistics have no spread is restored to its mean, whatever the network says; without
    weights into and out of it, its flow noise disturbs nothing.
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

    note: what the weights are; it goes into the metadata of the file. dtype: the weights are stored in.
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
