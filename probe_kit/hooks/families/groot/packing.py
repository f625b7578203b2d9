"""The inputs of GR00T: lerobot's own processor steps, from the files of a checkpoint, without remote code."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.groot.configuration_groot import GrootConfig, is_raw_groot_n1_7_checkpoint
from lerobot.policies.groot.processor_groot import (
    GrootActionUnpackUnnormalizeStep,
    GrootN17ActionDecodeStep,
    GrootN17PackInputsStep,
    GrootN17VLMEncodeStep,
    _apply_groot_action_decode_transform,
    make_groot_pre_post_processors,
)
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from transformers import AutoTokenizer, Qwen2VLImageProcessor, Qwen3VLProcessor, Qwen3VLVideoProcessor

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.checkpoints.checkpoint import shard_name
from probe_kit.hooks.families.groot.pictures import nvidias_pictures
from probe_kit.hooks.families.groot.processor_fields import StateFields, processor_settings, read_state_fields
from probe_kit.hooks.families.shared.lerobot.features import IMAGES, STATE
from probe_kit.hooks.families.shared.lerobot.packed import PackedRow, chat_labels
from probe_kit.models.pretrained import load_pretrained

_READ = (
    "input_ids", "attention_mask", "pixel_values", "image_grid_thw", "mm_token_type_ids", "embodiment_id"
)  # fmt: skip
_STEPS: Mapping[str, type[Any]] = {
    "groot_n1_7_pack_inputs_v1": GrootN17PackInputsStep,
    "groot_n1_7_vlm_encode_v1": GrootN17VLMEncodeStep,
    "groot_n1_7_action_decode_v1": GrootN17ActionDecodeStep,
    "groot_action_unpack_unnormalize_v2": GrootActionUnpackUnnormalizeStep,
}
_HARMLESS = ("rename_observations_processor", "to_batch_processor", "device_processor")
"""Steps that change no number: observations come here under the names of the policy."""


@dataclass(frozen=True)
class Steps:
    """lerobot's steps of one checkpoint: packing, pictures and words, actions. source: where they come from.

    fields: what NVIDIA's processor file says of the state; None in lerobot's layout.
    """

    pack: GrootN17PackInputsStep
    encode: GrootN17VLMEncodeStep
    decode: GrootN17ActionDecodeStep | GrootActionUnpackUnnormalizeStep
    source: str
    fields: StateFields | None = None

    def __post_init__(self) -> None:
        if (tag := self.pack.embodiment_tag) not in self.pack.embodiment_mapping:
            tags = ", ".join(sorted(self.pack.embodiment_mapping))
            raise CheckpointError(f"{self.source} gives {tag!r} no number; it has {tags}")


def read_steps(
    folder: Path, config: GrootConfig, resize: str | None = None, letterbox: bool | None = None
) -> Steps:
    """The steps that lerobot makes of NVIDIA's files, or of the pipelines that it saved.

    resize: `nvidia` or `lerobot`, whose code brings pictures to their size; None for the layout's own. letterbox:
    whether pictures are made square with bars first; None for what the files say.
    Raises CheckpointError for files that are missing, and for a step or field that is not known here.
    """
    settings = processor_settings(folder) if is_raw_groot_n1_7_checkpoint(folder) else None
    steps = _lerobots_steps(folder, config) if settings is None else _nvidias_steps(folder, config, settings)
    encode = steps.encode if letterbox is None else replace(steps.encode, letter_box_transform=letterbox)
    if (resize or ("lerobot" if settings is None else "nvidia")) == "nvidia":
        encode = nvidias_pictures(encode, settings)
    return replace(steps, encode=encode)


def _nvidias_steps(folder: Path, config: GrootConfig, settings: Mapping[str, Any]) -> Steps:
    fields = read_state_fields(folder, settings, str(config.embodiment_tag))
    before, behind = make_groot_pre_post_processors(config)
    read = _select_steps([*before.steps, *behind.steps], "processor_config.json and statistics.json")
    return replace(read, fields=fields)


def _lerobots_steps(folder: Path, config: GrootConfig) -> Steps:
    steps = []
    for name in ("policy_preprocessor", "policy_postprocessor"):
        path = folder / f"{name}.json"
        if not path.is_file():
            raise CheckpointError(f"{path} is missing: without it pictures, state and actions have no meaning")
        content = read_json_object(path, CheckpointError, "Download the checkpoint again")
        steps += [step for entry in content.get("steps", []) if (step := _saved(folder, path, entry)) is not None]
    # What the configuration says of the gripper counts, as in lerobot, not what the step was saved with.
    _apply_groot_action_decode_transform(SimpleNamespace(steps=steps), config.action_decode_transform)
    return _select_steps(steps, "policy_preprocessor.json and policy_postprocessor.json")


def _saved(folder: Path, path: Path, entry: Mapping[str, Any]) -> Any:
    """One step of a saved pipeline; never by the name of a class, which could be any."""
    name = str(entry.get("registry_name"))
    if name in _HARMLESS:
        return None
    if name not in _STEPS:
        raise CheckpointError(
            f"{path} has the step {name!r}, which changes numbers in a way probe_kit does not know. Known are "
            f"{', '.join((*_STEPS, *_HARMLESS))}"
        )
    try:
        step = _STEPS[name](**entry.get("config", {}))
    except TypeError as error:
        raise CheckpointError(f"{path}: the step {name} cannot be built ({error})") from error
    if (state := entry.get("state_file")) is not None:
        file = folder / shard_name(state)
        if not file.is_file():
            raise CheckpointError(f"{file} is missing: it holds the statistics of {name}")
        try:
            step.load_state_dict(load_file(file))
        except (SafetensorError, OSError, RuntimeError) as error:
            raise CheckpointError(f"{file} cannot be read ({error}); download the checkpoint again") from error
    return step


def _select_steps(steps: Sequence[Any], source: str) -> Steps:
    kinds = (
        GrootN17PackInputsStep,
        GrootN17VLMEncodeStep,
        (GrootN17ActionDecodeStep, GrootActionUnpackUnnormalizeStep),
    )
    selected: list[Any] = [next((step for step in steps if isinstance(step, kind)), None) for kind in kinds]
    if None in selected:
        raise CheckpointError(f"{source} lack a step that packs, encodes or decodes")
    pack, encode, decode = selected
    return Steps(pack, encode, decode, source)


class Packing:
    """lerobot's packing of pictures, words and state into the inputs of the network."""

    def __init__(self, steps: Steps, vlm: Path) -> None:
        """vlm: folder of tokenizer and processor files."""
        # The state comes here in the network's own numbers, and pictures are made on the CPU, on every machine.
        self.pack = replace(steps.pack, normalize_min_max=False, training=False)
        self.encode = replace(steps.encode, training=False, device=None)
        self.vlm = vlm

    @cached_property
    def processor(self) -> Any:
        """transformers' processor of Qwen3-VL, as lerobot puts it together. Raises CheckpointError."""
        folder = str(self.vlm)
        try:
            tokenizer = load_pretrained(AutoTokenizer, folder)
            processor = Qwen3VLProcessor(
                image_processor=load_pretrained(Qwen2VLImageProcessor, folder),
                tokenizer=tokenizer,
                video_processor=load_pretrained(Qwen3VLVideoProcessor, folder),
                chat_template=tokenizer.chat_template,
            )
        except (OSError, ValueError) as error:
            raise CheckpointError(
                f"{folder} lacks the tokenizer or processor of the vision-language model ({error}). Pass its "
                "folder as -M vlm=FOLDER"
            ) from error
        if tokenizer.chat_template is None:
            raise CheckpointError(f"the tokenizer in {folder} has no chat template, and GR00T reads a chat")
        self.encode._proc = processor
        return processor

    @property
    def tokenizer(self) -> Any:
        """The vision-language model's."""
        return self.processor.tokenizer

    def order(self, cameras: Sequence[str]) -> list[str]:
        """The cameras in the order in which the network gets their pictures."""
        keys = self.pack._ordered_image_keys({f"{IMAGES}{camera}": None for camera in cameras})
        return [key.removeprefix(IMAGES) for key in keys]

    def row(self, pictures: Mapping[str, NDArray[np.uint8]], task: str, state: NDArray[np.float32]) -> PackedRow:
        """One row. pictures: (H, W, 3) by camera. state: (D,). Raises InstructionError for one without words."""
        processor = self.processor
        observation: dict[str, Any] = {
            f"{IMAGES}{camera}": torch.from_numpy(picture).permute(2, 0, 1)[None]
            for camera, picture in pictures.items()
        }
        cameras = self.order(list(pictures))
        transition: Any = {
            TransitionKey.OBSERVATION: {**observation, STATE: torch.from_numpy(state[None])},
            TransitionKey.COMPLEMENTARY_DATA: {self.pack.language_key: [task]},
        }
        packed: Any = self.pack(transition)
        if not packed[TransitionKey.COMPLEMENTARY_DATA]["language"][0].strip() or not task.strip():
            raise InstructionError(f"{task!r} has no word that GR00T reads: lerobot leaves out punctuation")
        packed = self.encode(packed)
        content = packed[TransitionKey.COMPLEMENTARY_DATA]
        inputs = {name: content[name] for name in _READ if name in content}
        inputs["state"] = packed[TransitionKey.OBSERVATION]["state"]
        frames = len(inputs["image_grid_thw"]) // len(cameras)
        picture, *words = self.tokenizer.convert_tokens_to_ids(
            [processor.image_token, "<|vision_end|>", "<|im_end|>"]
        )
        roles = [f"image.{camera}" for camera in cameras] * frames
        return PackedRow(
            inputs, chat_labels(inputs["input_ids"][0].tolist(), roles, picture, (words[0], words[1]))
        )

    def batch(self, rows: Sequence[PackedRow]) -> dict[str, Tensor]:
        """The one row: its bridge reads padding, so several make no batch."""
        return rows[0].inputs if len(rows) == 1 else {}
