"""The model Magma, in plain torch, timm and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is. Capture and
actions are in its adapter in `probe_kit.hooks`.

In `config.json`, `text_config` is the language model's; where the file has none, its top level repeats the same
fields. `vision_config` is a plain dictionary; for fields that it leaves out the trunk's own values count.

Pictures become crops bit-identical to the original processor's. Colours are normalised first; then the picture is
stretched, aspect not kept, to the grid of square crops that shows most of its pixels, without antialiasing.

The wording of prompts is that of the authors' evaluation client, microsoft/Magma at 0483f87,
`tools/simplerenv-magma/simpler_env/policies/magma/magma_model.py`.

B batch, S positions or side of a crop, D width of the language model, V its vocabulary, N pictures' crops, (h, w)
the map of a picture.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field, InstanceOf, model_validator
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM
from transformers.utils.chat_template_utils import render_jinja_template

from probe_kit._system.bounded_files import load_json
from probe_kit._system.imports import require
from probe_kit.errors import CheckpointError
from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.checkpoint_files import picture_values
from probe_kit.models.config_file import STORED_TYPE, ConfigFile, Count, Index, part
from probe_kit.models.decoding import Choose, Decoded, PromptKV, TokenNetwork, greedy, last_logits, pack_rows

# Older checkpoints append the number of trace tokens; the modules are the same.
_PROJECTOR = re.compile(r"mlp(?P<layers>[1-9]\d?)x_gelu(_segtokv\d+)?")


class VisionConfig(ConfigFile):
    """The trunk, its projector, and how crops are put together.

    Attributes:
        trunk: Name of the trunk in timm.
        head_width: Width of the contrastive head that the forward pass never reads.
        strategy: `crop` runs the trunk on every crop, `global` on the whole picture that the crops make up.
        base: Side of a crop in pixels.
        crops: The most crops of one picture.
        width: Width of the language model; None where only its own configuration says.
        separators: Whether the projector holds vectors for the begin and end of a picture, which the forward pass
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
        """The number of linear layers of the projector."""
        match = _PROJECTOR.fullmatch(self.projector)
        assert match is not None
        return int(match["layers"])


