"""The `config.json` of a Magma checkpoint.

`text_config` is the language model's; where the file has none, its top level repeats the same fields.
`vision_config` is a plain dictionary; what it leaves out is the trunk's own.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, InstanceOf, model_validator
from transformers import LlamaConfig

from probe_kit._system.bounded_json import load_json
from probe_kit.models.config_file import STORED_TYPE, ConfigFile, Count, Index, part

# Older checkpoints append the number of trace tokens; the modules are the same.
_PROJECTOR = re.compile(r"mlp(?P<layers>[1-9]\d?)x_gelu(_segtokv\d+)?")


class VisionConfig(ConfigFile):
    """The trunk, its projector, and how crops are put together.

    trunk: timm's name. head_width: of the contrastive head that the forward pass never reads. strategy: `crop`
    runs the trunk on every crop, `global` on the whole picture that the crops make up. base: side of a crop in
    pixels. crops: the most crops of one picture. width: of the language model, None where only that one says.
    separators: whether the projector holds vectors for the begin and end of a picture, which the forward pass
    never reads.
    """

    backbone: Literal["convnextxxlarge"] = Field(default="convnextxxlarge", validation_alias="vision_backbone")
    layer: Literal["clip_vis_dense"] = Field(default="clip_vis_dense", validation_alias="vision_feature_layer")
    trunk: str = Field(default="convnext_xxlarge", validation_alias="timm_model_name")
    overrides: dict[str, Any] = Field(default={}, validation_alias="timm_overrides")
    head_width: Count = Field(default=1024, validation_alias="open_clip_embed_dim")
    strategy: Literal["crop", "global"] = Field(default="crop", validation_alias="img_anyres_strategy")
    base: Count = Field(default=512, validation_alias="img_size")
    crops: Count = Field(default=4, validation_alias="max_num_crops")
    projector: Annotated[str, Field(pattern=f"^{_PROJECTOR.pattern}$".replace("?P<layers>", ""))] = Field(
        validation_alias="mm_projector_type"
    )
    feature_width: Count | None = Field(default=None, validation_alias="mm_hidden_size")
    width: Count | None = Field(default=None, validation_alias="hidden_size")
    separators: bool = Field(default=False, validation_alias="mm_use_im_start_end")

    @property
    def projector_layers(self) -> int:
        """Linear layers of the projector."""
        match = _PROJECTOR.fullmatch(self.projector)
        assert match is not None
        return int(match["layers"])


class MagmaConfig(ConfigFile):
    """A checkpoint's configuration.

    text: transformers' configuration of the language model. image_token: the id that a picture replaces.
    image_start_end: whether the prompt wraps a picture in two tokens. base_vocabulary: number of text ids before
    the added tokens, None if only the tokenizer knows.
    """

    model_types = ("magma",)
    network = "Magma"

    text: Annotated[InstanceOf[LlamaConfig], part(LlamaConfig.from_dict, "llama")] = Field(
        validation_alias="text_config"
    )
    vision: VisionConfig = Field(validation_alias="vision_config")
    image_token: Index = Field(validation_alias="image_token_index")
    image_start_end: bool = Field(default=False, validation_alias="mm_use_image_start_end")
    base_vocabulary: Count | None = Field(default=None, validation_alias="tokenizer_vocab_size")
    dtype: str | None = STORED_TYPE

    @model_validator(mode="before")
    @classmethod
    def _text_at_the_top(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        other_fields = {
            name: value for name, value in values.items() if name not in ("model_type", "vision_config")
        }
        return {
            "text_config": other_fields,
            **{name: value for name, value in values.items() if value is not None},
        }

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.vision.width not in (None, self.text.hidden_size):
            raise ValueError(
                f"vision_config.hidden_size {self.vision.width} is not the text's {self.text.hidden_size}"
            )
        return self


def shipped_statistics() -> dict[str, Any]:
    """Per data set, the quantiles that un-normalise its actions; `statistics.json` names their source.

    No checkpoint holds them: the evaluation's client has them in its code.
    """
    return dict(load_json(Path(__file__).parent / "statistics.json")["norm_stats"])
