"""The `config.yaml` of an InternVLA-M1 run, and the configuration of its Qwen2.5-VL.

The run's file names parts of a fixed table (`dinov2_vits14`, `DiT-B`); sizes of other parts, as development
checkpoints have them, stand in a file `dims.json` beside or above it, under the names of those checkpoints.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AliasChoices, Field, InstanceOf, model_validator
from transformers import Qwen2_5_VLConfig

from probe_kit._system.bounded_files import load_yaml
from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.models.building import without_precision
from probe_kit.models.config_file import ConfigFile, Count, Index, part

RUN_FILE, DIMS_FILE = "config.yaml", "dims.json"
JSON_FILE = "config.json"
"""What a run may have instead of its `config.yaml`; the file of a vision-language model has the same name."""
FRAMEWORKS = ("InternVLA-M1", "InternVLA_M1")
# Per name: width, blocks, heads.
_DINO = {"dinov2_vits14": (384, 12, 6), "dinov2_vitb14": (768, 12, 12), "dinov2_vitl14": (1024, 24, 16)}
_DIT = {"DiT-S": (384, 6, 4), "DiT-B": (768, 12, 12), "DiT-L": (1024, 24, 16)}


class DinoConfig(ConfigFile):
    """DINOv2: width, blocks, heads; the side its positions were trained for, of a patch, of its pictures."""

    width: Count = Field(validation_alias="embed_dim")
    blocks: Count = Field(validation_alias="depth")
    heads: Count = Field(validation_alias="num_heads")
    trained_side: Count = Field(default=518, validation_alias="img_size")
    patch: Count = Field(default=14, validation_alias="patch_size")
    side: Count = Field(default=224, validation_alias="px")


class QueryConfig(ConfigFile):
    """The querying transformer: hidden states `first` up to, not including, `last`; queries; widths; heads."""

    first: Index = Field(validation_alias="qformer_start_layer")
    last: Count = Field(validation_alias="qformer_end_layer")
    queries: Count = Field(validation_alias="num_query_tokens")
    inputs: Count = Field(validation_alias="input_dim")
    # The released files misspell the name.
    width: Count = Field(validation_alias=AliasChoices("ouptput_dim", "output_dim"))
    heads: Count = Field(default=8, validation_alias="qformer_heads")


class HeadConfig(ConfigFile):
    """The diffusion head: width, blocks, heads, numbers and length of a chunk, training steps, noise schedule."""

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
        """Actions of a chunk: the next, and those behind it."""
        return self.future + 1


class InternVLAConfig(ConfigFile):
    """A checkpoint's configuration.

    base: the vision-language model the run was made of, as its file names it. cot: the prompt around the
    instruction, None for the instruction alone. picture: (width, height) the model resizes pictures to, if any.
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
        """Read the content of the files; vlm: of Qwen2.5-VL's config.json. Raises CheckpointError."""
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


def _sizes_of(name: str, table: Mapping[str, tuple[int, int, int]], field: str, source: str) -> dict[str, int]:
    """The sizes of a released part, under the names that `dims.json` has."""
    if name not in table:
        raise CheckpointError(
            f"{source}: {field} {name!r} is not one of {', '.join(table)}; "
            f"give its sizes in a {DIMS_FILE} beside {RUN_FILE}"
        )
    width, blocks, heads = table[name]
    return {"embed_dim": width, "token_size": width, "depth": blocks, "num_heads": heads}