class MagmaConfig(ConfigFile):
    """A checkpoint's configuration.

    Attributes:
        text: Transformers' configuration of the language model.
        image_token: The id that a picture replaces.
        image_start_end: Whether the prompt wraps a picture in two tokens.
        base_vocabulary: Number of text ids before the added tokens, None if only the tokenizer knows.
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
    """Return the quantiles that un-normalise actions, per data set; `magma_statistics.json` names their source.

    No checkpoint holds them: the evaluation's client has them in its code.
    """
    return dict(load_json(Path(__file__).parent / "magma_statistics.json")["norm_stats"])


# -- pictures -------------------------------------------------------------------------------------------------

Colour = tuple[float, float, float]
# CLIP's (Radford et al. 2021), the defaults of Magma's image processor.
_MEAN: Colour = (0.48145466, 0.4578275, 0.40821073)
_DEVIATION: Colour = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True)
class Grid:
    """The crops of a picture: rows from top to bottom, columns from left to right."""

    rows: int
    columns: int


@dataclass(frozen=True)
class MagmaPicture:
    """A prepared picture: crops (rows · columns, 3, S, S) float32 in raster order."""

    crops: Tensor
    grid: Grid


@dataclass(frozen=True)
class PictureSettings:
    """The preparation of pictures.

    Attributes:
        base: Side S of a crop in pixels.
        crops: The most crops of one picture.
        mean: Mean of every colour.
        deviation: Deviation of every colour.
    """

    base: int
    crops: int
    mean: Colour = _MEAN
    deviation: Colour = _DEVIATION

    @classmethod
    def of(cls, vision: VisionConfig, folder: Path) -> "PictureSettings":
        """Read the settings of pictures, see `picture_values`; without any take those of the configuration.

        Recorded references hold the same fields in `action_config.json`.

        Raises:
            CheckpointError: For a file that lacks a field.
        """
        if (stored := picture_values(folder)) is not None:
            return cls.from_json(stored.values, stored.source)
        if (file := folder / "action_config.json").is_file():
            return cls.from_json(load_json(file).get("preprocessor", {}), str(file))
        return cls(vision.base, vision.crops)

    @classmethod
    def from_json(cls, values: dict[str, object], source: str) -> "PictureSettings":
        """Read the content of a `preprocessor_config.json`.

        Raises:
            CheckpointError: For a file that lacks a field; the message names `source`.
        """
        missing = [name for name in ("base_img_size", "num_crops") if name not in values]
        if missing:
            raise CheckpointError(f"{source} lacks {' and '.join(missing)}; it does not belong to Magma")
        return cls(
            int(str(values["base_img_size"])),
            int(str(values["num_crops"])),
            _colour(values.get("image_mean", _MEAN), source),
            _colour(values.get("image_std", _DEVIATION), source),
        )


def _colour(values: object, source: str) -> Colour:
    if not isinstance(values, list | tuple) or len(values) != 3:
        raise CheckpointError(f"{source}: {values!r} is not one number per colour")
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def choose_grid(width: int, height: int, settings: PictureSettings) -> Grid:
    """Return the grid that keeps most of the picture's pixels.

    Among equals it wastes fewest; narrow ones come first.
    """
    grids = [
        Grid(rows, columns)
        for columns in range(1, settings.crops + 1)
        for rows in range(1, settings.crops // columns + 1)
    ]

    def merit(grid: Grid) -> tuple[int, int]:
        wide, high = grid.columns * settings.base, grid.rows * settings.base
        scale = min(wide / width, high / height)
        pixels = min(int(width * scale) * int(height * scale), width * height)
        return pixels, pixels - wide * high

    return max(grids, key=merit)


def shrink_picture(picture: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) uint8 as (side, side, 3) uint8, bicubic: the evaluation client's first step."""
    return np.asarray(Image.fromarray(picture).resize((side, side), Image.Resampling.BICUBIC))


def prepare_picture(picture: NDArray[np.uint8], settings: PictureSettings) -> MagmaPicture:
    """Return the crops of a (H, W, 3) uint8 picture."""
    height, width = picture.shape[:2]
    grid, side = choose_grid(width, height, settings), settings.base
    pixels = torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float().div(255)
    mean, deviation = (torch.tensor(colour)[:, None, None] for colour in (settings.mean, settings.deviation))
    stretched = torch.nn.functional.interpolate(
        pixels.sub(mean).div(deviation)[None],
        size=(grid.rows * side, grid.columns * side),
        mode="bilinear",
        align_corners=False,
    )
    crops = stretched.reshape(3, grid.rows, side, grid.columns, side).permute(1, 3, 0, 2, 4)
    return MagmaPicture(crops.reshape(-1, 3, side, side).contiguous(), grid)


# -- the vision tower -----------------------------------------------------------------------------------------


class ClipVisionModel(nn.Module):
    """A module that holds the trunk under the name it has in the released files."""

    def __init__(self, trunk: Any) -> None:
        super().__init__()
        self.trunk = trunk


class VisionTower(nn.Module):
    """The trunk without its head, which the forward pass never reads."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        trunk = require("timm", "magma").create_model(
            config.trunk, pretrained=False, num_classes=0, **config.overrides
        )
        self.width, self.reduction = int(trunk.num_features), int(trunk.feature_info[-1]["reduction"])
        trunk.head = nn.Identity()
        self.clip_vision_model = ClipVisionModel(trunk)
        if config.feature_width not in (None, self.width):
            raise CheckpointError(
                f"the projector reads {config.feature_width} features (mm_hidden_size), but the trunk "
                f"{config.trunk} puts out {self.width}"
            )

    @property
    def stages(self) -> list[Any]:
        """The trunk's stages, each a module from map to map."""
        return list(self.clip_vision_model.trunk.stages)

    @property
    def stem(self) -> Any:
        """The module that makes the first map."""
        return self.clip_vision_model.trunk.stem

    def forward(self, pixels: Tensor) -> Tensor:
        """Return the maps (N, features, S / reduction, S / reduction) of pictures (N, 3, S, S)."""
        trunk = self.clip_vision_model.trunk
        maps: Tensor = trunk.stages(trunk.stem(pixels))
        return maps


