"""The model Ovis2.5: patches become distributions over visual words, whose embeddings join those of the text.

The vision tower takes patches of any grid, with interpolated and rotary positions and full attention. The patches
of a visual word follow each other.

B batch, T positions, N patches and W visual words of all pictures together, D width.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field, InstanceOf, PositiveFloat, model_validator
from torch import Tensor, nn
from torch.nn import functional
from transformers import Qwen3Config, Qwen3ForCausalLM
from transformers.models.qwen2_vl.image_processing_qwen2_vl import smart_resize

from probe_kit.errors import ObservationError
from probe_kit.models.building import build_empty, fill_decoder_rotary, without_precision
from probe_kit.models.checkpoint_files import processor_settings
from probe_kit.models.config_file import ConfigFile, Count, part


class VisionConfig(ConfigFile):
    """The vision tower; only features that every released checkpoint has are implemented.

    Attributes:
        patch: Pixels of a patch's side.
        stride: Patches of a visual word's side.
        side: Pixels of a side of the square from whose table position embeddings are interpolated.
        window: Pixels of a side of the windows in whose order the authors' code processes the patches; it changes
            no number but in the last bits.
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
        """The number of positions along a side of the square table."""
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
    """A checkpoint's configuration.

    Attributes:
        words: Number of visual words, those that mark where pictures begin and end included.
    """

    network = "Ovis2.5"

    text: Annotated[
        InstanceOf[Qwen3Config], part(lambda values: Qwen3Config.from_dict(without_precision(values)), "qwen3")
    ] = Field(validation_alias="llm_config")
    vision: VisionConfig = Field(validation_alias="vit_config")
    words: Count = Field(validation_alias="visual_vocab_size")

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Read the content of config.json.

        Raises:
            CheckpointError: For fields that `read` refuses.
        """
        return cls.read(values, "config.json")


# -- the vision tower -----------------------------------------------------------------------------------------

_THETA = 10000.0


class Embeddings(nn.Module):
    """The embedding of patches and of their places, in width D."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.patch_embedding = nn.Conv2d(3, config.width, config.patch, config.patch)
        self.position_embedding = nn.Embedding(config.table**2, config.width)

    def forward(self, patches: Tensor, grid: Tensor) -> Tensor:
        """Return the embeddings (N, D) of patches (N, 3 · patch · patch)."""
        weight = self.patch_embedding.weight
        embedded = functional.linear(patches.to(weight.dtype), weight.flatten(1), self.patch_embedding.bias)
        return embedded + torch.cat([self._places(int(h), int(w)) for _, h, w in grid.tolist()])

    def _places(self, rows: int, columns: int) -> Tensor:
        side = self.config.table
        table = self.position_embedding.weight.view(1, side, side, -1).permute(0, 3, 1, 2)
        places = functional.interpolate(table, size=(rows, columns), mode="bicubic", align_corners=False)
        return word_order(places[0].permute(1, 2, 0), self.config.stride)


class Attention(nn.Module):
    """The attention of a picture's patches to each other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.k_proj, self.v_proj = nn.Linear(width, width), nn.Linear(width, width)
        self.q_proj, self.out_proj = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, stream: Tensor, rotation: tuple[Tensor, Tensor], lengths: list[int]) -> Tensor:
        """Return the mixed patches (N, D).

        Args:
            stream: (N, D) patches.
            rotation: Cosines and sines (N, 1, D / heads).
            lengths: Number of patches of every picture.
        """
        query, key, value = (
            project(stream).unflatten(-1, (self.heads, -1)) for project in (self.q_proj, self.k_proj, self.v_proj)
        )
        query, key = _rotate(query, rotation), _rotate(key, rotation)
        pictures = zip(*(part.transpose(0, 1).split(lengths, dim=1) for part in (query, key, value)), strict=True)
        read = [functional.scaled_dot_product_attention(q[None], k[None], v[None])[0] for q, k, v in pictures]
        mixed: Tensor = self.out_proj(torch.cat(read, dim=1).transpose(0, 1).flatten(1))
        return mixed


def _rotate(heads: Tensor, rotation: tuple[Tensor, Tensor]) -> Tensor:
    cosines, sines = rotation
    wide = heads.float()
    first, second = wide.chunk(2, dim=-1)
    return (wide * cosines + torch.cat([-second, first], dim=-1) * sines).to(heads.dtype)


class Perceptron(nn.Module):
    """A pair of layers around a GELU."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, stream: Tensor) -> Tensor:
        """Return the output of the layers, (N, D) from (N, D)."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(stream), approximate="tanh"))
        return out


class Block(nn.Module):
    """A layer, normed before each half."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(config.width, eps=config.epsilon)
        self.self_attn = Attention(config.width, config.heads)
        self.layer_norm2 = nn.LayerNorm(config.width, eps=config.epsilon)
        self.mlp = Perceptron(config.width, config.mlp)

    def forward(self, stream: Tensor, rotation: tuple[Tensor, Tensor], lengths: list[int]) -> Tensor:
        """Return the stream behind the layer, (N, D); the arguments are those of `Attention.forward`."""
        stream = stream + self.self_attn(self.layer_norm1(stream), rotation, lengths)
        out: Tensor = stream + self.mlp(self.layer_norm2(stream))
        return out


