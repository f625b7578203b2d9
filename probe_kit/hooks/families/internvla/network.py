"""InternVLA-M1: Qwen2.5-VL and DINOv2, a querying transformer, a guided diffusion head, in torch and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is. Capture and
actions are in its adapter in `probe_kit.hooks`.

The run's `config.yaml` names parts of a fixed table (`dinov2_vits14`, `DiT-B`). Sizes of other parts, as
development checkpoints have them, are in a file `dims.json` beside or above it, under the names of those
checkpoints.

B batch, V views, P prompt positions or patches, Q queries, S positions that are read, C conditions, A actions of a
chunk, N denoising steps, D width.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import AliasChoices, Field, InstanceOf, model_validator
from torch import Tensor, nn
from torch.nn import functional
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from probe_kit._system.bounded_files import load_json, load_yaml
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.shared.qwen.network import IMAGE, QwenInputs, qwen2_5_vl_config
from probe_kit.models.building import TimeEmbedder, build_empty, fill_rotary, without_precision
from probe_kit.models.config_file import ConfigFile, Count, Index, part

RUN_FILE, DIMS_FILE = "config.yaml", "dims.json"
JSON_FILE = "config.json"
"""File that a run may have instead of its `config.yaml`; that of a vision-language model has the same name."""
FRAMEWORKS = ("InternVLA-M1", "InternVLA_M1")
# Per name: width, blocks, heads.
_DINO = {"dinov2_vits14": (384, 12, 6), "dinov2_vitb14": (768, 12, 12), "dinov2_vitl14": (1024, 24, 16)}
_DIT = {"DiT-S": (384, 6, 4), "DiT-B": (768, 12, 12), "DiT-L": (1024, 24, 16)}


class DinoConfig(ConfigFile):
    """The sizes of DINOv2.

    Attributes:
        width: Width of the stream.
        blocks: Number of blocks.
        heads: Attention heads of a block.
        trained_side: Side in pixels of the pictures that its positions were trained for.
        patch: Side of a patch in pixels.
        side: Side of its pictures in pixels.
    """

    width: Count = Field(validation_alias="embed_dim")
    blocks: Count = Field(validation_alias="depth")
    heads: Count = Field(validation_alias="num_heads")
    trained_side: Count = Field(default=518, validation_alias="img_size")
    patch: Count = Field(default=14, validation_alias="patch_size")
    side: Count = Field(default=224, validation_alias="px")


class QueryConfig(ConfigFile):
    """The sizes of the querying transformer, which reads hidden states from `first` up to, not including, `last`.

    Attributes:
        first: First hidden state that it reads.
        last: End of the hidden states that it reads.
        queries: Number of queries.
        inputs: Width of the hidden states.
        width: Width of the queries.
        heads: Attention heads of a layer.
    """

    first: Index = Field(validation_alias="qformer_start_layer")
    last: Count = Field(validation_alias="qformer_end_layer")
    queries: Count = Field(validation_alias="num_query_tokens")
    inputs: Count = Field(validation_alias="input_dim")
    # The released files misspell the name.
    width: Count = Field(validation_alias=AliasChoices("ouptput_dim", "output_dim"))
    heads: Count = Field(default=8, validation_alias="qformer_heads")


class HeadConfig(ConfigFile):
    """The sizes of the diffusion head.

    Attributes:
        width: Width of the stream.
        blocks: Number of blocks.
        heads: Attention heads of a block.
        action_dim: Numbers per action.
        future: Actions of a chunk behind the next one.
        past: Actions before the next one; no other number than 0 is implemented.
        steps: Diffusion steps of the training.
        schedule: Name of the noise schedule.
    """

    width: Count = Field(validation_alias="token_size")
    blocks: Count = Field(validation_alias="depth")
    heads: Count = Field(validation_alias="num_heads")
    action_dim: Count = 7
    future: Index = Field(default=15, validation_alias="future_action_window_size")
    past: Index = Field(default=0, validation_alias="past_action_window_size", le=0)
    steps: Count = Field(default=100, validation_alias="diffusion_steps")
    schedule: str = Field(default="squaredcos_cap_v2", validation_alias="noise_schedule")

    @property
    def length(self) -> int:
        """The number of actions in a chunk: the next, and those behind it."""
        return self.future + 1


class InternVLAConfig(ConfigFile):
    """A checkpoint's configuration.

    Attributes:
        base: The vision-language model the run was made of, as its file names it.
        cot: The prompt around the instruction, None for the instruction alone.
        picture: (width, height) in pixels to which the model resizes pictures, if any.
    """

    network = "InternVLA-M1"

    vlm: Annotated[
        InstanceOf[Qwen2_5_VLConfig], part(lambda values: Qwen2_5_VLConfig(**without_precision(values)))
    ]
    dino: DinoConfig
    query: QueryConfig = Field(validation_alias="layer_qformer")
    head: HeadConfig = Field(validation_alias="action_model")
    base: str = ""
    cot: str | None = Field(default=None, validation_alias="CoT_prompt")
    picture: tuple[Count, Count] | None = Field(default=None, validation_alias="image_size")

    @classmethod
    def from_values(cls, values: Mapping[str, Any], vlm: Mapping[str, Any], source: str) -> Self:
        """Read the content of the files.

        Args:
            values: Content of the run's configuration.
            vlm: Content of Qwen2.5-VL's config.json.
            source: Name of the file, for messages.

        Raises:
            CheckpointError: For another framework, an unknown part, and fields that `read` refuses.
        """
        framework = values.get("framework") or {}
        if (framework_name := framework.get("framework_py")) not in FRAMEWORKS:
            raise CheckpointError(
                f"{source} describes {framework_name!r}; expected {FRAMEWORKS[0]}. Pass the right --model"
            )
        data = (values.get("datasets") or {}).get("vla_data") or {}
        dino, head = framework.get("dino") or {}, framework.get("action_model") or {}
        dit = values.get("dit") or _sizes_of(
            head.get("action_model_type", "DiT-B"), _DIT, "action_model_type", source
        )
        return cls.read(
            {
                "vlm": vlm,
                "dino": values.get("dino")
                or _sizes_of(dino.get("dino_backbone", "dinov2_vits14"), _DINO, "dino_backbone", source),
                "layer_qformer": {**values, **(framework.get("layer_qformer") or {})},
                "action_model": {**values, **head, **dit},
                "base": (framework.get("qwenvl") or {}).get("base_vlm"),
                "CoT_prompt": data.get("CoT_prompt"),
                "image_size": data.get("image_size") or None,
            },
            source,
        )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        query, head, text = self.query, self.head, self.vlm.text_config
        wrong = []
        if query.inputs != text.hidden_size:
            wrong.append(
                f"layer_qformer reads width {query.inputs}, the vision-language model has {text.hidden_size}"
            )
        if not query.first < query.last <= text.num_hidden_layers + 1:
            wrong.append(
                f"layer_qformer reads hidden states {query.first} to {query.last}, there are "
                f"{text.num_hidden_layers + 1}"
            )
        for name, width, heads in (("layer_qformer", query.width, query.heads), ("DiT", head.width, head.heads)):
            if width % heads:
                wrong.append(f"{name} has width {width} and {heads} heads")
        if self.dino.side % self.dino.patch or self.dino.trained_side % self.dino.patch:
            wrong.append(f"DINOv2's patches of {self.dino.patch} do not tile pictures of {self.dino.side}")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self


def find_config(folder: Path) -> tuple[dict[str, Any], Path]:
    """Return the run's values and their folder: `folder` itself, or the one above its `checkpoints/`.

    Raises:
        CheckpointError: If neither has a `config.yaml`, a `config.json` of a run, or `dims.json`.
    """
    for candidate in (folder, folder.parent):
        files = [candidate / name for name in (DIMS_FILE, RUN_FILE) if (candidate / name).is_file()]
        values: dict[str, Any] = {}
        for file in files:
            values |= _read(file)
        if not (candidate / RUN_FILE).is_file() and (candidate / JSON_FILE).is_file():
            run = _read(candidate / JSON_FILE)
            values |= run if "framework" in run else {}
        if values:
            return values, candidate
    raise CheckpointError(
        f"{RUN_FILE} or {JSON_FILE} of a run is missing in {folder} and in {folder.parent}; this is not an "
        "InternVLA-M1 checkpoint. A release has it beside the folder checkpoints/"
    )


def _read(file: Path) -> dict[str, Any]:
    try:
        values = load_json(file) if file.suffix == ".json" else load_yaml(file)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file} cannot be read: {error}") from error
    if not isinstance(values, dict):
        raise CheckpointError(f"{file} holds a {type(values).__name__}; expected named values")
    return values


def _sizes_of(name: str, table: Mapping[str, tuple[int, int, int]], field: str, source: str) -> dict[str, int]:
    """Return the sizes of a released part, under the names that `dims.json` has.

    Raises:
        CheckpointError: For a part that is not in the table.
    """
    if name not in table:
        raise CheckpointError(
            f"{source}: {field} {name!r} is not one of {', '.join(table)}; "
            f"give its sizes in a {DIMS_FILE} beside {RUN_FILE}"
        )
    width, blocks, heads = table[name]
    return {"embed_dim": width, "token_size": width, "depth": blocks, "num_heads": heads}


# -- layers ---------------------------------------------------------------------------------------------------


class Attention(nn.Module):
    """The self-attention of (B, T, D) without a mask."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, stream: Tensor) -> Tensor:
        """Return the mixed positions, (B, T, D) from (B, T, D)."""
        query, key, value = self.qkv(stream).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        read = functional.scaled_dot_product_attention(query, key, value)
        return cast(Tensor, self.proj(read.transpose(1, 2).flatten(2)))


