"""Units, settings of processor steps, and prompts of MolmoAct2."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.molmoact2.processor_molmoact2 import MolmoAct2PackInputsProcessorStep
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import CheckpointError, InstructionError, ObservationError
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.families.shared.kinds import STATE
from probe_kit.hooks.families.shared.lerobot.flow import PackedRow, label_groups
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser
from probe_kit.hooks.families.shared.lerobot.pipelines import MASKED, check_same, step_fields
from probe_kit.models.checkpoint_files import while_reading_pretrained


@dataclass(frozen=True)
class JointFrame:
    """The first joints in the data set's convention: sign times joint, plus offset.

    Attributes:
        signs: 1 or -1 per joint.
        offsets: One per joint, in the data set's units.
    """

    signs: NDArray[np.float32]
    offsets: NDArray[np.float32]

    def entered(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values (..., D) of the robot as the data set has them."""
        mapped, joints = np.array(values, np.float32), len(self.signs)
        mapped[..., :joints] = self.signs * mapped[..., :joints] + self.offsets
        return mapped

    def left(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values (..., D) of the data set as the robot has them."""
        mapped, joints = np.array(values, np.float32), len(self.signs)
        mapped[..., :joints] = self.signs * (mapped[..., :joints] - self.offsets)
        return mapped


SAME_FRAME = JointFrame(np.zeros(0, np.float32), np.zeros(0, np.float32))
"""The frame of a robot with the data set's convention."""


@dataclass(frozen=True)
class FramedUnits(Normaliser):
    """Statistics of joints in the data set's frame."""

    frame: JointFrame = SAME_FRAME

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map physical units (..., D) to the numbers the network reads.

        Raises:
            ObservationError: For a number that stays as it is and lies outside -1 to 1, as lerobot does.
        """
        entered = self.frame.entered(values)
        outside = (np.abs(entered) > 1) & self.plain
        if outside.any():
            number = int(np.argwhere(outside)[0][-1])
            raise ObservationError(
                f"number {number} of the state is {entered[outside][0]:g}; this checkpoint reads it as it is, "
                "between -1 and 1 (normalize_gripper is off). Give it in these units"
            )
        return super().normalise(entered)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map network output (..., D) to physical units."""
        return self.frame.left(super().restore(values))

    def slopes(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the slopes of `restore` (..., D) at these outputs of the network; 0 where it clips."""
        slopes = super().slopes(values)
        slopes[..., : len(self.frame.signs)] *= self.frame.signs
        return slopes

    @property
    def statistics(self) -> FeatureStatistics | None:
        """The statistics in the frame of the robot, whose values are compared."""
        statistics, joints = super().statistics, len(self.frame.signs)
        if statistics is None:
            return None
        slopes, offsets = np.ones(statistics.width), np.zeros(statistics.width)
        slopes[:joints], offsets[:joints] = self.frame.signs, -self.frame.signs * self.frame.offsets
        return statistics.mapped(slopes, offsets)


# -- settings of processor steps ------------------------------------------------------------------------------

_PACK, _CLAMP_STATE, _CLAMP_ACTION = (
    "molmoact2_pack_inputs",
    "molmoact2_clamp_normalized",
    "molmoact2_clamp_action",
)
_FRAMES = ("molmoact2_state_frame_transform", "molmoact2_action_frame_transform")
STEPS = (*MASKED, _PACK, _CLAMP_STATE, _CLAMP_ACTION, *_FRAMES)
_PACKED = (
    "image_keys", "setup_type", "control_mode", "normalize_language", "add_setup_tokens", "add_control_tokens",
    "num_state_tokens", "max_sequence_length",
)  # fmt: skip
"""The fields of the configuration that the packing step has too."""
_SAME = {
    "checkpoint_path": "checkpoint_path",
    "chunk_size": "chunk_size",
    "max_action_dim": "expected_max_action_dim",
}
"""The fields of the packing step that are read from the configuration, under its name."""


def read_steps(config: Any, folder: Path) -> None:
    """Put what the saved steps say into lerobot's configuration; without a packing step, it says so itself.

    `state_frame` and `action_frame` are frames of the joints. `clamps_state` and `clamps_action` say whether
    numbers are moved to -1 to 1. `unclamped` is (D,), True for numbers of the state that the clamp leaves out;
    None for those without statistics.

    Raises:
        CheckpointError: For frames that are none, and for a packing step of another configuration.
    """
    saved = step_fields(folder)
    if (packing := saved.get(_PACK)) is None:
        config.state_frame = config.action_frame = _frame(vars(config), folder)
        config.clamps_state, config.clamps_action, config.unclamped = True, True, None
        return
    check_same(folder, _PACK, packing, {name: getattr(config, theirs) for name, theirs in _SAME.items()})
    for name in _PACKED:
        if name in packing:
            setattr(config, name, packing[name])
    config.state_frame, config.action_frame = (_frame(saved.get(name, {}), folder) for name in _FRAMES)
    scaled = (saved.get(_CLAMP_STATE, {}).get("normalization_masks") or {}).get(STATE, [])
    config.clamps_state, config.clamps_action = _CLAMP_STATE in saved, _CLAMP_ACTION in saved
    config.unclamped = ~np.array(scaled, bool)


def _frame(fields: Mapping[str, Any], folder: Path) -> JointFrame:
    signs, offsets = fields.get("joint_signs"), fields.get("joint_offsets")
    if signs is None or offsets is None:
        return SAME_FRAME
    if len(signs) != len(offsets) or not set(signs) <= {1, -1}:
        raise CheckpointError(
            f"{folder} has joint_signs {signs} and joint_offsets {offsets}; expected 1 or -1, and one offset each"
        )
    return JointFrame(np.array(signs, np.float32), np.array(offsets, np.float32))


def in_packed_order(config: Any, folder: Path) -> dict[str, Any]:
    """Return the input features with the pictures that the packing reads, in its order.

    Raises:
        CheckpointError: For a picture that the configuration does not have.
    """
    if not config.image_keys:
        return dict(config.input_features)
    if missing := [key for key in config.image_keys if key not in config.input_features]:
        raise CheckpointError(f"{folder} packs {', '.join(missing)}, which its configuration does not have")
    pictures = {key: config.input_features[key] for key in config.image_keys}
    other_features = {
        key: feature for key, feature in config.input_features.items() if key not in config.image_features
    }
    return {**pictures, **other_features}


# -- prompts --------------------------------------------------------------------------------------------------

_PROMPT = re.compile(
    r"The task is to (?P<language>.*)\. The setup is .*<state_start>(?P<state>(?:<state_\d+>)*)<state_end>",
    re.DOTALL,
)
_TEXT = ("input_ids", "attention_mask", "token_type_ids")
_PICTURES = ("pixel_values", "image_token_pooling", "image_grids", "image_num_crops")


class MolmoActPacking:
    """The packing of lerobot: pictures, words and state become the inputs of the network."""

    def __init__(self, config: Any, actions: int) -> None:
        """Make the packing step of lerobot from its configuration; `actions` counts the numbers of an action."""
        with while_reading_pretrained(Path(config.checkpoint_path), "AutoProcessor"):
            self.step = MolmoAct2PackInputsProcessorStep(
                checkpoint_path=config.checkpoint_path,
                action_mode="continuous",
                setup_type=config.setup_type,
                control_mode=config.control_mode,
                normalize_language=config.normalize_language,
                add_setup_tokens=config.add_setup_tokens,
                add_control_tokens=config.add_control_tokens,
                num_state_tokens=config.num_state_tokens,
                max_sequence_length=config.max_sequence_length,
                chunk_size=config.chunk_size,
                max_action_dim=config.expected_max_action_dim,
                env_action_dim=actions,
            )
            self.tokenizer = self.step.processor.tokenizer

    def row(self, pictures: dict[str, NDArray[np.uint8]], task: str, state: NDArray[np.float32]) -> PackedRow:
        """Pack one row.

        Args:
            pictures: (H, W, 3) by camera.
            task: The instruction.
            state: (D,) as the network reads it.

        Raises:
            InstructionError: For a prompt that does not fit.
        """
        self.step.image_keys = [f"observation.images.{camera}" for camera in pictures]
        observation: dict[str, Any] = {
            f"observation.images.{camera}": picture for camera, picture in pictures.items()
        }
        try:
            packed = self.step(
                {
                    TransitionKey.OBSERVATION: {**observation, STATE: torch.from_numpy(state[None])},
                    TransitionKey.COMPLEMENTARY_DATA: {"task": [task]},
                }
            )[TransitionKey.COMPLEMENTARY_DATA]
        except ValueError as error:
            if "max_sequence_length" not in str(error):
                raise
            raise InstructionError(
                f"{task!r} does not fit this checkpoint's prompt ({error}). Shorten it"
            ) from error
        inputs = {name: packed[name] for name in (*_TEXT, *_PICTURES, "action_dim_is_pad")}
        return PackedRow(inputs, self._labels(inputs, list(pictures)))

    def _labels(self, inputs: dict[str, Tensor], cameras: Sequence[str]) -> list[str]:
        """Return the labels: a patch is its camera's; the instruction is `language`.

        The state's tokens are `state`.
        """
        pieces = self.tokenizer.convert_ids_to_tokens(inputs["input_ids"][0].tolist())
        labels = label_groups([piece.replace("\u0120", " ").replace("\u010a", "\n") for piece in pieces], _PROMPT)
        patches = iter(
            f"image.{camera}"
            for camera, (low, across, high, wide) in zip(cameras, inputs["image_grids"].tolist(), strict=True)
            for _ in range(low * across + high * wide)
        )
        patch = self.step.processor.image_token_ids[0]
        return [
            next(patches) if token == patch else label
            for token, label in zip(inputs["input_ids"][0].tolist(), labels, strict=True)
        ]

    def batch(self, rows: Sequence[PackedRow]) -> dict[str, Tensor]:
        """Return the rows as one batch; shorter ones are padded behind their end."""
        longest = max(len(row.labels) for row in rows)
        fill = {"input_ids": int(self.tokenizer.pad_token_id), "attention_mask": 0, "token_type_ids": 0}
        text = {
            name: torch.cat(
                [
                    torch.nn.functional.pad(row.inputs[name], (0, longest - len(row.labels)), value=fill[name])
                    for row in rows
                ]
            )
            for name in _TEXT
        }
        unpadded = {
            name: torch.cat([row.inputs[name] for row in rows]) for name in (*_PICTURES, "action_dim_is_pad")
        }
        return text | unpadded
