"""The `config.json` of an Ovis2.5 checkpoint."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, InstanceOf, PositiveFloat, model_validator
from transformers import Qwen3Config

from probe_kit.models.building import without_precision
from probe_kit.models.config_file import ConfigFile, Count, part


class VisionConfig(ConfigFile):
    """The vision tower, of which only what every released checkpoint has is implemented.

    patch: pixels of a patch's side. stride: patches of a visual word's side. side: pixels of a side of the square
    from whose table position embeddings are interpolated. window: pixels of a side of the windows in whose order
    the authors' code goes through the patches; it changes no number but in the last bits.
    """

    width: Count = Field(validation_alias="hidden_size")
    blocks: Count = Field(validation_alias="num_hidden_layers")
    heads: Count = Field(validation_alias="num_attention_heads")
    mlp: Count = Field(validation_alias="intermediate_size")
    patch: Count = Field(validation_alias="patch_size")
    stride: Count = Field(validation_alias="hidden_stride")
    side: Count = Field(validation_alias="image_size")
    window: Count = Field(validation_alias="window_size")
    epsilon: PositiveFloat = Field(validation_alias="layer_norm_eps")
    fullatt_block_indexes: None = None
    use_rope: Literal[True]
    preserve_original_pe: Literal[True]
    temporal_patch_size: Literal[1]
    hidden_act: Literal["gelu_pytorch_tanh"]
    num_channels: Literal[3]

    @property
    def table(self) -> int:
        """Positions of a side of the square table."""
        return self.side // self.patch

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.width % (4 * self.heads):
            raise ValueError(
                f"has width {self.width} and {self.heads} heads; positions along two axes need a multiple of four "
                "numbers per head"
            )
        return self


class OvisConfig(ConfigFile):
    """A checkpoint's configuration. words: visual words, those that mark where pictures begin and end included."""

    network = "Ovis2.5"

    text: Annotated[
        InstanceOf[Qwen3Config], part(lambda values: Qwen3Config.from_dict(without_precision(values)), "qwen3")
    ] = Field(validation_alias="llm_config")
    vision: VisionConfig = Field(validation_alias="vit_config")
    words: Count = Field(validation_alias="visual_vocab_size")

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Read the content of config.json. Raises CheckpointError."""
        return cls.read(values, "config.json")
