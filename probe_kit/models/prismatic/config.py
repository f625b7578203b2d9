"""The `config.json` of a Prismatic or OpenVLA checkpoint.

The file names parts of a fixed table (Karamcheti et al. 2024, and OpenVLA's `PrismaticConfig`); explicit fields
win over the table. The language model's part is short: what it leaves out is transformers' default, which has
rms_norm_eps 1e-6 for Llama, not Llama-2's own 1e-5. A training run's file, as TRI-ML releases it, has these fields
under `model` and no part for the language model; that is then the published one, with its own 1e-5.
"""

from collections.abc import Mapping
from typing import Any, Self

from pydantic import Field
from transformers import CONFIG_MAPPING

from probe_kit.errors import CheckpointError
from probe_kit.models.config_file import ConfigFile, Count, Index

_DINO = "vit_large_patch14_reg4_dinov2.lvd142m"
_CLIP = ("vit_large_patch14_clip_224.openai", 224, "quick_gelu")
_CLIP_336 = ("vit_large_patch14_clip_336.openai", 336, "quick_gelu")
# Per vision id: (timm id, image side, activation instead of timm's own) of each tower.
_TOWERS: dict[str, tuple[tuple[str, int, str | None], ...]] = {
    "clip-vit-l": (_CLIP,),
    "clip-vit-l-336px": (_CLIP_336,),
    "siglip-vit-so400m": (("vit_so400m_patch14_siglip_224", 224, None),),
    "siglip-vit-so400m-384px": (("vit_so400m_patch14_siglip_384", 384, None),),
    "dinov2-vit-l": ((_DINO, 224, None),),
    "in1k-vit-l": (("vit_large_patch16_224.augreg_in21k_ft_in1k", 224, None),),
    "dinoclip-vit-l-336px": ((_DINO, 336, None), _CLIP_336),
    "dinosiglip-vit-so-224px": ((_DINO, 224, None), ("vit_so400m_patch14_siglip_224", 224, None)),
    "dinosiglip-vit-so-384px": ((_DINO, 384, None), ("vit_so400m_patch14_siglip_384", 384, None)),
}
# Per language id: transformers' model type.
_LANGUAGE = {
    "llama2-7b-pure": "llama",
    "llama2-13b-pure": "llama",
    "llama2-7b-chat": "llama",
    "llama2-13b-chat": "llama",
    "vicuna-v15-7b": "llama",
    "vicuna-v15-13b": "llama",
    "mistral-v0.1-7b-pure": "mistral",
    "mistral-v0.1-7b-instruct": "mistral",
    "phi-2-3b": "phi",
}
_LLAMA = {"vocab_size": 32064, "pad_token_id": 32000, "rms_norm_eps": 1e-5, "max_position_embeddings": 4096}
_SIZE_13B = {
    "hidden_size": 5120,
    "intermediate_size": 13824,
    "num_hidden_layers": 40,
    "num_attention_heads": 40,
    "num_key_value_heads": 40,
}
_MISTRAL = {
    "vocab_size": 32064,
    "pad_token_id": 32000,
    "max_position_embeddings": 32768,
    "rms_norm_eps": 1e-5,
    "sliding_window": 4096,
}
_PHI = {
    "vocab_size": 50304,
    "pad_token_id": 50295,
    "bos_token_id": 50256,
    "eos_token_id": 50256,
    "hidden_size": 2560,
    "intermediate_size": 10240,
    "num_hidden_layers": 32,
    "num_attention_heads": 32,
    "partial_rotary_factor": 0.4,
}
# Per transformers' model type: the published language model, with the padding that training added.
_PUBLISHED: Mapping[str, Mapping[str, Any]] = {"llama": _LLAMA, "mistral": _MISTRAL, "phi": _PHI}
# Where the files of their tokenizers are; Llama 2's own repository is gated, OpenVLA's copy of it is not.
_TOKENIZERS = {"llama": "openvla/openvla-7b", "mistral": "mistralai/Mistral-7B-v0.1", "phi": "microsoft/phi-2"}
RESIZE_STRATEGIES = ("resize-naive", "letterbox", "resize-crop")


class TowerConfig(ConfigFile):
    """One vision tower: a timm id, the side of its square input in pixels, and changes to timm's constructor."""

    timm_id: str
    image_size: Count
    act_layer: str | None = None
    overrides: dict[str, Any]