class MLP(nn.Module):
    """A pair of layers with GELU between them, of which `approximate` is torch's name of its approximation."""

    def __init__(self, width: int, approximate: Literal["none", "tanh"]) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)
        self.approximate = approximate

    def forward(self, stream: Tensor) -> Tensor:
        """Return the output of the layers, (B, T, D) from (B, T, D)."""
        return cast(Tensor, self.fc2(functional.gelu(self.fc1(stream), approximate=self.approximate)))


# -- DINOv2 ---------------------------------------------------------------------------------------------------

_DINO_EPSILON = 1e-6
_OFFSET = 0.1
"""Number that the original adds to the number of patches before dividing, against rounding down."""


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, stream: Tensor) -> Tensor:
        return stream * self.gamma


class _DinoBlock(nn.Module):
    """A pre-norm block whose two halves are scaled per feature before they are added."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=_DINO_EPSILON)
        self.attn = Attention(width, heads)
        self.ls1 = _Scale(width)
        self.norm2 = nn.LayerNorm(width, eps=_DINO_EPSILON)
        self.mlp = MLP(width, "none")
        self.ls2 = _Scale(width)

    def forward(self, stream: Tensor) -> Tensor:
        """Return the stream behind the block, (B, 1 + P, D) from (B, 1 + P, D)."""
        stream = stream + self.ls1(self.attn(self.norm1(stream)))
        return cast(Tensor, stream + self.ls2(self.mlp(self.norm2(stream))))


class _PatchEmbedding(nn.Module):
    def __init__(self, width: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=patch, stride=patch)

    def forward(self, pixels: Tensor) -> Tensor:
        return cast(Tensor, self.proj(pixels).flatten(2).transpose(1, 2))


class DinoV2(nn.Module):
    """The vision transformer, which returns patch features behind its final norm, without the class token."""

    def __init__(self, config: DinoConfig) -> None:
        super().__init__()
        self.patch = config.patch
        self.cls_token = nn.Parameter(torch.zeros(1, 1, config.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, (config.trained_side // config.patch) ** 2 + 1, config.width))
        self.mask_token = nn.Parameter(torch.zeros(1, config.width))
        self.patch_embed = _PatchEmbedding(config.width, config.patch)
        self.blocks = nn.ModuleList(_DinoBlock(config.width, config.heads) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.width, eps=_DINO_EPSILON)

    def forward(self, pixels: Tensor) -> Tensor:
        """Return patch features (B, P, D) of pictures (B, 3, H, W), whose sides are multiples of the patch."""
        patches = self.patch_embed(pixels)
        stream = torch.cat([self.cls_token.expand(len(pixels), -1, -1), patches], dim=1)
        rows, columns = (side // self.patch for side in pixels.shape[-2:])
        stream = stream + self._positions(rows, columns).to(stream.dtype)
        for block in self.blocks:
            stream = block(stream)
        return cast(Tensor, self.norm(stream)[:, 1:])

    def _positions(self, rows: int, columns: int) -> Tensor:
        """Return the learned grid, (1, 1 + rows x columns, D), stretched where the picture has another grid."""
        trained = round((self.pos_embed.shape[1] - 1) ** 0.5)
        if rows == columns == trained:
            return self.pos_embed
        embeddings = self.pos_embed.float()
        grid = embeddings[:, 1:].reshape(1, trained, trained, -1).permute(0, 3, 1, 2)
        factors = ((rows + _OFFSET) / trained, (columns + _OFFSET) / trained)
        stretched = functional.interpolate(grid, scale_factor=factors, mode="bicubic")
        return torch.cat([embeddings[:, :1], stretched.flatten(2).transpose(1, 2)], dim=1)


# -- the querying transformer ---------------------------------------------------------------------------------


class Layer(nn.Module):
    """A layer in which queries read one hidden state, then pass an MLP."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.cross_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, queries: Tensor, read: Tensor) -> Tensor:
        """Return the queries (B, Q, D) after they read (B, S, D)."""
        queries = queries + self.cross_attn(self.norm1(queries), read, read, need_weights=False)[0]
        return cast(Tensor, queries + self.mlp(self.norm2(queries)))