class Projector(nn.Module):
    """The map of features to the language model's width, place by place, and the vector that ends every row."""

    def __init__(self, config: VisionConfig, features: int, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Linear(features, width)]
        for _ in range(1, config.projector_layers):
            layers += [nn.GELU(), nn.Linear(width, width)]
        self.proj = nn.Sequential(*layers)
        self.row_seperator = nn.Parameter(torch.zeros(1, 1, width))  # as the released files spell it
        if config.separators:
            self.img_start_seperator = nn.Parameter(torch.zeros(1, width))
            self.img_end_seperator = nn.Parameter(torch.zeros(1, width))

    def forward(self, maps: Tensor) -> Tensor:
        """Return the features in the language model's width, (…, D) from (…, features)."""
        projected: Tensor = self.proj(maps)
        return projected

    def tokens(self, projected: Tensor) -> Tensor:
        """Return tokens (h · (w + 1), D) from a map (h, w, D): row by row, a separator behind each."""
        separators = self.row_seperator.expand(projected.shape[0], 1, -1)
        return torch.cat([projected, separators], dim=1).flatten(0, 1)


def stitch_crops(crops: Tensor, grid: Grid) -> Tensor:
    """Return the map (rows · a, columns · b, C) of crops (rows · columns, a, b, C) in raster order."""
    high, wide, channels = crops.shape[1:]
    places = crops.reshape(grid.rows, grid.columns, high, wide, channels).transpose(1, 2)
    return places.reshape(grid.rows * high, grid.columns * wide, channels)


def whole_picture(picture: MagmaPicture) -> Tensor:
    """Return the picture that the crops were cut from, (1, 3, rows · S, columns · S)."""
    return stitch_crops(picture.crops.permute(0, 2, 3, 1), picture.grid).permute(2, 0, 1)[None]


