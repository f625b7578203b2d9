"""Prismatic vision-language models and OpenVLA, in plain torch, timm and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is. Capture and
actions are in the adapters `prismatic` and `openvla` in `probe_kit.hooks.families`.

`config.json` names parts of a fixed table (Karamcheti et al. 2024, and OpenVLA's `PrismaticConfig`); explicit
fields win over the table. The language model's part is short: fields that it leaves out have transformers'
defaults, which include rms_norm_eps 1e-6 for Llama, not Llama-2's own 1e-5. A training run's file, as TRI-ML
releases it, has these fields under `model` and no part for the language model. That is then the published one,
with its own 1e-5.

Images become pixel values bit-identical to the original processor's, with PIL and numpy only. Tower k reads
channels 3k … 3k+2: the same pixels, resized to its side and normalised with its own means.

B batch, P patches, T text tokens, S = P + T positions, D width of the language model, V its vocabulary. Image
patches follow the first token.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field
from torch import Tensor, nn
from torchvision.transforms.v2 import InterpolationMode, functional
from transformers import CONFIG_MAPPING, AutoModelForCausalLM

from probe_kit._system.imports import require
from probe_kit.errors import CheckpointError
from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.checkpoint_files import PictureValues, picture_values
from probe_kit.models.config_file import ConfigFile, Count, Index
from probe_kit.models.decoding import Choose, Decoded, PromptKV, TokenNetwork, greedy

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
    """A vision tower: a timm id, the side of its square input in pixels, and changes to timm's constructor."""

    timm_id: str
    image_size: Count
    act_layer: str | None = None
    overrides: dict[str, Any]


class PrismaticConfig(ConfigFile):
    """A checkpoint's configuration.

    Attributes:
        towers: One tower, or two whose patch features are joined (`fused`).
        text: Transformers' configuration of the language model.
        padded: Rows of the embedding without a text id.
        empty_token: The id that ends every OpenVLA prompt.
        dtype: Type in which weights are stored; None if the file does not say.
        statistics: Statistics that un-normalise actions, per data set.
        tokenizer_id: Hub id of the tokenizer's files, of a training run, whose folder has none; None for
            checkpoints that come with theirs.
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
        """The number of text ids below the embedding's padding; the last ones name action bins."""
        return int(self.text.vocab_size) - self.padded

    @property
    def fused(self) -> bool:
        """Whether two towers look at the picture."""
        return len(self.towers) == 2

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "config") -> Self:
        """Read the content of a `config.json`.

        Raises:
            CheckpointError: For another model, and for fields that `read` refuses; the message names `source`.
        """
        if (run := values.get("model")) is not None:
            if not isinstance(run, Mapping):
                raise CheckpointError(f"{source} has no fields under `model`; download the checkpoint again")
            config = cls.from_json(_fields_of_run(run, source), source)
            return config.model_copy(update={"tokenizer_id": _TOKENIZERS[config.text.model_type]})
        return super().from_json(values, source)

    @classmethod
    def read(cls, values: Mapping[str, Any], source: str) -> Self:
        """Read the fields, and those of the table.

        Raises:
            CheckpointError: For a name that is not in the table, for parts that contradict it, and for a field
                that is missing, of another type, or out of bounds.
        """
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


def _fields_of_run(run: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the fields of a training run under the names of a checkpoint.

    Raises:
        CheckpointError: For another projector.
    """
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


# -- vision towers --------------------------------------------------------------------------------------------


class LayerScale(nn.Module):
    """The layer scale of timm under the name the released files have: `scale_factor` instead of `gamma`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, features: Tensor) -> Tensor:
        """Return the features (…, width), scaled per feature."""
        return features * self.scale_factor


class VisionBackbone(nn.Module):
    """The vision tower, or two towers whose features are joined."""

    def __init__(self, towers: tuple[TowerConfig, ...]) -> None:
        super().__init__()
        self.featurizer = _tower(towers[0])
        if len(towers) == 2:
            self.fused_featurizer = _tower(towers[1])

    @property
    def towers(self) -> list[Any]:
        """The timm models in the order of their channels."""
        second = getattr(self, "fused_featurizer", None)
        return [self.featurizer] if second is None else [self.featurizer, second]

    @property
    def width(self) -> int:
        """The number of features per patch."""
        return sum(int(tower.embed_dim) for tower in self.towers)

    def forward(self, pixel_values: Tensor) -> Tensor:
        """Return the patch features (B, P, width) of pictures (B, 3 per tower, S, S).

        They hold neither class nor register tokens, and pass no norm.
        """
        parts = torch.split(pixel_values, 3, dim=1)
        features = [
            tower.get_intermediate_layers(part, n=[len(tower.blocks) - 2])[0]
            for tower, part in zip(self.towers, parts, strict=True)
        ]
        return torch.cat(features, dim=2)