class QueryTransformer(nn.Module):
    """The querying transformer, with one layer per hidden state.

    No mask hides padding: a padded prompt changes what the queries find.
    """

    def __init__(self, config: QueryConfig) -> None:
        super().__init__()
        self.proj = nn.Linear(config.inputs, config.width)
        self.query_tokens = nn.Parameter(torch.zeros(config.queries, config.width))
        self.layers = nn.ModuleList(Layer(config.width, config.heads) for _ in range(config.last - config.first))

    def forward(self, states: list[Tensor]) -> Tensor:
        """Return the queries (B, Q, D) that have read one hidden state per layer.

        Args:
            states: One (B, S, width of the vision-language model) per layer.
        """
        # A copy: what an edit writes into the stream must not land in the parameter.
        queries = self.query_tokens.expand(len(states[0]), -1, -1).clone()
        for layer, state in zip(self.layers, states, strict=True):
            queries = layer(queries, self.proj(state))
        return queries


# -- the diffusion head ---------------------------------------------------------------------------------------

_EPSILON = 1e-6


def _norm(width: int) -> nn.LayerNorm:
    return nn.LayerNorm(width, eps=_EPSILON, elementwise_affine=False)


class _Embedder(nn.Module):
    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, width)

    def forward(self, features: Tensor) -> Tensor:
        return cast(Tensor, self.linear(features))


