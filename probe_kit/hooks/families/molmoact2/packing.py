"""The inputs of MolmoAct2: lerobot's packing of each observation alone, then padding behind it.

lerobot pads in front and counts positions from the padding on. The expert reads rotated keys, so that an action
there depends on the longest prompt of its batch. Here each row is what it is alone.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.molmoact2.processor_molmoact2 import MolmoAct2PackInputsProcessorStep
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import InstructionError
from probe_kit.hooks.families.shared.lerobot.features import STATE
from probe_kit.hooks.families.shared.lerobot.packed import PackedRow
from probe_kit.hooks.families.shared.lerobot.state_prompt import label_groups

_PROMPT = re.compile(
    r"The task is to (?P<language>.*)\. The setup is .*<state_start>(?P<state>(?:<state_\d+>)*)<state_end>",
    re.DOTALL,
)
_TEXT = ("input_ids", "attention_mask", "token_type_ids")
_PICTURES = ("pixel_values", "image_token_pooling", "image_grids", "image_num_crops")


class Packing:
    """lerobot's packing of pictures, words and state into the inputs of the network."""

    def __init__(self, config: Any, actions: int) -> None:
        """actions: numbers of an action. The rest is in lerobot's configuration."""
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
        """One row. pictures: (H, W, 3) by camera. Raises InstructionError for a prompt that does not fit."""
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
        """Each patch is its camera's; the instruction is `language`, the state's tokens are `state`."""
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
        """The rows as one batch; shorter ones are padded behind their end."""
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