def _tower(config: TowerConfig) -> Any:
    timm = require("timm", "openvla")
    tower = timm.create_model(
        config.timm_id,
        pretrained=False,
        num_classes=0,
        img_size=config.image_size,
        act_layer=config.act_layer,
        **config.overrides,
    )
    for block in tower.blocks:
        for name in ("ls1", "ls2"):
            if not isinstance(getattr(block, name), nn.Identity):
                setattr(block, name, LayerScale(int(tower.embed_dim)))
    return tower


# -- the network ----------------------------------------------------------------------------------------------


class Projector(nn.Module):
    """The map of patch features to the language model's width: two layers for one tower, three for two."""

    def __init__(self, vision_width: int, width: int, fused: bool) -> None:
        super().__init__()
        hidden = 4 * vision_width if fused else width
        self.fc1 = nn.Linear(vision_width, hidden)
        self.fc2 = nn.Linear(hidden, width)
        self.fc3 = nn.Linear(width, width) if fused else None

    def forward(self, patches: Tensor) -> Tensor:
        """Return the patches in the language model's width, (B, P, D) from (B, P, vision width)."""
        projected: Tensor = self.fc2(nn.functional.gelu(self.fc1(patches)))
        return projected if self.fc3 is None else self.fc3(nn.functional.gelu(projected))


