"""The `config.json` of a Xiaomi-Robotics-R0 checkpoint."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transformers import Qwen3VLConfig

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.models.qwen import without_precision

MODEL_TYPE = "mibot"


@dataclass(frozen=True)
class FlowConfig:
    """The flow transformer: layers, width, size of a head, and heads in the cache it reads."""

    layers: int = 16
    width: int = 1024
    head_dim: int = 128
    cached_heads: int = 8


@dataclass(frozen=True)
class XiaomiConfig:
    """A checkpoint's configuration.

    vlm: transformers' configuration of Qwen3-VL. state_length: positions the state takes. state_dim, action_dim:
    numbers per position. action_length: of a chunk where no robot's statistics say otherwise. dtype: as stored,
    None if the file does not say.
    """

    vlm: Qwen3VLConfig
    flow: FlowConfig
    state_length: int
    state_dim: int
    action_length: int
    action_dim: int
    dtype: str | None

    @classmethod
    def from_folder(cls, folder: Path) -> "XiaomiConfig":
        """Read `folder/config.json`. Raises CheckpointError if it is missing or describes another model."""
        file = folder / "config.json"
        if not file.is_file():
            raise CheckpointError(f"{file} is missing; {folder} is not a Xiaomi-Robotics-R0 checkpoint")
        return cls.from_json(load_json(file), str(file))

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "config") -> "XiaomiConfig":
        """Read the content of a `config.json`. Raises CheckpointError naming `source`."""
        if (model_type := values.get("model_type")) != MODEL_TYPE:
            raise CheckpointError(
                f"{source} holds a {model_type!r} model; expected {MODEL_TYPE!r} (Xiaomi-Robotics-R0). "
                "Pass the right --model"
            )
        missing = [name for name in ("vlm_config", "state_dim", "action_dim") if name not in values]
        if missing:
            raise CheckpointError(f"{source} lacks {', '.join(missing)}; the checkpoint is not whole")
        config = cls(
            vlm=Qwen3VLConfig(**without_precision(values["vlm_config"])),
            flow=_flow(values.get("dit_config") or {}),
            state_length=int(values.get("state_length", 1)),
            state_dim=int(values["state_dim"]),
            action_length=int(values.get("action_length", 30)),
            action_dim=int(values["action_dim"]),
            dtype=values.get("torch_dtype") or values.get("dtype"),
        )
        _check_unfit(config, source)
        return config


def _flow(values: Mapping[str, Any]) -> FlowConfig:
    default = FlowConfig()
    return FlowConfig(
        layers=int(values.get("num_hidden_layers", default.layers)),
        width=int(values.get("hidden_size", default.width)),
        head_dim=int(values.get("head_dim", default.head_dim)),
        cached_heads=int(values.get("num_key_value_heads", default.cached_heads)),
    )


def _check_unfit(config: XiaomiConfig, source: str) -> None:
    """The flow transformer reads the cache of the VLM's last layers, head by head."""
    flow, text = config.flow, config.vlm.text_config
    pairs = (
        ("head_dim", flow.head_dim, text.head_dim),
        ("num_key_value_heads", flow.cached_heads, text.num_key_value_heads),
    )
    wrong = [f"{name} {ours}, the VLM's cache has {theirs}" for name, ours, theirs in pairs if ours != theirs]
    if flow.layers > text.num_hidden_layers:
        wrong.append(f"{flow.layers} layers, the VLM has only {text.num_hidden_layers}")
    if flow.width % flow.head_dim or (flow.width // flow.head_dim) % flow.cached_heads:
        wrong.append(f"hidden_size {flow.width} is no multiple of {flow.cached_heads} heads of {flow.head_dim}")
    if wrong:
        raise CheckpointError(f"{source}: dit_config does not fit vlm_config: {'; '.join(wrong)}")
