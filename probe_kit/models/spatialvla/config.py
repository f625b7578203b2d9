"""The `config.json` of a SpatialVLA checkpoint.

The three networks inside are described as transformers describes them; what their parts leave out is transformers'
default, as it was when the file was written.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transformers import Gemma2Config, SiglipVisionConfig, ZoeDepthConfig

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError

MODEL_TYPE = "spatialvla"
_PARTS = {"text_config": "gemma2", "vision_config": "siglip_vision_model", "vision_zoe_config": "zoedepth"}
_REQUIRED = ("image_token_index", "projection_dim")
_DEPTH = ("vision_zoe_config", "ego3d_patch_reso")
_ACTIONS = ("action_token_begin_idx", "spatial_token_num")


@dataclass(frozen=True)
class SpatialVLAConfig:
    """A checkpoint's configuration.

    text, vision, depth: transformers' configurations of Gemma-2, SigLIP and ZoeDepth; depth is None for a model
    that sees none. image_token: the id whose positions the picture takes. first_action, actions: the ids that name
    actions; they end the vocabulary. own_action_embeddings: whether those ids have a table of embeddings to
    themselves. points: 3-D points per patch and direction. frequencies: of their code. dtype: as stored, None if
    the file does not say.
    """

    text: Any
    vision: Any
    depth: Any | None
    image_token: int
    first_action: int
    actions: int
    own_action_embeddings: bool
    points: int
    frequencies: int
    beginning: int
    padding: int
    dtype: str | None

    @property
    def side(self) -> int:
        """Side of the square picture the model sees, in pixels."""
        return int(self.vision.image_size)

    @property
    def patches(self) -> int:
        """Patches of one picture."""
        return (self.side // int(self.vision.patch_size)) ** 2

    @classmethod
    def from_folder(cls, folder: Path) -> "SpatialVLAConfig":
        """Read `folder/config.json`. Raises CheckpointError if it is missing or describes another model."""
        file = folder / "config.json"
        if not file.is_file():
            raise CheckpointError(f"{file} is missing; {folder} is not a SpatialVLA checkpoint")
        return cls.from_json(load_json(file), str(file))

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "config") -> "SpatialVLAConfig":
        """Read the content of a `config.json`. Raises CheckpointError naming `source`."""
        if (model_type := values.get("model_type")) != MODEL_TYPE:
            raise CheckpointError(
                f"{source} holds a {model_type!r} model; expected {MODEL_TYPE}. Pass the right --model"
            )
        sees_depth = bool(values.get("use_vision_zoe", True))
        needed = (*_REQUIRED, *_ACTIONS, *(_DEPTH if sees_depth else ()), "text_config", "vision_config")
        if missing := [name for name in needed if values.get(name) is None]:
            raise CheckpointError(
                f"{source} lacks {', '.join(missing)}; copy the file from the model's page again"
            )
        config = cls(
            text=Gemma2Config.from_dict(_part(values, "text_config", source)),
            vision=SiglipVisionConfig.from_dict(_part(values, "vision_config", source)),
            depth=ZoeDepthConfig.from_dict(_part(values, "vision_zoe_config", source)) if sees_depth else None,
            image_token=int(values["image_token_index"]),
            first_action=int(values["action_token_begin_idx"]),
            actions=int(values["spatial_token_num"]),
            own_action_embeddings=bool(values.get("use_spatial_token", False)),
            points=int(values.get("ego3d_patch_reso") or 1),
            frequencies=int(values.get("n_freqs", 8)),
            beginning=int(values.get("bos_token_id", 2)),
            padding=int(values.get("pad_token_id") or 0),
            dtype=values.get("torch_dtype") or values.get("dtype"),
        )
        config._check_contradictions(int(values["projection_dim"]), source)
        return config

    def _check_contradictions(self, projected: int, source: str) -> None:
        width, vocabulary = int(self.text.hidden_size), int(self.text.vocab_size)
        last, patch = self.first_action + self.actions, int(self.vision.patch_size)
        wrong = {
            f"projection_dim {projected} is not the language model's width {width}": projected != width,
            f"action ids end at {last}, the vocabulary at {vocabulary}": last != vocabulary,
            f"image_token_index {self.image_token} is an action": self.image_token >= self.first_action,
            f"{self.points} points do not divide a patch of {patch} pixels": patch % self.points != 0,
            "text_config ties the output layer to the embeddings": self.text.tie_word_embeddings,
        }
        if contradictions := [sentence for sentence, is_wrong in wrong.items() if is_wrong]:
            raise CheckpointError(f"{source}: {'; '.join(contradictions)}. No released SpatialVLA is like this")


def _part(values: Mapping[str, Any], name: str, source: str) -> dict[str, Any]:
    stored, expected = dict(values[name]), _PARTS[name]
    model_type = stored.setdefault("model_type", expected)
    if model_type != expected:
        raise CheckpointError(f"{source}: {name} describes a {model_type} model; expected {expected}")
    return stored