class PrismaticNetwork(TokenNetwork):
    """A Prismatic model under the parameter names of its released files."""

    def __init__(self, config: PrismaticConfig) -> None:
        super().__init__()
        self.config = config
        self.vision_backbone = VisionBackbone(config.towers)
        self.projector = Projector(self.vision_backbone.width, config.text.hidden_size, config.fused)
        self.language_model: Any = AutoModelForCausalLM.from_config(config.text, trust_remote_code=False)
        self.prompt_kv = PromptKV(int(config.text.num_hidden_layers))

    @property
    def patches(self) -> int:
        """The number P of patches."""
        return int(self.vision_backbone.featurizer.patch_embed.num_patches)

    def embed(self, ids: Tensor, mask: Tensor, pixel_values: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return embeddings (B, S, D) and mask (B, S); without a picture S is T."""
        embeddings: Tensor = self.language_model.get_input_embeddings()(ids)
        if pixel_values is None:
            return embeddings, mask
        patches = self.projector(self.vision_backbone(pixel_values.to(embeddings.dtype)))
        patch_mask = torch.ones(patches.shape[:2], dtype=mask.dtype, device=mask.device)
        return (
            torch.cat([embeddings[:, :1], patches, embeddings[:, 1:]], dim=1),
            torch.cat([mask[:, :1], patch_mask, mask[:, 1:]], dim=1),
        )

    def forward(self, ids: Tensor, mask: Tensor, pixel_values: Tensor | None) -> Any:
        """Return the output of transformers for one pass, with logits (B, S, V) and all hidden states.

        Args:
            ids: (B, T) text ids.
            mask: (B, T) bool, False at padding, which may stand anywhere behind the first token.
            pixel_values: (B, 3 per tower, S, S) pictures; None without.
        """
        return self.whole_pass(*self.embed(ids, mask, pixel_values))

    def decode(
        self, ids: Tensor, mask: Tensor, pixel_values: Tensor | None, steps: int, choose: Choose = greedy
    ) -> Decoded:
        """Return exactly `steps` tokens behind the prompt; see `decode_behind`.

        Args:
            ids: (B, T) text ids.
            mask: (B, T) bool, False at padding; every row ends with a token, not padding.
            pixel_values: (B, 3 per tower, S, S) pictures; None without.
            steps: Number of tokens.
            choose: Function from logits (B, V) to the next ids (B,); the likeliest by default.
        """
        return self.decode_behind(*self.embed(ids, mask, pixel_values), steps, choose)


def build_prismatic(config: PrismaticConfig, dtype: torch.dtype, device: str = "meta") -> PrismaticNetwork:
    """Return the network in eval mode; see `build_empty`."""
    network = build_empty(lambda: PrismaticNetwork(config), dtype, device)
    fill_decoder_rotary(network.language_model.model)
    network.language_model.tie_weights()
    return network.eval()


def full_size_openvla() -> PrismaticNetwork:
    """Return OpenVLA-7B on the meta device."""
    return _full_size("openvla", "dinosiglip-vit-so-224px", "llama2-7b-pure")


def full_size_prismatic() -> PrismaticNetwork:
    """Return Prismatic 7B with the fused towers on the meta device."""
    return _full_size("prismatic", "dinosiglip-vit-so-224px", "llama2-7b-pure")


def _full_size(model_type: str, vision: str, language: str) -> PrismaticNetwork:
    config = PrismaticConfig.from_json(
        {
            "model_type": model_type,
            "vision_backbone_id": vision,
            "llm_backbone_id": language,
            "text_config": {"vocab_size": 32064, "pad_token_id": 32000},
        }
    )
    return build_prismatic(config, torch.bfloat16)


# -- pictures -------------------------------------------------------------------------------------------------

Colour = tuple[float, float, float]
_RESAMPLING = {"bicubic": Image.Resampling.BICUBIC, "bilinear": Image.Resampling.BILINEAR}
# Fine-tunes with augmentation saw random crops of nine tenths of the area; their evaluation takes the middle one.
CROP_AREA = 0.9


@dataclass(frozen=True)
class PictureSettings:
    """The preparation of pictures: per tower its side, colour means, deviations and resampling."""

    strategy: str
    sides: tuple[int, ...]
    means: tuple[Colour, ...]
    deviations: tuple[Colour, ...]
    resampling: tuple[str, ...]

    @classmethod
    def of(cls, config: PrismaticConfig, folders: Path | Sequence[Path]) -> "PictureSettings":
        """Read the settings of pictures in the first of `folders` that has any; without, those of timm's towers.

        Raises:
            CheckpointError: For a preparation that is not known here, or that contradicts the configuration.
        """
        stored = picture_values(folders)
        settings = cls._from_timm(config) if stored is None else cls._from_values(stored)
        source = "timm" if stored is None else stored.source
        unknown = {*settings.resampling} - {*_RESAMPLING} | {settings.strategy} - {*RESIZE_STRATEGIES}
        if unknown:
            raise CheckpointError(
                f"{source}: pictures are prepared with {', '.join(sorted(unknown))}, unknown here"
            )
        if settings.sides != (sides := tuple(tower.image_size for tower in config.towers)):
            raise CheckpointError(f"{source} makes pictures of side {settings.sides}; config.json expects {sides}")
        return settings

    @classmethod
    def _from_values(cls, stored: PictureValues) -> "PictureSettings":
        values = stored.values
        needed = ("image_resize_strategy", "input_sizes", "means", "stds", "interpolations")
        if missing := [name for name in needed if values.get(name) is None]:
            raise CheckpointError(f"{stored.source} lacks {', '.join(missing)}; it does not belong to Prismatic")
        return cls(
            values["image_resize_strategy"],
            tuple(int(size[-1]) for size in values["input_sizes"]),
            tuple(map(_colour, values["means"])),
            tuple(map(_colour, values["stds"])),
            tuple(values["interpolations"]),
        )

    @classmethod
    def _from_timm(cls, config: PrismaticConfig) -> "PictureSettings":
        cards = [require("timm", "openvla").get_pretrained_cfg(tower.timm_id) for tower in config.towers]
        return cls(
            config.resize,
            tuple(tower.image_size for tower in config.towers),
            tuple(_colour(card.mean) for card in cards),
            tuple(_colour(card.std) for card in cards),
            tuple(card.interpolation for card in cards),
        )


def _colour(values: list[float]) -> Colour:
    red, green, blue = values
    return red, green, blue


def prepare_picture(picture: NDArray[np.uint8], settings: PictureSettings) -> NDArray[np.float32]:
    """Return a picture (H, W, 3) uint8 as (3 per tower, S, S) float32."""
    image = Image.fromarray(picture)
    if settings.strategy == "letterbox":
        # The original loops over the towers and keeps the last one's colour; the padding is the same for all.
        image = _padded_to_square(image, settings.means[-1])
    fit = _squeeze if settings.strategy == "resize-naive" else _scaled_and_cropped
    towers = zip(settings.sides, settings.means, settings.deviations, settings.resampling, strict=True)
    return np.concatenate([_for_tower(image, fit, *tower) for tower in towers])


def _for_tower(
    image: Image.Image,
    fit: Callable[[Image.Image, int, Image.Resampling], Image.Image],
    side: int,
    mean: Colour,
    deviation: Colour,
    resampling: str,
) -> NDArray[np.float32]:
    pixels = np.asarray(fit(image, side, _RESAMPLING[resampling]), np.float32) / np.float32(255)
    normalised = (pixels - np.asarray(mean, np.float32)) / np.asarray(deviation, np.float32)
    return np.asarray(normalised.transpose(2, 0, 1), np.float32)


def _squeeze(image: Image.Image, side: int, resampling: Image.Resampling) -> Image.Image:
    return image.resize((side, side), resampling)


def _scaled_and_cropped(image: Image.Image, side: int, resampling: Image.Resampling) -> Image.Image:
    """Scale the shorter side to `side` and keep the middle of the longer one, with the rounding of torchvision."""
    width, height = image.size
    if width <= height:
        width, height = side, int(side * height / width)
    else:
        width, height = int(side * width / height), side
    column, top = round((width - side) / 2), round((height - side) / 2)
    scaled = image if image.size == (width, height) else image.resize((width, height), resampling)
    return scaled.crop((column, top, column + side, top + side))


def _padded_to_square(image: Image.Image, mean: Colour) -> Image.Image:
    """Centre the image on the mean colour; a pixel short of square where the sides differ by an odd number."""
    longer = max(image.size)
    column, top = ((longer - side) // 2 for side in image.size)
    red, green, blue = (int(255 * value) for value in mean)
    square = Image.new("RGB", (image.width + 2 * column, image.height + 2 * top), (red, green, blue))
    square.paste(image, (column, top))
    return square


def centre_crop(picture: NDArray[np.uint8], side: int, area: float = CROP_AREA) -> NDArray[np.uint8]:
    """Return the middle `area` of a picture (H, W, 3) uint8 as (side, side, 3) uint8, both sides scaled by √area.

    Sampling is bilinear between pixel centres, corners on corners, as in TensorFlow's `crop_and_resize`.
    """
    factor = np.float32(np.sqrt(area))
    rows, columns = (_samples(extent, side, factor) for extent in picture.shape[:2])
    pixels = picture.astype(np.float32) / np.float32(255)
    cropped = _interpolate(_interpolate(pixels, rows, 0), columns, 1)
    return (np.clip(cropped, 0, 1) * np.float32(255.5)).astype(np.uint8)


def _samples(extent: int, side: int, factor: np.float32) -> NDArray[np.float32]:
    """Return the places (side,) at which to sample an axis of `extent` pixels."""
    start = (1 - factor) / 2 * (extent - 1)
    step = factor * (extent - 1) / max(1, side - 1)
    return np.asarray(start + np.arange(side) * step, np.float32)


def _interpolate(pixels: NDArray[np.float32], places: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    low = np.floor(places).astype(np.intp)
    high = np.minimum(low + 1, pixels.shape[axis] - 1)
    shape = [1] * pixels.ndim
    shape[axis] = -1
    share = (places - low).reshape(shape)
    below, above = pixels.take(low, axis), pixels.take(high, axis)
    return np.asarray(below + (above - below) * share, np.float32)


# -- pictures as tensors --------------------------------------------------------------------------------------

_MODES = {"bicubic": InterpolationMode.BICUBIC, "bilinear": InterpolationMode.BILINEAR}


def prepare_tensor(picture: NDArray[np.uint8], settings: PictureSettings) -> NDArray[np.float32]:
    """Return a picture (H, W, 3) uint8 as (3 per tower, S, S) float32.

    It is computed in bfloat16 up to the end: resized with antialiasing, then normalised.

    Raises:
        CheckpointError: For a checkpoint that does not squeeze its pictures.
    """
    if settings.strategy != "resize-naive":
        raise CheckpointError(
            f"this checkpoint prepares pictures by {settings.strategy!r}; -M resize=tensor is that of checkpoints "
            "with resize-naive. Leave it out"
        )
    pixels = torch.from_numpy(picture.copy()).permute(2, 0, 1).to(torch.bfloat16) / 255
    towers = zip(settings.sides, settings.means, settings.deviations, settings.resampling, strict=True)
    rows: list[Tensor] = []
    for side, mean, deviation, resampling in towers:
        resized = functional.resize(pixels, [side, side], _MODES[resampling], antialias=True)
        centre, spread = (
            torch.tensor(values, dtype=torch.bfloat16)[:, None, None] for values in (mean, deviation)
        )
        rows.append((resized - centre) / spread)
    prepared: NDArray[np.float32] = torch.cat(rows).float().numpy()
    return prepared
