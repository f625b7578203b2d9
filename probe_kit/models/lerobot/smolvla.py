"""lerobot's own `SmolVLAPolicy`, built from the VLM configuration its checkpoint names; no second download."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
from lerobot.policies.smolvla import smolvlm_with_expert
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from torch import Tensor
from transformers import SmolVLMConfig

from probe_kit.errors import CheckpointError
from probe_kit.models.building import replaced
from probe_kit.models.lerobot.pi0_keys import STATISTICS
from probe_kit.models.pretrained import load_pretrained
from probe_kit.models.sizes_only import building_device


def build_smolvla(config: SmolVLAConfig, folder: Path, device: str = "cpu") -> SmolVLAPolicy:
    """A `SmolVLAPolicy` in eval mode, float32, with uninitialised weights.

    folder: the checkpoint; `vlm_model_name` may be a path relative to it, or a hub id. Only the VLM's
    configuration and tokenizer are read: its weights are part of the policy's own file.
    device: `meta` serves to look at names and shapes.
    Raises CheckpointError if the VLM's configuration cannot be found.
    """
    device = building_device(device)
    config.device = device
    config.load_vlm_weights = False
    name = config.vlm_model_name
    config.vlm_model_name = locate_vlm(config, folder)
    try:
        # lerobot prints while it builds; stdout belongs to results.
        with torch.device(device), redirect_stdout(sys.stderr), replaced(smolvlm_with_expert, _without_code()):
            policy = SmolVLAPolicy(config)
    except OSError as error:
        raise CheckpointError(
            f"{folder} names the VLM {name!r}, whose configuration and tokenizer cannot be found: "
            f"{str(error).splitlines()[0]}. Check your network, or name a local copy in its config.json"
        ) from error
    policy.eval()
    return cast(SmolVLAPolicy, policy)


def _without_code() -> dict[str, Any]:
    """The loaders that lerobot calls, so that they run no Python code of the VLM's files."""
    loaders = {name: getattr(smolvlm_with_expert, name) for name in ("AutoConfig", "AutoProcessor")}
    return {
        name: SimpleNamespace(from_pretrained=partial(load_pretrained, loader)) for name, loader in loaders.items()
    }


def locate_vlm(config: SmolVLAConfig, folder: Path) -> str:
    """The folder of a checkpoint's VLM, where it lies relative to that of the checkpoint, or its hub id."""
    local = folder / config.vlm_model_name
    return str(local.resolve()) if local.is_dir() else config.vlm_model_name


def current_smolvla_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors without the statistics that old files kept among the weights."""
    return {name: tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}


def full_size_smolvla() -> SmolVLAPolicy:
    """The released size, on the meta device, without the hub: for names and shapes only."""
    with _released_vlm():
        return build_smolvla(SmolVLAConfig(device="cpu"), Path(), device="meta")


@contextmanager
def _released_vlm() -> Iterator[None]:
    """While the network is built, lerobot asks us instead of the hub for SmolVLM2-500M's configuration."""
    config = SmolVLMConfig(
        text_config={
            "model_type": "llama",
            "hidden_size": 960,
            "num_hidden_layers": 32,
            "num_attention_heads": 15,
            "num_key_value_heads": 5,
            "head_dim": 64,
            "intermediate_size": 2560,
            "vocab_size": 49280,
        },
        vision_config={
            "hidden_size": 768,
            "num_hidden_layers": 12,
            "num_attention_heads": 12,
            "intermediate_size": 3072,
            "patch_size": 16,
            "image_size": 512,
        },
        scale_factor=4,
    )
    tokenizer = SimpleNamespace(fake_image_token_id=0, global_image_token_id=0)
    answers = {
        "AutoConfig": SimpleNamespace(from_pretrained=lambda _, **__: config),
        "AutoProcessor": SimpleNamespace(from_pretrained=lambda _, **__: SimpleNamespace(tokenizer=tokenizer)),
    }
    with replaced(smolvlm_with_expert, answers):
        yield
