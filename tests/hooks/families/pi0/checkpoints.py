"""Tiny pi0 checkpoints in lerobot's layout of early 2025, as its code at that time wrote them."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.support.written_once import written_once

VLM = "model.paligemma_with_expert.paligemma"
# lerobot 0.6 on the left, lerobot of early 2025 (with transformers 4.48) on the right.
OLDER = (
    (f"{VLM}.model.language_model.", f"{VLM}.language_model.model."),
    (f"{VLM}.lm_head.", f"{VLM}.language_model.lm_head."),
    (f"{VLM}.model.vision_tower.", f"{VLM}.vision_tower."),
    (f"{VLM}.model.multi_modal_projector.", f"{VLM}.multi_modal_projector."),
)
BRIDGE_LIKE = {
    "action": {
        "p01": [-0.03, -0.04, -0.02, -0.08, -0.09, -0.2, 0.0],
        "p99": [0.02, 0.05, 0.04, 0.06, 0.07, 0.25, 1.0],
        "mean": [0.0] * 7,
    },
    "proprio": {
        "p01": [0.17, -0.16, -0.05, -0.36, -0.54, -1.35, 0.05],
        "p99": [0.45, 0.23, 0.19, 0.37, 0.27, 1.83, 1.01],
    },
}


def older(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of lerobot 0.6 under their old names; the tied embedding is stored once, as the head."""
    renamed_tensors = {}
    for name, tensor in tensors.items():
        renamed = next((old + name.removeprefix(new) for new, old in OLDER if name.startswith(new)), name)
        renamed_tensors[renamed] = tensor.contiguous()
    embedding = f"{VLM}.language_model.model.embed_tokens.weight"
    renamed_tensors[f"{VLM}.language_model.lm_head.weight"] = renamed_tensors.pop(embedding)
    return renamed_tensors


def old_config(config: Mapping[str, Any], modes: Mapping[str, str]) -> dict[str, Any]:
    """`config.json` as it was written then, from today's values."""
    kept_keys = ("type", "n_obs_steps", "input_features", "output_features", "device", "use_amp", "chunk_size",
            "n_action_steps", "max_state_dim", "max_action_dim", "empty_cameras", "tokenizer_max_length",
            "freeze_vision_encoder", "train_expert_only", "optimizer_lr", "optimizer_betas", "optimizer_eps",
            "optimizer_weight_decay", "scheduler_warmup_steps", "scheduler_decay_lr")  # fmt: skip
    return {
        **{name: config[name] for name in kept_keys},
        "normalization_mapping": dict(modes),
        "resize_imgs_with_padding": config["image_resolution"],
        "num_steps": config["num_inference_steps"],
        "proj_width": 1024,
        "use_cache": True,
        "attention_implementation": "eager",
        "train_state_proj": True,
        "adapt_to_pi_aloha": False,
        "use_delta_joint_actions_aloha": False,
    }


def old_golden(golden: Path, target: Path) -> Path:
    """The golden reference with its checkpoint in the old layout: its statistics among the weights."""
    shutil.copytree(golden, target)
    checkpoint = target / "checkpoint"
    tensors_by_part: dict[str, dict[str, Tensor]] = {}
    for path in checkpoint.glob("policy_*.safetensors"):
        tensors_by_part[path.name.split("_step")[0]] = load_file(path)
    for path in (*checkpoint.glob("policy_*"),):
        path.unlink()
    buffers = {
        f"{module}.buffer_{feature.replace('.', '_')}.{name}": tensors_by_part[pipeline][f"{feature}.{name}"]
        for module, pipeline, feature in (
            ("normalize_inputs", "policy_preprocessor", "observation.state"),
            ("unnormalize_outputs", "policy_postprocessor", "action"),
        )
        for name in ("mean", "std")
    }
    weights = load_file(checkpoint / "model.safetensors")
    save_file({**older(weights), **buffers}, checkpoint / "model.safetensors", metadata={"format": "pt"})
    config = json.loads((checkpoint / "config.json").read_text(encoding="utf-8"))
    modes = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
    (checkpoint / "config.json").write_text(json.dumps(old_config(config, modes), indent=4), encoding="utf-8")
    return target


@written_once
def write_intact(folder: Path, seed: int = 0) -> Path:
    """A tiny pi0 as INT-ACT fine-tuned it: 7-D state and action, chunk of 4, units left to its evaluation."""
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.pi0.configuration_pi0 import PI0Config

    from probe_kit.hooks.families.embedded import SIZE
    from probe_kit.hooks.families.pi0.network import build_pi0
    from probe_kit.models.building import initialise
    from probe_kit.models.embedded import embedded_checkpoint

    config = PI0Config(
        input_features={
            "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 96, 96)),
            "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        normalization_mapping=dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY),
        device="cpu",
        chunk_size=4,
        n_action_steps=4,
        image_resolution=(96, 96),
    )
    network = build_pi0(config, SIZE)
    initialise(network, seed)
    folder.mkdir(parents=True)
    config.save_pretrained(folder)
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    modes = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")
    (folder / "config.json").write_text(json.dumps(old_config(values, modes), indent=4), encoding="utf-8")
    (folder / "dims.json").write_text(json.dumps(SIZE.to_json()), encoding="utf-8")
    for name in ("tokenizer.json", "tokenizer_config.json"):
        shutil.copy(embedded_checkpoint("pi0-tiny") / name, folder / name)
    save_file(older(network.state_dict()), folder / "model.safetensors", metadata={"format": "pt"})
    return folder


def write_statistics(path: Path) -> Path:
    """A statistics file as INT-ACT's evaluation reads it."""
    path.write_text(json.dumps(BRIDGE_LIKE), encoding="utf-8")
    return path


def bounds_of(part: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """p01 and p99 of `BRIDGE_LIKE`."""
    return tuple(np.array(BRIDGE_LIKE[part][name]) for name in ("p01", "p99"))  # type: ignore[return-value]


def network_chunk(
    policy: Any, picture: NDArray[np.uint8], state: NDArray[np.float64], text: str, seed: int
) -> Any:
    """(chunk, 7) of the bare network: 5 lines of lerobot's own calls, around our adapter."""
    from probe_kit.hooks.families.shared.kinds import IMAGES, STATE
    from probe_kit.hooks.families.shared.lerobot.packing import MASK, TOKENS

    tokens, mask = policy.tokenise([text])
    batch = {
        f"{IMAGES}top": torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255,
        STATE: torch.from_numpy(state.astype(np.float32))[None],
        TOKENS: tokens,
        MASK: mask,
    }
    chunk: NDArray[np.float64] = policy.network.predict_action_chunk(batch, noise=policy.noise([seed]))[0].numpy()
    return chunk.astype(np.float64)
