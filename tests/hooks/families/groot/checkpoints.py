"""Tiny GR00T N1.7 checkpoints in NVIDIA's layout, as transformers writes it, and in lerobot's."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST
from tests.support.vlm_checkpoints import write_qwen3_vl
from tests.support.written_once import written_once

TAG, HORIZON, CHUNK = "libero_sim", 6, 4
"""HORIZON: actions that the network puts out; CHUNK: those that have a meaning."""
_STATE = {"x": 1, "y": 1, "z": 1, "rotation": 3, "gripper": 2}
_ACTION = {"x": 1, "y": 1, "z": 1, "roll": 1, "pitch": 1, "yaw": 1, "gripper": 1}
_CHAT = (
    "{% for message in messages %}<|im_start|>{{ message['role'] }}\n{% for content in message['content'] %}"
    "{% if content['type'] == 'image' %}<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ content['text'] }}"
    "{% endif %}{% endfor %}<|im_end|>\n{% endfor %}"
)
NETWORK: dict[str, Any] = {
    "model_name": "vlm", "backbone_model_type": "qwen", "dtype": "float32", "model_dtype": "float32",
    "select_layer": 2, "backbone_embedding_dim": 32, "hidden_size": 20, "input_embedding_dim": 24,
    "max_state_dim": 12, "max_action_dim": 10, "action_horizon": HORIZON, "max_num_embodiments": 4,
    "num_inference_timesteps": 3, "max_seq_len": 16,
    "diffusion_model_cfg": {
        "num_layers": 4, "num_attention_heads": 3, "attention_head_dim": 8, "output_dim": 20, "dropout": 0.2,
        "norm_type": "ada_norm", "final_dropout": True, "interleave_self_attention": True,
        "positional_embeddings": None,
    },
    "vl_self_attention_cfg": {
        "num_layers": 2, "num_attention_heads": 4, "attention_head_dim": 8, "dropout": 0.2, "final_dropout": True,
        "positional_embeddings": None,
    },
}  # fmt: skip


@written_once
def write_nvidias(
    folder: Path, seed: int = 22, cameras: Sequence[str] = ("image",), relative: bool = False, **network: Any
) -> Path:
    """Two layers of three of a Qwen3-VL, two of a bridge, four of an expert.

    network: fields of its configuration.
    relative: the actions of the arm are relative to its state, as in most of NVIDIA's embodiments.
    """
    from probe_kit.hooks.families.groot.network import GrootConfig, build_groot, network_config
    from probe_kit.models.building import initialise

    write_processor_files(folder / "vlm", write_qwen3_vl)
    _write_processor(folder, cameras, relative)
    config = GrootConfig(device="cpu", base_model_path=str(folder), input_features=_features(cameras)[0])
    policy = build_groot(config, network_config({**NETWORK, **network}, config, str(folder / "vlm")))
    initialise(policy, seed)
    model = policy._groot_model
    model.config.model_name = "vlm"
    model.save_pretrained(folder, max_shard_size="400KB")  # a single file is lerobot's layout to lerobot
    return folder


@written_once
def write_groot(folder: Path, seed: int = 22, cameras: Sequence[str] = ("image",), **fields: Any) -> Path:
    """What lerobot saves of a policy that grew from `base`; `fields` go into its configuration."""
    from probe_kit.hooks.families.groot.adapter import Groot
    from probe_kit.hooks.families.groot.network import GrootConfig

    write_nvidias(folder / "base", seed, cameras)
    inputs, outputs = _features(cameras)
    config = GrootConfig(
        device="cpu", base_model_path=str(folder / "base"), embodiment_tag=TAG, input_features=inputs,
        output_features=outputs, max_state_dim=12, max_action_dim=10, **{"use_bf16": False, **fields},
    )  # fmt: skip
    from lerobot.policies.groot.processor_groot import make_groot_pre_post_processors

    policy = Groot.load(str(folder / "base"), embodiment=TAG).network
    for pipeline, name in zip(make_groot_pre_post_processors(config), ("pre", "post"), strict=True):
        pipeline.save_pretrained(folder, config_filename=f"policy_{name}processor.json")
    config.base_model_path = "base"
    policy.config = config
    policy.save_pretrained(folder)
    return folder


def _features(cameras: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    from lerobot.configs.types import FeatureType, PolicyFeature

    inputs = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 48, 80)) for name in cameras}
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (len(LOW),))
    return inputs, {"action": PolicyFeature(FeatureType.ACTION, (len(MOST),))}


def write_processor_files(folder: Path, write: Callable[[Path], Path]) -> None:
    """Configuration, tokenizer and processor files of a Qwen vision-language model, no weights."""
    write(folder)
    for weights in folder.glob("model*.safetensors*"):
        weights.unlink()
    card = json.loads((folder / "tokenizer_config.json").read_text(encoding="utf-8"))
    (folder / "tokenizer_config.json").write_text(json.dumps({**card, "chat_template": _CHAT}), encoding="utf-8")
    (folder / "chat_template.jinja").write_text(_CHAT, encoding="utf-8")
    shutil.copy(folder / "preprocessor_config.json", folder / "video_preprocessor_config.json")


def _write_processor(folder: Path, cameras: Sequence[str], relative: bool) -> None:
    kind = {"type": "NON_EEF", "format": "DEFAULT", "state_key": None}
    arm = "RELATIVE" if relative else "ABSOLUTE"
    modalities = {
        "video": {"delta_indices": [0], "modality_keys": list(cameras)},
        "state": {"delta_indices": [0], "modality_keys": list(_STATE)},
        "action": {
            "delta_indices": list(range(CHUNK)),
            "modality_keys": list(_ACTION),
            "action_configs": [{"rep": "ABSOLUTE" if key == "gripper" else arm, **kind} for key in _ACTION],
        },
    }
    settings = {
        "modality_configs": {TAG: modalities, "other": modalities}, "max_action_horizon": HORIZON,
        "use_percentiles": True, "use_relative_action": relative, "clip_outliers": True,
        "formalize_language": True, "image_target_size": [64, 64], "image_crop_size": [58, 58],
    }  # fmt: skip
    statistics = {
        "state": _grouped(_STATE, LOW, HIGH),
        "action": _grouped(_ACTION, LEAST, MOST),
        "relative_action": _grouped(_ACTION, LEAST, MOST),
    }
    files = {
        "processor_config.json": {"processor_class": "Gr00tN1d7Processor", "processor_kwargs": settings},
        "statistics.json": {TAG: statistics, "other": statistics},
        "embodiment_id.json": {TAG: 2, "other": 1},
    }
    for name, content in files.items():
        (folder / name).write_text(json.dumps(content), encoding="utf-8")


def _grouped(groups: dict[str, int], low: Any, high: Any) -> dict[str, dict[str, list[float]]]:
    """Statistics by group; the extremes lie beyond the quantiles, so that one is not taken for the other."""
    group_statistics, begin = {}, 0
    for key, numbers in groups.items():
        span = slice(begin, begin + numbers)
        q01, q99 = (torch.from_numpy(values[span]) for values in (low, high))
        values = {"q01": q01, "q99": q99, "min": q01 - 1, "max": q99 + 1, "mean": q01, "std": q99 - q01}
        group_statistics[key] = {name: value.tolist() for name, value in values.items()}
        begin += numbers
    return group_statistics
