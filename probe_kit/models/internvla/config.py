"""The `config.yaml` of an InternVLA-M1 run, and the configuration of its Qwen2.5-VL.

The run's file names parts of a fixed table (`dinov2_vits14`, `DiT-B`); sizes of other parts, as development
checkpoints have them, stand in a file `dims.json` beside or above it, under the names of those checkpoints.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transformers import Qwen2_5_VLConfig

from probe_kit._system.bounded_files import load_yaml
from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.models.qwen import without_precision

RUN_FILE, DIMS_FILE = "config.yaml", "dims.json"
JSON_FILE = "config.json"
"""What a run may have instead of its `config.yaml`; the file of a vision-language model has the same name."""
FRAMEWORKS = ("InternVLA-M1", "InternVLA_M1")
# Per name: width, blocks, heads.
_DINO = {"dinov2_vits14": (384, 12, 6), "dinov2_vitb14": (768, 12, 12), "dinov2_vitl14": (1024, 24, 16)}
_DIT = {"DiT-S": (384, 6, 4), "DiT-B": (768, 12, 12), "DiT-L": (1024, 24, 16)}
_QUERY_HEADS = 8
_PRETRAINING_SIDE, _PATCH, _SIDE = 518, 14, 224


@dataclass(frozen=True)
class DinoConfig:
    """DINOv2: width, blocks, heads; the side its positions were trained for, of a patch, of its pictures."""

    width: int
    blocks: int
    heads: int
    trained_side: int = _PRETRAINING_SIDE
    patch: int = _PATCH
    side: int = _SIDE


@dataclass(frozen=True)
class QueryConfig:
    """The querying transformer: hidden states `first` up to, not including, `last`; queries; widths; heads."""

    first: int
    last: int
    queries: int
    inputs: int
    width: int
    heads: int


@dataclass(frozen=True)
class HeadConfig:
    """The diffusion head: width, blocks, heads, numbers and length of a chunk, training steps, noise schedule."""

    width: int
    blocks: int
    heads: int
    action_dim: int
    length: int
    steps: int = 100
    schedule: str = "squaredcos_cap_v2"


@dataclass(frozen=True)
class InternVLAConfig:
    """A checkpoint's configuration.

    base: the vision-language model the run was made of, as its file names it. cot: the prompt around the
    instruction, None for the instruction alone. picture: (width, height) the model resizes pictures to, if any.
    """

    vlm: Qwen2_5_VLConfig
    dino: DinoConfig
    query: QueryConfig
    head: HeadConfig
    base: str
    cot: str | None
    picture: tuple[int, int] | None

    @classmethod
    def from_values(cls, values: Mapping[str, Any], vlm: Mapping[str, Any], source: str) -> "InternVLAConfig":
        """Read the content of the files; vlm: of Qwen2.5-VL's config.json. Raises CheckpointError."""
        framework = values.get("framework") or {}
        if (framework_name := framework.get("framework_py")) not in FRAMEWORKS:
            raise CheckpointError(
                f"{source} describes {framework_name!r}; expected {FRAMEWORKS[0]}. Pass the right --model"
            )
        data = (values.get("datasets") or {}).get("vla_data") or {}
        size = data.get("image_size")
        config = cls(
            vlm=Qwen2_5_VLConfig(**without_precision(vlm)),
            dino=_dino(values, framework, source),
            query=_query(values, framework, source),
            head=_head(values, framework, source),
            base=str((framework.get("qwenvl") or {}).get("base_vlm", "")),
            cot=data.get("CoT_prompt"),
            picture=(int(size[0]), int(size[1])) if size else None,
        )
        _check_unfit(config, source)
        return config


def find_config(folder: Path) -> tuple[dict[str, Any], Path]:
    """The run's values and the folder they stand in: `folder` itself, or the one above its `checkpoints/`.

    Raises CheckpointError if neither has a `config.yaml`, a `config.json` of a run, or `dims.json`.
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


def _dino(values: Mapping[str, Any], framework: Mapping[str, Any], source: str) -> DinoConfig:
    if sizes := values.get("dino"):
        return DinoConfig(
            int(sizes["embed_dim"]),
            int(sizes["depth"]),
            int(sizes["num_heads"]),
            int(sizes.get("img_size", _PRETRAINING_SIDE)),
            int(sizes.get("patch_size", _PATCH)),
            int(sizes.get("px", _SIDE)),
        )
    name = (framework.get("dino") or {}).get("dino_backbone", "dinov2_vits14")
    return DinoConfig(*_named(name, _DINO, "dino_backbone", source))


def _query(values: Mapping[str, Any], framework: Mapping[str, Any], source: str) -> QueryConfig:
    part = framework.get("layer_qformer") or {}
    # The released files misspell the name.
    width = part.get("ouptput_dim", part.get("output_dim"))
    needed = ("qformer_start_layer", "qformer_end_layer", "num_query_tokens", "input_dim")
    if (missing := [name for name in needed if name not in part]) or width is None:
        raise CheckpointError(f"{source}: framework.layer_qformer lacks {', '.join(missing) or 'ouptput_dim'}")
    first, last, queries, inputs = (int(part[name]) for name in needed)
    return QueryConfig(first, last, queries, inputs, int(width), int(values.get("qformer_heads", _QUERY_HEADS)))


def _head(values: Mapping[str, Any], framework: Mapping[str, Any], source: str) -> HeadConfig:
    part = framework.get("action_model") or {}
    if past := int(part.get("past_action_window_size", 0)):
        raise CheckpointError(f"{source}: the head reads {past} past actions, which is not implemented here")
    if sizes := values.get("dit"):
        width, blocks, heads = int(sizes["token_size"]), int(sizes["depth"]), int(sizes["num_heads"])
    else:
        width, blocks, heads = _named(part.get("action_model_type", "DiT-B"), _DIT, "action_model_type", source)
    return HeadConfig(
        width,
        blocks,
        heads,
        int(part.get("action_dim", 7)),
        int(part.get("future_action_window_size", 15)) + 1,
        int(values.get("diffusion_steps", 100)),
        str(values.get("noise_schedule", "squaredcos_cap_v2")),
    )


def _named(name: str, table: Mapping[str, tuple[int, int, int]], field: str, source: str) -> tuple[int, int, int]:
    if name not in table:
        raise CheckpointError(
            f"{source}: {field} {name!r} is not one of {', '.join(table)}; "
            f"give its sizes in a {DIMS_FILE} beside {RUN_FILE}"
        )
    return table[name]


def _check_unfit(config: InternVLAConfig, source: str) -> None:
    query, head, text = config.query, config.head, config.vlm.text_config
    wrong = []
    if query.inputs != text.hidden_size:
        wrong.append(f"layer_qformer reads width {query.inputs}, the vision-language model has {text.hidden_size}")
    if not 0 <= query.first < query.last <= text.num_hidden_layers + 1:
        wrong.append(
            f"layer_qformer reads hidden states {query.first} to {query.last}, there are "
            f"{text.num_hidden_layers + 1}"
        )
    for name, width, heads in (("layer_qformer", query.width, query.heads), ("DiT", head.width, head.heads)):
        if width % heads:
            wrong.append(f"{name} has width {width} and {heads} heads")
    if config.dino.side % config.dino.patch or config.dino.trained_side % config.dino.patch:
        wrong.append(f"DINOv2's patches of {config.dino.patch} do not tile pictures of {config.dino.side}")
    if wrong:
        raise CheckpointError(f"{source}: {'; '.join(wrong)}")