class _ConditionEmbedder(_Embedder):
    """An embedding of the conditions, which also holds the condition that stands for none."""

    def __init__(self, inputs: int, width: int, conditions: int) -> None:
        super().__init__(inputs, width)
        self.uncondition = nn.Parameter(torch.zeros(conditions, inputs))


class Block(nn.Module):
    """A pre-norm block; its norms have no weights."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = _norm(width), _norm(width)
        self.attn = Attention(width, heads)
        self.mlp = MLP(width, "tanh")

    def forward(self, stream: Tensor) -> Tensor:
        """Return the stream behind the block, (B, C + A, D) from (B, C + A, D)."""
        stream = stream + self.attn(self.norm1(stream))
        return cast(Tensor, stream + self.mlp(self.norm2(stream)))


class FinalLayer(nn.Module):
    """The map from the stream to the noise in every position."""

    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.norm_final = _norm(width)
        self.linear = nn.Linear(width, outputs)

    def forward(self, stream: Tensor) -> Tensor:
        """Return the noise in every position, (B, C + A, action numbers) from (B, C + A, D)."""
        return cast(Tensor, self.linear(self.norm_final(stream)))


class DiffusionTransformer(nn.Module):
    """The diffusion transformer: conditions, each with the step added, stand before the noisy actions.

    Every position attends to every other one.
    """

    def __init__(self, config: HeadConfig, query: QueryConfig) -> None:
        super().__init__()
        self.conditions = query.queries
        self.positional_embedding = nn.Parameter(torch.zeros(query.queries + config.length, config.width))
        # Of a version that read past actions; inference never calls it.
        self.history_embedder = _Embedder(config.action_dim, config.width)
        self.x_embedder = _Embedder(config.action_dim, config.width)
        self.t_embedder = TimeEmbedder(config.width, bias=True)
        self.z_embedder = _ConditionEmbedder(query.width, config.width, query.queries)
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.blocks))
        self.final_layer = FinalLayer(config.width, config.action_dim)

    def forward(self, actions: Tensor, steps: Tensor, condition: Tensor) -> Tensor:
        """Return the noise in the actions, (B, A, action numbers).

        Args:
            actions: (B, A, action numbers) noisy actions.
            steps: (B,) diffusion steps.
            condition: (B, C, width of the queries) condition that `InternVLANetwork.read` returns.
        """
        conditions = self.t_embedder(steps)[:, None] + self.z_embedder(condition)
        stream = torch.cat([conditions, self.x_embedder(actions)], dim=1) + self.positional_embedding
        for block in self.blocks:
            stream = block(stream)
        return cast(Tensor, self.final_layer(stream)[:, self.conditions :])


def uses_guidance(scale: float) -> bool:
    """Whether the head runs twice the rows: with the condition and, below them, without."""
    return scale > 1


@dataclass(frozen=True)
class Schedule:
    """The steps of DDIM.

    Attributes:
        moments: (N,) numbers of the steps that the network is given, ascending.
        signal: (N,) float64 share of signal at each step.
    """

    moments: NDArray[np.int64]
    signal: NDArray[np.float64]

    @classmethod
    def of(cls, steps: int, trained: int, name: str = "squaredcos_cap_v2") -> "Schedule":
        """Return `steps` of the `trained` steps at a whole distance.

        Raises:
            CheckpointError: For another noise schedule.
            UsageError: If no whole distance gives that number.
        """
        if name != "squaredcos_cap_v2":
            raise CheckpointError(f"noise schedule {name!r} is not implemented here; only squaredcos_cap_v2 is")
        distances = [stride for stride in range(1, trained + 1) if len(range(0, trained, stride)) == steps]
        if not distances:
            raise UsageError(
                f"{steps} DDIM steps cannot be taken at a whole distance out of {trained}; try 5 or 10"
            )
        moments = np.arange(0, trained, distances[0])
        return cls(moments, np.cumprod(1 - _added_noise(trained))[moments])

    def __len__(self) -> int:
        return len(self.moments)

    def back(self, index: int, path: Tensor, noise: Tensor) -> Tensor:
        """Return the path one step below `index`, without new noise; below the lowest there is signal only."""
        signal = float(self.signal[index])
        below = float(self.signal[index - 1]) if index else 1.0
        clean = math.sqrt(1 / signal) * path - math.sqrt(1 / signal - 1) * noise
        return clean * math.sqrt(below) + math.sqrt(1 - below) * noise


def _added_noise(steps: int) -> NDArray[np.float64]:
    """Return the variance that each step adds, (steps,).

    The signal falls as a squared cosine (Nichol and Dhariwal 2021).
    """

    def left(share: float) -> float:
        return math.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2

    return np.array([min(1 - left((step + 1) / steps) / left(step / steps), 0.999) for step in range(steps)])


# -- the network ----------------------------------------------------------------------------------------------

VLM_PREFIX = "qwen_vl_interface.model."
"""The beginning of the names of the vision-language model's tensors."""


