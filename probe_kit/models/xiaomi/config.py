"""The `config.json` of a Xiaomi-Robotics-R0 checkpoint."""

from typing import Annotated, Self

from pydantic import Field, InstanceOf, model_validator
from transformers import Qwen3VLConfig

from probe_kit.models.building import without_precision
from probe_kit.models.config_file import STORED_TYPE, ConfigFile, Count, part

MODEL_TYPE = "mibot"


class FlowConfig(ConfigFile):
    """The flow transformer: layers, width, size of a head, and heads in the cache it reads."""

    layers: Count = Field(default=16, validation_alias="num_hidden_layers")
    width: Count = Field(default=1024, validation_alias="hidden_size")
    head_dim: Count = 128
    cached_heads: Count = Field(default=8, validation_alias="num_key_value_heads")


class XiaomiConfig(ConfigFile):
    """A checkpoint's configuration.

    vlm: transformers' configuration of Qwen3-VL. state_length: positions the state takes. state_dim, action_dim:
    numbers per position. action_length: of a chunk where no robot's statistics say otherwise.
    """

    model_types = (MODEL_TYPE,)
    network = "Xiaomi-Robotics-R0"

    vlm: Annotated[InstanceOf[Qwen3VLConfig], part(lambda values: Qwen3VLConfig(**without_precision(values)))] = (
        Field(validation_alias="vlm_config")
    )
    flow: FlowConfig = Field(default=FlowConfig(), validation_alias="dit_config")
    state_length: Count = 1
    state_dim: Count
    action_length: Count = 30
    action_dim: Count
    dtype: str | None = STORED_TYPE

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """The flow transformer reads the cache of the VLM's last layers, head by head."""
        flow, text = self.flow, self.vlm.text_config
        pairs = (
            ("head_dim", flow.head_dim, text.head_dim),
            ("num_key_value_heads", flow.cached_heads, text.num_key_value_heads),
        )
        wrong = [f"{name} {ours}, the VLM's cache has {theirs}" for name, ours, theirs in pairs if ours != theirs]
        if flow.layers > text.num_hidden_layers:
            wrong.append(f"{flow.layers} layers, the VLM has only {text.num_hidden_layers}")
        if flow.width % flow.head_dim or (flow.width // flow.head_dim) % flow.cached_heads:
            wrong.append(
                f"hidden_size {flow.width} is no multiple of {flow.cached_heads} heads of {flow.head_dim}"
            )
        if wrong:
            raise ValueError(f"dit_config does not fit vlm_config: {'; '.join(wrong)}")
        return self