def map_size(grid: Grid, side: int, reduction: int, strategy: str) -> tuple[int, int]:
    """Return the size (h, w) of a picture's map; crops that the reduction does not divide each lose their rest."""
    if strategy == "global":
        return grid.rows * side // reduction, grid.columns * side // reduction
    return grid.rows * (side // reduction), grid.columns * (side // reduction)


# -- packing --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PictureSpan:
    """The positions of a picture's tokens in its row: `start`, then `rows` times `columns` and a separator."""

    start: int
    rows: int
    columns: int

    @property
    def length(self) -> int:
        """The number of tokens, separators included."""
        return self.rows * (self.columns + 1)


def placeholder(ids: Sequence[int], image_token: int) -> int:
    """Return the position of the placeholder.

    Raises:
        CheckpointError: Unless there is exactly one.
    """
    places = [position for position, number in enumerate(ids) if number == image_token]
    if len(places) != 1:
        raise CheckpointError(
            f"the prompt has {len(places)} picture placeholders (id {image_token}); expected one. The tokenizer "
            "does not know <image> as one token, or the text itself contains it"
        )
    return places[0]


# -- the network ----------------------------------------------------------------------------------------------

# In the released files and never read: the contrastive head that the trunk was trained with.
UNUSED_WEIGHTS = (
    "vision_tower.clip_vision_model.head.proj.weight",
    "vision_tower.clip_vision_model.trunk.head.norm.bias",
    "vision_tower.clip_vision_model.trunk.head.norm.weight",
)


class MagmaNetwork(TokenNetwork):
    """The network Magma under the parameter names of its released files."""

    def __init__(self, config: MagmaConfig) -> None:
        super().__init__()
        self.config = config
        self.vision_tower = VisionTower(config.vision)
        self.multi_modal_projector = Projector(
            config.vision, self.vision_tower.width, int(config.text.hidden_size)
        )
        self.language_model: Any = LlamaForCausalLM(config.text)
        self.prompt_kv = PromptKV(int(config.text.num_hidden_layers))

    # -- pictures ----------------------------------------------------------------------------------------

    def span(self, ids: Sequence[int], grid: Grid, side: int) -> PictureSpan:
        """Return the positions of the tokens of a picture of `grid` crops of `side` pixels.

        Raises:
            CheckpointError: Unless the prompt has exactly one placeholder.
        """
        rows, columns = map_size(grid, side, self.vision_tower.reduction, self.config.vision.strategy)
        return PictureSpan(placeholder(ids, self.config.image_token), rows, columns)

    def trunk_input(self, picture: MagmaPicture) -> Tensor:
        """Return the trunk's input of a picture: its crops (N, 3, S, S), or all of it (1, 3, H, W)."""
        return whole_picture(picture) if self.config.vision.strategy == "global" else picture.crops

    def look(self, pictures: Sequence[MagmaPicture]) -> list[Tensor]:
        """Return the tokens (h · (w + 1), D) of every picture, a separator at the end of every row of its map."""
        reference = self.multi_modal_projector.row_seperator
        if self.config.vision.strategy == "global":
            maps = [self._projected(self.trunk_input(picture).to(reference))[0] for picture in pictures]
        else:
            crops = self._projected(torch.cat([picture.crops for picture in pictures]).to(reference))
            parts = torch.split(crops, [len(picture.crops) for picture in pictures])
            maps = [stitch_crops(part, picture.grid) for part, picture in zip(parts, pictures, strict=True)]
        return [self.multi_modal_projector.tokens(projected) for projected in maps]

    def _projected(self, pixels: Tensor) -> Tensor:
        """Return the projected maps (N, a, b, D) of pictures or crops."""
        maps: Tensor = self.multi_modal_projector(self.vision_tower(pixels).permute(0, 2, 3, 1))
        return maps

    # -- text --------------------------------------------------------------------------------------------

    def embed(
        self, prompts: Sequence[Sequence[int]], pictures: Sequence[MagmaPicture] | None
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings (B, S, D) and mask (B, S) of prompts, with one placeholder where there is a picture.

        Raises:
            CheckpointError: For a prompt with a picture that has not exactly one placeholder.
        """
        embedding = self.language_model.get_input_embeddings()
        device = embedding.weight.device
        if pictures is None:
            return pack_rows([embedding(torch.tensor(ids, device=device)) for ids in prompts])
        rows = []
        for ids, tokens in zip(prompts, self.look(pictures), strict=True):
            position = placeholder(ids, self.config.image_token)
            before, behind = (torch.tensor(part, device=device) for part in (ids[:position], ids[position + 1 :]))
            rows.append(torch.cat([embedding(before.long()), tokens, embedding(behind.long())]))
        return pack_rows(rows)

    def forward(self, prompts: Sequence[Sequence[int]], pictures: Sequence[MagmaPicture] | None) -> Any:
        """Return the output of transformers for one pass, with logits (B, S, V) and all hidden states."""
        return self.whole_pass(*self.embed(prompts, pictures))

    def decode(
        self,
        prompts: Sequence[Sequence[int]],
        pictures: Sequence[MagmaPicture] | None,
        steps: int,
        choose: Choose = greedy,
    ) -> Decoded:
        """Return exactly `steps` tokens behind the prompts; see `decode_behind`."""
        return self.decode_behind(*self.embed(prompts, pictures), steps, choose)

    def unhooked(self) -> Any:
        """Return a second language model with the same weights and without hooks, so that nothing is captured."""
        with torch.device("meta"):
            twin = LlamaForCausalLM(self.config.text).requires_grad_(False)
        twin.load_state_dict(self.language_model.state_dict(keep_vars=True), strict=True, assign=True)
        twin.model.rotary_emb = self.language_model.model.rotary_emb
        return twin.eval()

    @staticmethod
    def logits_behind(decoded: Decoded, language_model: Any) -> Tensor:
        """Return the logits (B, V) behind the last id, through another language model with the same weights.

        `decoded` cannot be continued afterwards: its cache has grown.
        """
        more = decoded.mask.new_ones(decoded.ids.shape)
        embeddings = language_model.get_input_embeddings()(decoded.ids[:, -1:])
        return last_logits(language_model, embeddings, torch.cat([decoded.mask, more], dim=1), decoded.cache)


def build_magma(config: MagmaConfig, dtype: torch.dtype, device: str = "meta") -> MagmaNetwork:
    """Return the network in eval mode; see `build_empty`.

    Raises:
        CheckpointError: If the parts do not fit together.
    """
    network = build_empty(lambda: MagmaNetwork(config), dtype, device)
    fill_decoder_rotary(network.language_model.model)
    network.language_model.tie_weights()
    return network.eval()


def full_size_magma() -> MagmaNetwork:
    """Return Magma-8B on the meta device."""
    config = MagmaConfig.from_json(
        {
            "model_type": "magma",
            "image_token_index": 128257,
            "text_config": {
                "vocab_size": 128320,
                "hidden_size": 4096,
                "intermediate_size": 14336,
                "num_hidden_layers": 32,
                "num_attention_heads": 32,
                "num_key_value_heads": 8,
                "max_position_embeddings": 8192,
                "rope_theta": 500000.0,
                "rms_norm_eps": 1e-5,
                "bos_token_id": 128000,
                "eos_token_id": 128009,
                "pad_token_id": 128256,
            },
            "vision_config": {"vision_backbone": "convnextxxlarge", "mm_projector_type": "mlp2x_gelu"},
        }
    )
    return build_magma(config, torch.bfloat16)


# -- prompts --------------------------------------------------------------------------------------------------

SYSTEM = "You are agent that can see, talk and act."
ACTION_QUESTION = "What action should the robot take to {instruction}?"
IMAGE, IMAGE_START, IMAGE_END = "<image>", "<image_start>", "<image_end>"
BEGINNING, END_OF_TURN = "<|begin_of_text|>", "<|eot_id|>"
_HEADER = "<|start_header_id|>{role}<|end_header_id|>\n\n"


class Message(NamedTuple):
    """A turn of a conversation: `system`, `user` or `assistant`, and its text."""

    role: str
    content: str


def picture_question(text: str, image_start_end: bool) -> str:
    """Return a user's turn: the picture's placeholder, then `text`."""
    picture = IMAGE_START + IMAGE + IMAGE_END if image_start_end else IMAGE
    return f"{picture}\n{text}"


def conversation(question: str, user_first: bool = False) -> tuple[Message, ...]:
    """Return the system's and the user's turn.

    Args:
        question: Text of the user's turn.
        user_first: Whether the user's turn stands first, as in Act2Answer's release when it asks for several
            actions at once.
    """
    turns = (Message("system", SYSTEM), Message("user", question))
    return turns[::-1] if user_first else turns


def chat_text(messages: Sequence[Message], template: str | None = None, beginning: str = BEGINNING) -> str:
    """Return the text of a conversation, open for the assistant's turn.

    Args:
        messages: Turns in order.
        template: The checkpoint's own template, in Jinja; without one the frames of Llama 3.
        beginning: The tokenizer's first token, which is written out here; the released tokenizer adds another in
            front, as for the original.
    """
    if template is not None:
        rendered, _ = render_jinja_template(
            [[message._asdict() for message in messages]],
            chat_template=template,
            add_generation_prompt=True,
            bos_token=beginning,
        )
        return str(rendered[0])
    turns = "".join(_HEADER.format(role=role) + content.strip() + END_OF_TURN for role, content in messages)
    return beginning + turns + _HEADER.format(role="assistant")
