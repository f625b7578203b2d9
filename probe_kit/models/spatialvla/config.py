"""The `config.json` of a SpatialVLA checkpoint.

The three networks inside are described as transformers describes them; what their parts leave out is transformers'
default, as it was when the file was written.
"""

from typing import Annotated, Any, Self

from pydantic import Field, InstanceOf, model_validator
from transformers import Gemma2Config, SiglipVisionConfig, ZoeDepthConfig

from probe_kit.models.config_file import STORED_TYPE, ConfigFile, Count, Index, part

MODEL_TYPE = "spatialvla"
_DEPTH = ("vision_zoe_config", "ego3d_patch_reso")


class SpatialVLAConfig(ConfigFile):
    """A checkpoint's configuration.

    text, vision, depth: transformers' configurations of Gemma-2, SigLIP and ZoeDepth; depth is None for a model
    that sees none. image_token: the id whose positions the picture takes. first_action, actions: the ids that name
    actions; they end the vocabulary. own_action_embeddings: whether those ids have a table of embeddings to
    themselves. projected: the width of a patch for the language model. points: 3-D points per patch and direction.
    frequencies: of their code.
    """

    model_types = (MODEL_TYPE,)
    network = "SpatialVLA"

    text: Annotated[InstanceOf[Gemma2Config], part(Gemma2Config.from_dict, "gemma2")] = Field(
        validation_alias="text_config"
    )
    vision: Annotated[
        InstanceOf[SiglipVisionConfig], part(SiglipVisionConfig.from_dict, "siglip_vision_model")
    ] = Field(validation_alias="vision_config")
    depth: Annotated[InstanceOf[ZoeDepthConfig] | None, part(ZoeDepthConfig.from_dict, "zoedepth")] = Field(
        default=None, validation_alias="vision_zoe_config"
    )
    projected: Count = Field(validation_alias="projection_dim")
    image_token: Index = Field(validation_alias="image_token_index")
    first_action: Index = Field(validation_alias="action_token_begin_idx")
    actions: Count = Field(validation_alias="spatial_token_num")
    own_action_embeddings: bool = Field(default=False, validation_alias="use_spatial_token")
    points: Count = Field(default=1, validation_alias="ego3d_patch_reso")
    frequencies: Count = Field(default=8, validation_alias="n_freqs")
    beginning: Index = Field(default=2, validation_alias="bos_token_id")
    padding: Index = Field(default=0, validation_alias="pad_token_id")
    dtype: str | None = STORED_TYPE

    @property
    def side(self) -> int:
        """Side of the square picture the model sees, in pixels."""
        return int(self.vision.image_size)

    @property
    def patches(self) -> int:
        """Patches of one picture."""
        return (self.side // int(self.vision.patch_size)) ** 2

    @model_validator(mode="before")
    @classmethod
    def _depth_is_seen_or_not(cls, values: dict[str, Any]) -> dict[str, Any]:
        if not values.get("use_vision_zoe", True):
            return {name: value for name, value in values.items() if name != "vision_zoe_config"}
        if missing := [name for name in _DEPTH if values.get(name) is None]:
            raise ValueError(f"{', '.join(missing)} is missing")
        return values

    @model_validator(mode="after")
    def _fits(self) -> Self:
        width, vocabulary = int(self.text.hidden_size), int(self.text.vocab_size)
        last, patch = self.first_action + self.actions, int(self.vision.patch_size)
        wrong = {
            f"projection_dim {self.projected} is not the language model's width {width}": self.projected != width,
            f"action ids end at {last}, the vocabulary at {vocabulary}": last != vocabulary,
            f"image_token_index {self.image_token} is an action": self.image_token >= self.first_action,
            f"{self.points} points do not divide a patch of {patch} pixels": patch % self.points != 0,
            "text_config ties the output layer to the embeddings": self.text.tie_word_embeddings,
        }
        if contradictions := [sentence for sentence, is_wrong in wrong.items() if is_wrong]:
            raise ValueError("; ".join(contradictions))
        return self
