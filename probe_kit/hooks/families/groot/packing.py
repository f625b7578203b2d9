"""Prompts of GR00T: settings of its processor files, pictures as lerobot and NVIDIA resize them, and chats."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
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
from safetensors.torch import load_file
from torch import Tensor
from torchvision.transforms.v2 import functional
from transformers import AutoTokenizer, Qwen2VLImageProcessor, Qwen3VLProcessor, Qwen3VLVideoProcessor

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.checkpoints.checkpoint import shard_name
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE
from probe_kit.hooks.families.shared.lerobot.flow import PackedRow, chat_labels
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    POSTPROCESSOR,
    PREPROCESSOR,
    SavedStep,
    check_pipelines,
    check_values,
    saved_steps,
)
from probe_kit.models.checkpoint_files import load_pretrained

PROCESSOR_FILE = "processor_config.json"
_FLAG = (True, False)
_OFF = (False, None)
_ANY = None
_TOP: Mapping[str, tuple[Any, ...] | None] = {
    "processor_class": ("Gr00tN1d7Processor",),
    "processor_kwargs": _ANY,
}
_SETTINGS: Mapping[str, tuple[Any, ...] | None] = {
    **dict.fromkeys(
        ("modality_configs", "max_action_horizon", "max_state_dim", "max_action_dim", "image_crop_size",
         "image_target_size", "shortest_image_edge", "crop_fraction"), _ANY,
    ),
    **dict.fromkeys(
        ("use_percentiles", "clip_outliers", "formalize_language", "use_relative_action", "use_albumentations",
         "letter_box_transform", "apply_sincos_state_encoding", "exclude_state"), _FLAG,
    ),
    # Of training, or of a model that the network's configuration names too.
    **dict.fromkeys(
        ("random_rotation_angle", "color_jitter_params", "extra_augmentation_config", "state_dropout_prob",
         "model_name", "transformers_loading_kwargs"), _ANY,
    ),
    "model_type": ("qwen",),
    # NVIDIA's processor stores it and reads it nowhere: nothing says what a checkpoint that has it was trained on.
    "use_mean_std": _OFF,
    "use_tactile": _OFF,
    **dict.fromkeys(("tactile_state_keys", "tactile_input_shape", "tactile_embed_dim"), _ANY),
}  # fmt: skip
_MODALITIES = dict.fromkeys(("video", "state", "action", "language"), _ANY)
_MODALITY: Mapping[str, tuple[Any, ...] | None] = {
    **dict.fromkeys(
        ("delta_indices", "modality_keys", "sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"),
        _ANY,
    ),
    "exclude_state": (*_FLAG, None),
}
_ACTION = dict.fromkeys(("rep", "type", "format", "state_key"), _ANY)


@dataclass(frozen=True)
class StateFields:
    """The state of one embodiment.

    Attributes:
        excluded: Whether the network reads zeros.
        angles: Groups that are read as sine and cosine.
        deviations: Groups of the state that are mapped by mean and deviation.
        action_deviations: Groups of the action that are mapped by mean and deviation.
    """

    excluded: bool
    angles: tuple[str, ...]
    deviations: tuple[str, ...]
    action_deviations: tuple[str, ...]


def processor_settings(folder: Path) -> dict[str, Any]:
    """Return the settings in `processor_config.json`.

    Raises:
        CheckpointError: For a setting that may change numbers unseen.
    """
    path = folder / PROCESSOR_FILE
    content = read_json_object(path, CheckpointError, "Download the checkpoint again")
    check_values(content, _TOP, str(path))
    settings = content.get("processor_kwargs")
    if not isinstance(settings, dict):
        raise CheckpointError(f"{path} has no processor_kwargs with fields. Download the checkpoint again")
    check_values(settings, _SETTINGS, str(path))
    for name in ("image_crop_size", "image_target_size"):
        _check_pair(path, name, settings.get(name))
    _check_number(path, "shortest_image_edge", settings.get("shortest_image_edge"), int, 1 << 16)
    _check_number(path, "crop_fraction", settings.get("crop_fraction"), (int, float), 1)
    return settings


def read_state_fields(folder: Path, settings: Mapping[str, Any], tag: str) -> StateFields:
    """Return the settings of the processor file for the state of embodiment `tag`.

    Raises:
        CheckpointError: For several frames of the state, and for a field that may change numbers unseen.
    """
    path = folder / PROCESSOR_FILE
    modalities = settings.get("modality_configs", {}).get(tag, {})
    check_values(modalities, _MODALITIES, f"{path}: {tag}")
    for name, modality in modalities.items():
        if not isinstance(modality, dict):
            raise CheckpointError(
                f"{path}: {name} of {tag} is {modality!r}; expected fields such as modality_keys"
            )
        check_values(modality, _MODALITY, f"{path}: {name} of {tag}")
        for action in modality.get("action_configs") or ():
            check_values(action, _ACTION, f"{path}: an action of {tag}")
    state, action = modalities.get("state", {}), modalities.get("action", {})
    if (frames := state.get("delta_indices", [0])) != [0]:
        raise CheckpointError(
            f"{path}: {tag} reads states of the steps {frames} (delta_indices); every inference here is given "
            "that of step 0. Take a checkpoint that reads one"
        )
    angles = _groups(path, state, "sin_cos_embedding_keys") if settings.get("apply_sincos_state_encoding") else ()
    return StateFields(
        excluded=bool(settings.get("exclude_state") or state.get("exclude_state")),
        angles=angles,
        # NVIDIA's processor looks for angles first.
        deviations=tuple(key for key in _groups(path, state, "mean_std_embedding_keys") if key not in angles),
        action_deviations=_groups(path, action, "mean_std_embedding_keys"),
    )


def check_widths(folder: Path, settings: Mapping[str, Any], network: Mapping[str, Any]) -> None:
    """Raise CheckpointError where processor and network say different widths of state or action."""
    for name in ("max_state_dim", "max_action_dim"):
        width, other = settings.get(name), network.get(name)
        if width is not None and other is not None and width != other:
            raise CheckpointError(
                f"{folder / PROCESSOR_FILE} says {name}: {width}, config.json {other}. The network reads the "
                "latter: take the original files"
            )


def _groups(path: Path, modality: Mapping[str, Any], field: str) -> tuple[str, ...]:
    """Return the groups that a field lists.

    Raises:
        CheckpointError: For a group that the modality does not have.
    """
    listed = modality.get(field) or []
    keys = modality.get("modality_keys", [])
    if not isinstance(listed, list) or (strange := [key for key in listed if key not in keys]):
        raise CheckpointError(
            f"{path} says {field}: {listed!r}; expected groups of {keys!r}. Take the original file"
            + (f" (unknown: {', '.join(map(str, strange))})" if isinstance(listed, list) else "")
        )
    return tuple(listed)


def _check_pair(path: Path, name: str, value: Any) -> None:
    sides = value if isinstance(value, list) else []
    if value is not None and not (len(sides) == 2 and all(type(side) is int and side > 0 for side in sides)):
        raise CheckpointError(f"{path} says {name}: {value!r}; expected height and width in pixels")


def _check_number(path: Path, name: str, value: Any, kind: Any, most: int) -> None:
    if value is not None and (isinstance(value, bool) or not isinstance(value, kind) or not 0 < value <= most):
        raise CheckpointError(f"{path} says {name}: {value!r}; expected a number above 0 and at most {most}")


# -- pictures -------------------------------------------------------------------------------------------------

NVIDIAS_VERSION = "gr00t_n1d7 of Isaac-GR00T, commit 1852a8c of 2026"
"""The newest code of NVIDIA that was read."""
_EDGE, _FRACTION = 256, 0.95
"""The values that NVIDIA's processor takes for fields that a file lacks."""