class Encoder(nn.Module):
    """The blocks of the vision tower."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Block(config) for _ in range(config.blocks))


class VisionModel(nn.Module):
    """The vision tower, whose output is the last stream.

    `post_layernorm` is in the released files and never applied.
    """

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.embeddings = Embeddings(config)
        self.encoder = Encoder(config)
        self.post_layernorm = nn.LayerNorm(config.width, eps=config.epsilon)

    def forward(self, patches: Tensor, grid: Tensor) -> Tensor:
        """Return the features (N, D) of patches (N, 3 · patch · patch), cut in the grid (pictures, 3)."""
        stream: Tensor = self.embeddings(patches, grid)
        rotation = self._rotation(grid, stream.device)
        lengths = grid.prod(dim=1).tolist()
        for block in self.encoder.layers:
            stream = block(stream, rotation, lengths)
        return stream

    def _rotation(self, grid: Tensor, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return cosines and sines (N, 1, D / heads): of half the angles by row, of the other half by column."""
        quarter = self.config.width // self.config.heads // 4
        exponents = torch.arange(0, 2 * quarter, 2, dtype=torch.float32, device=device) / (2 * quarter)
        frequencies = 1.0 / _THETA**exponents
        angles = []
        for _, rows, columns in grid.tolist():
            row = torch.arange(rows, device=device)[:, None].expand(rows, columns)
            column = torch.arange(columns, device=device)[None].expand(rows, columns)
            places = word_order(torch.stack([row, column], dim=-1), self.config.stride).float()
            angles.append((places[:, :, None] * frequencies).flatten(1))
        both = torch.cat(angles).repeat(1, 2)[:, None]
        return both.cos(), both.sin()


