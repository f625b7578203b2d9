"""The `config.json` of a Magma checkpoint.

`text_config` is the language model's; where the file has none, its top level repeats the same fields.
`vision_config` is a plain dictionary; what it leaves out is the trunk's own.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transformers import LlamaConfig

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError

# Per name in the file: timm's trunk, and the width of the contrastive head that the forward pass never reads.
_BACKBONES = {"convnextxxlarge": ("convnext_xxlarge", 1024)}
# Older checkpoints append the number of trace tokens; the modules are the same.
_PROJECTOR = re.compile(r"mlp(?P<layers>[1-9]\d*)x_gelu(_segtokv\d+)?")
STRATEGIES = ("crop", "global")


@dataclass(frozen=True)
class VisionConfig:
    """The trunk, its projector, and how crops are put together.

    strategy: `crop` runs the trunk on every crop, `global` on the whole picture that the crops make up.
    base: side of a crop in pixels. crops: the most crops of one picture. separators: whether the projector
    holds vectors for the begin and end of a picture, which the forward pass never reads.
    """

    trunk: str
    overrides: Mapping[str, Any]
    head_width: int
    strategy: str
    base: int
    crops: int
    projector_layers: int
    feature_width: int | None
    separators: bool


@dataclass(frozen=True)
class MagmaConfig:
    """A checkpoint's configuration.

    text: transformers' configuration of the language model. image_token: the id that a picture replaces.
    image_start_end: whether the prompt wraps a picture in two tokens. base_vocabulary: number of text ids before
    the added tokens, None if only the tokenizer knows. dtype: as stored, None if the file does not say.
    """

    text: Any
    vision: VisionConfig
    image_token: int
    image_start_end: bool
    base_vocabulary: int | None
    dtype: str | None

    @classmethod
    def from_folder(cls, folder: Path) -> "MagmaConfig":
        """Read `folder/config.json`. Raises CheckpointError if it is missing or describes another model."""
        file = folder / "config.json"
        if not file.is_file():
            raise CheckpointError(f"{file} is missing; {folder} is not a Magma checkpoint")
        return cls.from_json(load_json(file), str(file))

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "config") -> "MagmaConfig":
        """Read the content of a `config.json`. Raises CheckpointError naming `source`."""
        if values.get("model_type") != "magma":
            raise CheckpointError(
                f"{source} holds a {values.get('model_type')!r} model; expected 'magma'. Pass the right --model"
            )
        if not isinstance(values.get("vision_config"), Mapping) or values.get("image_token_index") is None:
            raise CheckpointError(
                f"{source} lacks vision_config or image_token_index; it is not a whole config.json"
            )
        text = _text_config(values, source)
        vocabulary = values.get("tokenizer_vocab_size")
        return cls(
            text=text,
            vision=_vision_config(values["vision_config"], int(text.hidden_size), source),
            image_token=int(values["image_token_index"]),
            image_start_end=bool(values.get("mm_use_image_start_end", False)),
            base_vocabulary=None if vocabulary is None else int(vocabulary),
            dtype=values.get("torch_dtype") or values.get("dtype"),
        )


def _text_config(values: Mapping[str, Any], source: str) -> Any:
    stored = values.get("text_config")
    if stored is None:
        stored = {name: value for name, value in values.items() if name not in ("model_type", "vision_config")}
    model_type = stored.get("model_type", "llama")
    if model_type != "llama":
        raise CheckpointError(
            f"{source}: text_config describes a {model_type} model; Magma reads with a llama model"
        )
    return LlamaConfig.from_dict({**stored, "model_type": "llama"})


def _vision_config(values: Mapping[str, Any], width: int, source: str) -> VisionConfig:
    backbone = values.get("vision_backbone", "convnextxxlarge")
    projector = str(values.get("mm_projector_type", "linear"))
    strategy = values.get("img_anyres_strategy", "crop")
    layer = values.get("vision_feature_layer", "clip_vis_dense")
    match = _PROJECTOR.fullmatch(projector)
    for name, value, supported in (
        ("vision_backbone", backbone, tuple(_BACKBONES)),
        ("img_anyres_strategy", strategy, STRATEGIES),
        ("vision_feature_layer", layer, ("clip_vis_dense",)),
        ("hidden_size", values.get("hidden_size", width), (width,)),
    ):
        if value not in supported:
            raise CheckpointError(
                f"{source}: vision_config.{name} {value!r} is not {' or '.join(map(str, supported))}"
            )
    if match is None:
        raise CheckpointError(f"{source}: vision_config.mm_projector_type {projector!r}; expected mlp2x_gelu")
    trunk, head_width = _BACKBONES[backbone]
    feature_width = values.get("mm_hidden_size")
    return VisionConfig(
        trunk=str(values.get("timm_model_name", trunk)),
        overrides=dict(values.get("timm_overrides") or {}),
        head_width=int(values.get("open_clip_embed_dim", head_width)),
        strategy=strategy,
        base=int(values.get("img_size", 512)),
        crops=int(values.get("max_num_crops", 4)),
        projector_layers=int(match["layers"]),
        feature_width=None if feature_width is None else int(feature_width),
        separators=bool(values.get("mm_use_im_start_end", False)),
    )