class PrismaticConfig(ConfigFile):
    """A checkpoint's configuration.

    towers: one, or two whose patch features are joined (`fused`). text: transformers' configuration of the
    language model. padded: rows of the embedding without a text id.
    empty_token: the id that ends every OpenVLA prompt. dtype: as stored, None if the file does not say.
    statistics: per data set, what un-normalises its actions. tokenizer_id: hub id of the tokenizer's files, of a
    training run, whose folder has none; None for checkpoints that come with theirs.
    """

    model_types = ("prismatic", "openvla")
    network = "Prismatic or OpenVLA"

    model_type: str
    vision_id: str
    language_id: str
    towers: tuple[TowerConfig, ...]
    resize: str
    text: Any
    padded: Index = Field(default=64, validation_alias="pad_to_multiple_of")
    action_bins: Count = Field(default=256, validation_alias="n_action_bins")
    empty_token: Index = Field(default=29871, validation_alias="empty_token_id")
    dtype: str | None = None
    statistics: dict[str, Any]
    tokenizer_id: str | None = None

    @property
    def action_vocabulary(self) -> int:
        """Text ids below the embedding's padding; the last ones name action bins."""
        return int(self.text.vocab_size) - self.padded

    @property
    def fused(self) -> bool:
        """Whether two towers look at the picture."""
        return len(self.towers) == 2

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "config") -> Self:
        """Read the content of a `config.json`. Raises CheckpointError naming `source`."""
        if (run := values.get("model")) is not None:
            if not isinstance(run, Mapping):
                raise CheckpointError(f"{source} has no fields under `model`; download the checkpoint again")
            config = cls.from_json(_of_run(run, source), source)
            return config.model_copy(update={"tokenizer_id": _TOKENIZERS[config.text.model_type]})
        return super().from_json(values, source)

    @classmethod
    def read(cls, values: Mapping[str, Any], source: str) -> Self:
        """Read the fields, and those of the table. Raises CheckpointError."""
        vision = values.get("vision_backbone_id", "siglip-vit-so400m")
        language = values.get("llm_backbone_id", "vicuna-v15-7b")
        resize = values.get("image_resize_strategy", "letterbox")
        for name, value, supported in (
            ("vision_backbone_id", vision, _TOWERS),
            ("llm_backbone_id", language, _LANGUAGE),
            ("image_resize_strategy", resize, RESIZE_STRATEGIES),
        ):
            if value not in supported:
                raise CheckpointError(f"{source}: {name} {value!r} is not one of {', '.join(supported)}")
        text = _text_config(values, _LANGUAGE[language], source)
        return super().read(
            {
                "model_type": values["model_type"],
                "vision_id": vision,
                "language_id": language,
                "towers": _towers(values, vision, source),
                "resize": resize,
                "text": text,
                **{name: values.get(name) for name in ("pad_to_multiple_of", "n_action_bins", "empty_token_id")},
                "dtype": values.get("torch_dtype") or values.get("dtype"),
                "statistics": values.get("norm_stats") or {},
            },
            source,
        )


def _of_run(run: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The fields of a training run in the words of a checkpoint. Raises CheckpointError for another projector."""
    vision, language = str(run.get("vision_backbone_id")), str(run.get("llm_backbone_id"))
    projector = str(run.get("arch_specifier", "gelu-mlp")).removeprefix("no-align+")
    expected = "fused-gelu-mlp" if len(_TOWERS.get(vision, ())) == 2 else "gelu-mlp"
    if projector != expected:
        raise CheckpointError(f"{source}: arch_specifier is {projector!r}; expected {expected} for {vision}")
    text = {**_PUBLISHED.get(_LANGUAGE.get(language, ""), {}), **(_SIZE_13B if "-13b" in language else {})}
    return {
        "torch_dtype": "bfloat16",
        **{name: value for name, value in run.items() if name not in ("type", "model")},
        "model_type": "prismatic",
        "text_config": {**text, **(run.get("text_config") or {})},
    }


def _towers(values: Mapping[str, Any], vision: str, source: str) -> list[dict[str, Any]]:
    defaults = _TOWERS[vision]
    count = len(defaults)
    columns: list[list[Any]] = [
        values.get("timm_model_ids") or [timm_id for timm_id, _, _ in defaults],
        values.get("image_sizes") or [size for _, size, _ in defaults],
        values.get("timm_override_act_layers") or [act_layer for _, _, act_layer in defaults],
        values.get("timm_model_overrides") or [{}] * count,
    ]
    fused = values.get("use_fused_vision_backbone")
    if {len(column) for column in columns} != {count} or (fused is not None and fused != (count == 2)):
        raise CheckpointError(
            f"{source}: {vision} has {count} vision tower(s), but the fields that describe them "
            "(timm_model_ids, image_sizes, timm_override_act_layers, use_fused_vision_backbone) say otherwise"
        )
    names = ("timm_id", "image_size", "act_layer", "overrides")
    return [dict(zip(names, tower, strict=True)) for tower in zip(*columns, strict=True)]


def _text_config(values: Mapping[str, Any], model_type: str, source: str) -> Any:
    # Its own precision would win over the one that is asked for.
    ignored = ("dtype", "torch_dtype")
    stored = {name: value for name, value in (values.get("text_config") or {}).items() if name not in ignored}
    stored_type = stored.setdefault("model_type", model_type)
    if stored_type != model_type:
        raise CheckpointError(
            f"{source}: llm_backbone_id {values.get('llm_backbone_id')!r} is a {model_type} model, "
            f"but text_config describes a {stored_type} model"
        )
    return CONFIG_MAPPING[model_type].from_dict(stored)