class _Qwen(nn.Module):
    def __init__(self, config: Qwen2_5_VLConfig) -> None:
        super().__init__()
        self.model: Any = Qwen2_5_VLForConditionalGeneration._from_config(config, attn_implementation="eager")


class _Dino(nn.Module):
    def __init__(self, config: DinoConfig) -> None:
        super().__init__()
        self.body = DinoV2(config)


class _Head(nn.Module):
    def __init__(self, config: HeadConfig, query: QueryConfig) -> None:
        super().__init__()
        self.net = DiffusionTransformer(config, query)


class InternVLANetwork(nn.Module):
    """The network InternVLA-M1 under the parameter names of its released files."""

    def __init__(self, config: InternVLAConfig) -> None:
        super().__init__()
        self.config = config
        self.qwen_vl_interface = _Qwen(config.vlm)
        self.layer_qformer = QueryTransformer(config.query)
        self.action_model = _Head(config.head, config.query)
        self.dino_encoder = _Dino(config.dino)
        self.dino_pro = nn.Linear(config.dino.width, config.vlm.text_config.hidden_size)

    @property
    def vlm(self) -> Any:
        """The network Qwen2.5-VL with its output head, which nothing calls."""
        return self.qwen_vl_interface.model

    @property
    def head(self) -> DiffusionTransformer:
        """The diffusion transformer."""
        return self.action_model.net

    def read(self, inputs: QwenInputs, views: Tensor) -> Tensor:
        """Return the condition of the actions, (B, Q, width of the queries).

        The queries read hidden states of the vision-language model, of which the last is normed, with DINOv2's
        features behind each.

        Args:
            inputs: Prompts with their pictures, for the vision-language model.
            views: (B x V, 3, H, W) pictures for DINOv2.
        """
        keywords = inputs.keywords(self.vlm.model)
        states = self.vlm.model(**keywords, output_hidden_states=True, use_cache=False).hidden_states
        features = self.dino_encoder.body(views.to(self.dino_pro.weight.dtype))
        projected = self.dino_pro(features.reshape(len(inputs.ids), -1, features.shape[-1]))
        read_states = states[self.config.query.first : self.config.query.last]
        condition: Tensor = self.layer_qformer([torch.cat([state, projected], dim=1) for state in read_states])
        return condition

    def denoise(self, condition: Tensor, noise: Tensor, schedule: Schedule, scale: float) -> Tensor:
        """Return the normalised actions, (B, A, action numbers) float32.

        Args:
            condition: (B, Q, width of the queries), see `read`.
            noise: (B, A, action numbers) float32; the path is kept in float32 whatever the weights are.
            schedule: Steps of DDIM.
            scale: Scale of the guidance; above 1 the head runs 2 B rows, first those with the condition, then
                those without.
        """
        rows = condition
        if uses_guidance(scale):
            without = self.head.z_embedder.uncondition.expand(len(condition), -1, -1)
            rows = torch.cat([condition, without.to(condition.dtype)])
        path = noise.float()
        for index in reversed(range(len(schedule))):
            steps = torch.full((len(rows),), int(schedule.moments[index]), device=path.device)
            noisy = path.repeat(len(rows) // len(path), 1, 1).to(condition.dtype)
            predicted = self.head(noisy, steps, rows).float()
            if uses_guidance(scale):
                with_condition, without_it = predicted.chunk(2)
                predicted = without_it + scale * (with_condition - without_it)
            path = schedule.back(index, path, predicted)
        return path


def build_internvla(config: InternVLAConfig, dtype: torch.dtype, device: str = "meta") -> InternVLANetwork:
    """Return the network in eval mode; see `build_empty`."""
    network = build_empty(lambda: InternVLANetwork(config), dtype, device)
    fill_rotary(network.vlm)
    return network


def full_size_internvla() -> InternVLANetwork:
    """Return the released size on the meta device: Qwen2.5-VL-3B, DINOv2 ViT-S, 64 queries, DiT-B."""
    queries = {
        "qformer_start_layer": 36, "qformer_end_layer": 37, "num_query_tokens": 64, "input_dim": 2048,
        "output_dim": 768,
    }  # fmt: skip
    run = {"framework": {"framework_py": FRAMEWORKS[0], "layer_qformer": queries}}
    vlm = qwen2_5_vl_config("3B").to_dict()
    return build_internvla(InternVLAConfig.from_values(run, vlm, "released"), torch.float32)


# -- inputs ---------------------------------------------------------------------------------------------------

SIDE = 224
"""Side in pixels of the picture that the released evaluation sends."""
_SLOT = "{instruction}"
# ImageNet's.
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def look(picture: NDArray[np.uint8], size: tuple[int, int] | None) -> NDArray[np.uint8]:
    """Return a picture squeezed to a square by area, as the evaluation does it: (height, width, 3) uint8.

    Args:
        picture: (H, W, 3) uint8 picture.
        size: (width, height) to which the checkpoint itself resizes the square, with PIL's default filter; None
            for none.
    """
    squeezed = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    if size is None or size == (SIDE, SIDE):
        return np.asarray(squeezed, np.uint8)
    return np.array(Image.fromarray(squeezed).resize(size, Image.Resampling.BICUBIC))


def dino_pixels(picture: NDArray[np.uint8], side: int) -> Tensor:
    """Return a picture (H, W, 3) uint8 as (3, h, w) float32, the shorter side `side`, with normalised colours."""
    image = Image.fromarray(picture)
    width, height = image.size
    shorter = min(width, height)
    size = (int(side * width / shorter), int(side * height / shorter))
    if image.size != size:
        image = image.resize(size, Image.Resampling.BILINEAR)
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255
    mean, deviation = (torch.tensor(colour)[:, None, None] for colour in (_MEAN, _DEVIATION))
    return (pixels - mean) / deviation


def prompt(instruction: str, cot: str | None) -> str:
    """Return the whole text, with one image slot.

    Args:
        instruction: Instruction, which is written in small letters.
        cot: The text around the instruction, with {instruction} in it; None for the instruction alone.
    """
    text = instruction.lower() if cot is None else cot.replace(_SLOT, instruction.lower())
    return (
        "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
        f"<|im_start|>user\n{IMAGE}{text}<|im_end|>\n<|im_start|>assistant\n"
    )