@dataclass
class NvidiasPictures(GrootN17VLMEncodeStep):  # type: ignore[misc]
    """The step of lerobot with NVIDIA's resizing in place of its own.

    NVIDIA squashes to the target size, bilinearly, and cuts pixels out; lerobot is bicubic and cuts a fraction.
    With `use_albumentations` both bring the shortest edge to a length by area; without a length, NVIDIA squashes.
    """

    def __post_init__(self) -> None:
        """Raise CheckpointError for sizes that are missing: NVIDIA's code has no others."""
        missing = [name for name in ("image_target_size", "image_crop_size") if getattr(self, name) is None]
        needed = not self.use_albumentations or (self.shortest_image_edge is None or self.crop_fraction is None)
        if missing and needed:
            raise CheckpointError(
                f"the processor file has no {' and no '.join(missing)}, without which NVIDIA's code resizes no "
                "picture. Take the original file, or -M resize=lerobot for lerobot's default"
            )

    def _build_sample_images(self, video: Any, batch_size: int, target_device: Any) -> list[list[Tensor]]:
        """Return (3, H, W) uint8 per frame and camera of a `video` (B, T, V, H, W, 3) uint8."""
        del target_device
        pictures = np.asarray(video)
        return [
            [self.resized(np.ascontiguousarray(picture)) for frames in pictures[row] for picture in frames]
            for row in range(batch_size)
        ]

    def resized(self, picture: NDArray[np.uint8]) -> Tensor:
        """Resize a picture (H, W, 3) uint8 to (3, H, W) uint8."""
        square = _letterbox(picture) if self.letter_box_transform else picture
        if self.use_albumentations:
            return torch.from_numpy(np.ascontiguousarray(self._by_area(square))).permute(2, 0, 1)
        tensor = torch.from_numpy(square).permute(2, 0, 1)
        target, crop = list(self.image_target_size or ()), list(self.image_crop_size or ())
        cut = functional.center_crop(functional.resize(tensor, target), crop)
        resized: Tensor = functional.resize(cut, target)
        return resized

    def _by_area(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resize, cut, and resize again."""
        target, crop = self.image_target_size or [1, 1], self.image_crop_size or [1, 1]
        fraction = crop[0] / target[0] if self.crop_fraction is None else self.crop_fraction
        first = self._one_size(picture)
        height, width = (max(1, int(side * fraction)) for side in first.shape[:2])
        top, column = (first.shape[0] - height) // 2, (first.shape[1] - width) // 2
        return self._one_size(first[top : top + height, column : column + width])

    def _one_size(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a picture with the shortest edge at its length, or squashed where there is none."""
        if self.shortest_image_edge is None:
            height, width = self.image_target_size or [1, 1]
        else:
            scale = self.shortest_image_edge / min(picture.shape[:2])
            height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
        if (height, width) == picture.shape[:2]:
            return picture
        resized: NDArray[np.uint8] = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
        return resized

    @property
    def rule(self) -> str:
        """The rule in words, for the card."""
        size = " x ".join(map(str, self.image_target_size or ()))
        if not self.use_albumentations:
            return f"squashed to {size} bilinearly, as {NVIDIAS_VERSION}; lerobot is bicubic (-M resize=lerobot)"
        if self.shortest_image_edge is None:
            return f"squashed to {size} by area, as {NVIDIAS_VERSION}; lerobot does not squash (-M resize=lerobot)"
        return f"shortest edge {self.shortest_image_edge} by area, as {NVIDIAS_VERSION}, and lerobot"


def nvidias_pictures(step: GrootN17VLMEncodeStep, settings: Mapping[str, Any] | None) -> NvidiasPictures:
    """Return the step with NVIDIA's resizing.

    Args:
        step: The step of lerobot.
        settings: The settings of its processor file, whose missing fields have NVIDIA's values; None in lerobot's
            layout.
    """
    values = {field.name: getattr(step, field.name) for field in fields(GrootN17VLMEncodeStep) if field.init}
    if settings is not None:
        values |= {name: settings.get(name) for name in ("image_target_size", "image_crop_size")}
        values["shortest_image_edge"] = settings.get("shortest_image_edge", _EDGE)
        values["crop_fraction"] = settings.get("crop_fraction", _FRACTION)
    return NvidiasPictures(**values)


def lerobots_rule(step: GrootN17VLMEncodeStep) -> str:
    """The resizing of lerobot's own step in words, for the card."""
    kind = "by area" if step.use_albumentations else "squashed, bicubic"
    return f"{kind}, as lerobot {version('lerobot')}; NVIDIA's code differs (-M resize=nvidia)"


def _letterbox(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pad a picture (H, W, 3) to (side, side, 3), with black bars on both ends."""
    height, width = picture.shape[:2]
    side = max(height, width)
    rows, columns = side - height, side - width
    return np.pad(picture, ((rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2), (0, 0)))


# -- prompts --------------------------------------------------------------------------------------------------

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
"""The steps that change no number: observations come here under the names of the policy."""


@dataclass(frozen=True)
class Steps:
    """The steps of lerobot for one checkpoint: packing, pictures and words, actions.

    Attributes:
        source: The files they come from, for messages.
        fields: The fields of NVIDIA's processor file for the state; None in lerobot's layout.

    Raises:
        CheckpointError: For an embodiment without a number.
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
    """Return the steps that lerobot makes of NVIDIA's files, or of the pipelines that it saved.

    Args:
        folder: The folder of the checkpoint.
        config: The configuration of lerobot.
        resize: `nvidia` or `lerobot`, whose code brings pictures to their size; None for the layout's own.
        letterbox: Whether pictures are made square with bars first; None for what the files say.

    Raises:
        CheckpointError: For files that are missing, and for a step or field that is not known here.
    """
    settings = processor_settings(folder) if is_raw_groot_n1_7_checkpoint(folder) else None
    steps = _lerobots_steps(folder, config) if settings is None else _nvidias_steps(folder, config, settings)
    encode = steps.encode if letterbox is None else replace(steps.encode, letter_box_transform=letterbox)
    if (resize or ("lerobot" if settings is None else "nvidia")) == "nvidia":
        encode = nvidias_pictures(encode, settings)
    return replace(steps, encode=encode)


def _nvidias_steps(folder: Path, config: GrootConfig, settings: Mapping[str, Any]) -> Steps:
    fields = read_state_fields(folder, settings, str(config.embodiment_tag))
    with while_reading(folder / PROCESSOR_FILE):
        before, behind = make_groot_pre_post_processors(config)
    read = _select_steps([*before.steps, *behind.steps], "processor_config.json and statistics.json")
    return replace(read, fields=fields)


def _lerobots_steps(folder: Path, config: GrootConfig) -> Steps:
    check_pipelines(folder)
    saved = [(name, step) for name in (PREPROCESSOR, POSTPROCESSOR) for step in saved_steps(folder, name)]
    steps = [_build_step(folder, name, step) for name, step in saved if step.name not in _HARMLESS]
    # What the configuration says of the gripper counts, as in lerobot, not what the step was saved with.
    _apply_groot_action_decode_transform(SimpleNamespace(steps=steps), config.action_decode_transform)
    return _select_steps(steps, "policy_preprocessor.json and policy_postprocessor.json")


def _build_step(folder: Path, pipeline: str, saved: SavedStep) -> Any:
    """Build lerobot's object of a saved step of a pipeline; never by the name of a class, which could be any.

    Raises:
        CheckpointError: For an unknown step, for one that cannot be built, and for statistics that are missing.
    """
    if saved.name not in _STEPS:
        raise CheckpointError(
            f"{folder} has the step {saved.name!r}, which changes numbers in a way probe_kit does not know. Known "
            f"are {', '.join((*_STEPS, *_HARMLESS))}"
        )
    with while_reading(folder / f"{pipeline}.json", advice="Save it with lerobot's own pipeline"):
        step = _STEPS[saved.name](**saved.config)
    if saved.state is not None:
        file = folder / shard_name(saved.state)
        if not file.is_file():
            raise CheckpointError(f"{file} is missing: it holds the statistics of {saved.name}")
        with while_reading(file, advice="Download the checkpoint again"):
            step.load_state_dict(load_file(file))
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


class GrootPacking:
    """The packing of lerobot: pictures, words and state become the inputs of the network."""

    def __init__(self, steps: Steps, vlm: Path) -> None:
        """Take the steps that pack; `vlm` is the folder of tokenizer and processor files."""
        # The state comes here in the network's own numbers, and pictures are made on the CPU, on every machine.
        self.pack = replace(steps.pack, normalize_min_max=False, training=False)
        self.encode = replace(steps.encode, training=False, device=None)
        self.vlm = vlm

    @cached_property
    def processor(self) -> Any:
        """The processor of Qwen3-VL in transformers, as lerobot puts it together.

        Raises:
            CheckpointError: For missing files, and for a tokenizer without a chat template.
        """
        folder = str(self.vlm)
        try:
            tokenizer = load_pretrained(AutoTokenizer, folder)
            processor = Qwen3VLProcessor(
                image_processor=load_pretrained(Qwen2VLImageProcessor, folder),
                tokenizer=tokenizer,
                video_processor=load_pretrained(Qwen3VLVideoProcessor, folder),
                chat_template=tokenizer.chat_template,
            )
        except (CheckpointError, OSError, ValueError) as error:
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
        """The tokenizer of the vision-language model."""
        return self.processor.tokenizer

    def order(self, cameras: Sequence[str]) -> list[str]:
        """The cameras in the order in which the network gets their pictures."""
        keys = self.pack._ordered_image_keys({f"{IMAGES}{camera}": None for camera in cameras})
        return [key.removeprefix(IMAGES) for key in keys]

    def row(self, pictures: Mapping[str, NDArray[np.uint8]], task: str, state: NDArray[np.float32]) -> PackedRow:
        """Pack one row.

        Args:
            pictures: (H, W, 3) by camera.
            task: The instruction.
            state: (D,) as the network reads it.

        Raises:
            InstructionError: For an instruction without words.
        """
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
        """Return the one row: its bridge reads padding, so several make no batch."""
        return rows[0].inputs if len(rows) == 1 else {}
