"""The `config.json` of an Ovis2.5 checkpoint."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from transformers import Qwen3Config

from probe_kit.errors import CheckpointError
from probe_kit.models.building import without_precision


@dataclass(frozen=True)
class VisionConfig:
    """The vision tower.

    patch: pixels of a patch's side. stride: patches of a visual word's side. table: positions of a side of the
    square table that position embeddings are interpolated from. window: pixels of a side of the windows in whose
    order the authors' code goes through the patches; it changes no number but in the last bits.
    """

    width: int
    blocks: int
    heads: int
    mlp: int
    patch: int
    stride: int
    table: int
    window: int
    epsilon: float

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> "VisionConfig":
        """Read `vit_config`. Raises CheckpointError for towers that no released checkpoint has."""
        expected = {
            "fullatt_block_indexes": None,
            "use_rope": True,
            "preserve_original_pe": True,
            "temporal_patch_size": 1,
            "hidden_act": "gelu_pytorch_tanh",
            "num_channels": 3,
        }
        other = [f"{name} {values.get(name)!r}" for name, value in expected.items() if values.get(name) != value]
        if other:
            raise CheckpointError(
                f"the vision tower has {', '.join(other)}; implemented is what the released Ovis2.5 has: "
                + ", ".join(f"{name} {value!r}" for name, value in expected.items())
            )
        patch = int(values["patch_size"])
        config = cls(
            width=int(values["hidden_size"]),
            blocks=int(values["num_hidden_layers"]),
            heads=int(values["num_attention_heads"]),
            mlp=int(values["intermediate_size"]),
            patch=patch,
            stride=int(values["hidden_stride"]),
            table=int(values["image_size"]) // patch,
            window=int(values["window_size"]),
            epsilon=float(values["layer_norm_eps"]),
        )
        if config.width % (4 * config.heads):
            raise CheckpointError(
                f"the vision tower has width {config.width} and {config.heads} heads; positions along two axes "
                "need a multiple of four numbers per head"
            )
        return config


@dataclass(frozen=True)
class OvisConfig:
    """A checkpoint's configuration. words: visual words, those that mark where pictures begin and end included."""

    text: Qwen3Config
    vision: VisionConfig
    words: int

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> "OvisConfig":
        """Read the content of config.json. Raises CheckpointError."""
        text = dict(values["llm_config"])
        if text.get("model_type") != "qwen3":
            raise CheckpointError(
                f"the language model is {text.get('model_type')!r}; expected 'qwen3', as in the released Ovis2.5"
            )
        return cls(
            Qwen3Config.from_dict(without_precision(text)),
            VisionConfig.of(values["vit_config"]),
            int(values["visual_vocab_size"]),
        )