def word_order(maps: Tensor, stride: int) -> Tensor:
    """Return maps (rows, columns, …) as (rows · columns, …): the patches of one visual word follow each other."""
    rows, columns = maps.shape[:2]
    cut = maps.reshape(rows // stride, stride, columns // stride, stride, *maps.shape[2:])
    return cut.transpose(1, 2).reshape(rows * columns, *maps.shape[2:])


# -- the network ----------------------------------------------------------------------------------------------

PICTURE, PICTURE_BEGINS, PICTURE_ENDS = -300, -301, -302
"""Ids of a prompt at places without text."""
_MARKS = 4
"""Words that mark where pictures and videos begin and end; no patch ever becomes one."""


class Tower(nn.Module):
    """A module that holds the vision model under the name it has in the released files."""

    def __init__(self, config: OvisConfig) -> None:
        super().__init__()
        self.vision_model = VisionModel(config.vision)


class VisualTokenizer(nn.Module):
    """The map from patches to distributions over visual words."""

    def __init__(self, config: OvisConfig) -> None:
        super().__init__()
        words = config.words - _MARKS
        self.joined = config.vision.stride**2
        self.vit = Tower(config)
        self.head = nn.Sequential(
            nn.Linear(config.vision.width * self.joined, words, bias=False), nn.LayerNorm(words)
        )

    def forward(self, patches: Tensor, grid: Tensor) -> Tensor:
        """Return the probabilities (W, words without marks) float32 of the patches."""
        features = self.vit.vision_model(patches, grid)
        logits = self.head(features.reshape(len(features) // self.joined, -1))
        return torch.softmax(logits, dim=-1, dtype=torch.float32)


class OvisNetwork(nn.Module):
    """The network Ovis2.5 under the parameter names of its released files."""

    def __init__(self, config: OvisConfig) -> None:
        super().__init__()
        self.config = config
        self.llm: Any = Qwen3ForCausalLM(config.text)
        self.visual_tokenizer = VisualTokenizer(config)
        self.vte = nn.Embedding(config.words, int(config.text.hidden_size))

    def tie_weights(self) -> None:
        """Tie the language model's output weights, where its configuration says so."""
        self.llm.tie_weights()

    def embed(self, ids: Tensor, pixel_values: Tensor | None, grid: Tensor | None) -> Tensor:
        """Return the embeddings (B, T, D) of ids (B, T), which are negative where a picture stands."""
        embeddings: Tensor = self.llm.get_input_embeddings()(ids.clamp(min=0))
        if pixel_values is None or grid is None:
            return embeddings
        words = self.vte.weight
        probabilities = self.visual_tokenizer(pixel_values, grid)
        visual = probabilities.to(words.dtype) @ words[:-_MARKS]
        embeddings = embeddings.masked_scatter((ids == PICTURE)[..., None], visual)
        for number, row in ((PICTURE_BEGINS, -_MARKS), (PICTURE_ENDS, 1 - _MARKS)):
            embeddings = torch.where((ids == number)[..., None], words[row], embeddings)
        return embeddings

    def forward(
        self,
        input_ids: Tensor,
        pixel_values: Tensor | None = None,
        image_grid_thw: Tensor | None = None,
        **keywords: Any,
    ) -> Any:
        """Return the output of the language model, as transformers returns it.

        Args:
            input_ids: (B, T) ids, negative where a picture stands.
            pixel_values: (N, 3 · patch · patch) patches of all pictures; None without pictures.
            image_grid_thw: (pictures, 3) grid of every picture; None without pictures.
            **keywords: Arguments of the language model, such as masks and positions.
        """
        return self.llm(inputs_embeds=self.embed(input_ids, pixel_values, image_grid_thw), **keywords)


def build_ovis2_5(config: OvisConfig, dtype: torch.dtype, device: str = "meta") -> OvisNetwork:
    """Return the network in eval mode, see `build_empty`, with the rotary frequencies that no checkpoint holds."""
    network = build_empty(lambda: OvisNetwork(config), dtype, device)
    fill_decoder_rotary(network.llm.model)
    network.tie_weights()
    return network


def full_size_ovis2_5() -> OvisNetwork:
    """Return Ovis2.5-9B on the meta device."""
    text = {
        "model_type": "qwen3",
        "hidden_size": 4096,
        "intermediate_size": 12288,
        "num_hidden_layers": 36,
        "num_attention_heads": 32,
        "num_key_value_heads": 8,
        "head_dim": 128,
        "vocab_size": 151936,
    }
    vision = {
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 27,
        "num_attention_heads": 16,
        "num_channels": 3,
        "patch_size": 16,
        "hidden_stride": 2,
        "image_size": 512,
        "window_size": 112,
        "temporal_patch_size": 1,
        "layer_norm_eps": 1e-6,
        "hidden_act": "gelu_pytorch_tanh",
        "use_rope": True,
        "preserve_original_pe": True,
        "fullatt_block_indexes": None,
    }
    values = {"llm_config": text, "vit_config": vision, "visual_vocab_size": 65536}
    return build_ovis2_5(OvisConfig.from_values(values), torch.float32)


# -- pictures -------------------------------------------------------------------------------------------------

SMALLEST, LARGEST = 448 * 448, 1792 * 1792
"""Pixels between which pictures are brought; the authors' code has them, no file does."""
_LONGEST_RATIO = 200
_NEEDED = ("image_mean", "image_std", "resample", "rescale_factor")


@dataclass(frozen=True)
class OvisPictures:
    """The processor of pictures into patches.

    Attributes:
        settings: Values of the checkpoint's file.
        patch: Pixels of a patch's side.
        stride: Patches of a visual word's side.
    """

    settings: dict[str, Any]
    patch: int
    stride: int

    @classmethod
    def from_folder(cls, folder: Path, vision: VisionConfig) -> "OvisPictures":
        """Read the settings of pictures; see `picture_values`.

        Raises:
            CheckpointError: If the file is missing or lacks a value.
        """
        return cls(processor_settings(folder, _NEEDED).values, vision.patch, vision.stride)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return the rows and columns of patches of a picture of that size.

        Raises:
            ObservationError: For a picture whose longer side is more than 200 times the shorter one.
        """
        if max(height, width) > _LONGEST_RATIO * min(height, width):
            raise ObservationError(f"the picture is {height} x {width}: too long for this model's patches")
        tall, wide = smart_resize(height, width, self.patch * self.stride, SMALLEST, LARGEST)
        return tall // self.patch, wide // self.patch

    def tokens(self, height: int, width: int) -> int:
        """Return the number of visual words of a picture of that size."""
        rows, columns = self.grid(height, width)
        return rows * columns // self.stride**2

    def patches(self, pictures: list[NDArray[np.uint8]]) -> tuple[Tensor, Tensor]:
        """Return patches (N, 3 x patch x patch) float32 and grid (B, 3) int64 of (H, W, 3) uint8 pictures.

        The patches of one visual word follow each other.
        """
        grids = [self.grid(*picture.shape[:2]) for picture in pictures]
        rows = [self._cut(picture, grid) for picture, grid in zip(pictures, grids, strict=True)]
        return torch.from_numpy(np.concatenate(rows)), torch.tensor([(1, *grid) for grid in grids])

    def _cut(self, picture: NDArray[np.uint8], grid: tuple[int, int]) -> NDArray[np.float32]:
        tall, wide = grid[0] * self.patch, grid[1] * self.patch
        resampling = Image.Resampling(int(self.settings["resample"]))
        pixels = np.asarray(Image.fromarray(picture).resize((wide, tall), resampling), np.float64)
        mean, deviation = (np.asarray(self.settings[name], np.float32) for name in ("image_mean", "image_std"))
        scaled = (pixels * float(self.settings["rescale_factor"])).astype(np.float32)
        normalised = (scaled - mean) / deviation
        side = self.stride
        cut = normalised.reshape(
            grid[0] // side, side, self.patch, grid[1] // side, side, self.patch, 3
        )  # word row, row in word, y, word column, column in word, x, channel
        ordered = cut.transpose(0, 3, 1, 4, 6, 2, 5)
        return np.ascontiguousarray(ordered, np.float32).reshape(grid[0] * grid[1], -1)
