"""The packing of a lerobot policy: units, pictures, prompts, roles, and what the arm can do with its actions.

All of it works without the network, from the files of the checkpoint alone.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import CheckpointError, InstructionError, ObservationError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import PADDING
from probe_kit.hooks.families.shared.feature_names import names_of
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE, cameras_of
from probe_kit.hooks.families.shared.lerobot.loading import ACTION_NAMES, LerobotFiles
from probe_kit.hooks.families.shared.lerobot.normaliser import (
    Normaliser,
    from_buffers,
    read_buffers,
    read_normaliser,
)
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    POSTPROCESSOR,
    PREPROCESSOR,
    adds_state,
    rename_map,
)
from probe_kit.hooks.families.shared.lerobot.window import PictureWindow, read_window

TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
UNCOMPARED = ("IDENTITY", "EXCLUDED")
"""The modes of units without statistics: the state is read as it is, or not at all."""
_DIMENSIONS = 7
"""The count of numbers of the arm's actions."""
TEXT_FILES = (*SMALL_FILES, "policy_*.safetensors")
"""The files that packing and tokenising read: of the weights only those of lerobot's processors."""


class LerobotPacking(LerobotFiles, Policy):
    """Observations in lerobot's keys, and actions in the arm's units; subclasses say how they pack their sequence.

    Attributes:
        folder: The folder of the checkpoint.
        checkpoint: The name by which `folder` was requested.
        config: The configuration of lerobot.
        cameras: Cameras that a picture can be given for.
        shown_cameras: Those that get one, in the configuration's order.
    """

    folder: Path
    checkpoint: str
    config: Any
    cameras: tuple[str, ...]
    shown_cameras: tuple[str, ...]
    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    """The roles of positions of the backbone besides pictures and padding."""
    acting_stream: ClassVar[str]
    suffix_roles: ClassVar[tuple[str, ...]] = ("action",)
    """The roles of positions of the acting stream."""

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """The role of every backbone position of one row, from those of its language positions."""
        return list(language)

    def suffix_labels(self) -> list[str]:
        """The role of every suffix position."""
        return ["action"] * int(self.config.chunk_size)

    @cached_property
    @abstractmethod
    def tokenizer(self) -> Any:
        """The checkpoint's tokenizer."""

    @property
    def state_numbers(self) -> int:
        """The count of numbers in the checkpoint's configuration."""
        return int(self.config.input_features[STATE].shape[0])

    @property
    def action_names(self) -> tuple[str, ...] | None:
        """The names in the configuration (`action_feature_names`), if there is one for each number."""
        return names_of(getattr(self.config, ACTION_NAMES, None), self._action_numbers)

    @property
    def _action_numbers(self) -> int:
        """The count of numbers of an action in the checkpoint's configuration."""
        return int(self.config.output_features["action"].shape[0])

    @property
    def state_statistics(self) -> FeatureStatistics | None:
        """The statistics of states in the file that normalises them, also those that the mode does not need."""
        return self.state_units.statistics

    @property
    def unguarded_state(self) -> str | None:
        """The reason also for a checkpoint that reads the state as it is, or without its units."""
        try:
            units = self.state_units
        except CheckpointError as error:
            return str(error)
        if units.mode.startswith(UNCOMPARED):
            return f"the state is {units.mode} by {units.source}"
        return None

    @property
    def action_statistics(self) -> FeatureStatistics | None:
        """The statistics of actions in the file that normalises them, also those that the mode does not need."""
        return self.action_units.statistics

    @cached_property
    def predicts_relative(self) -> bool:
        """Whether the configuration or a step says so: lerobot then adds the state, which is not done here."""
        return bool(getattr(self.config, "use_relative_actions", False)) or adds_state(self.folder)

    def embodiment_mismatch(self) -> str | None:
        """Return a reason for other actions than an end-effector delta, another state, or no units for either."""
        return self._action_misfit() or self._state_misfit()

    def zero_filled_inputs(self) -> tuple[str, ...]:
        """Return the state, where it has other numbers than the arm's, or no units."""
        return ("state",) if self._state_misfit() else ()

    def configured_mismatch(self) -> str | None:
        """Return a reason for other actions than an end-effector delta."""
        dimensions = self._action_numbers
        if dimensions != _DIMENSIONS:
            return f"{self.checkpoint} acts in {dimensions} dimensions; the arm needs a 7-DoF end-effector delta"
        if self.predicts_relative:
            return f"{self.checkpoint} predicts changes relative to the state, and nothing here adds the state"
        return None

    def _action_misfit(self) -> str | None:
        return self.configured_mismatch() or problem_of(lambda: self.action_units)

    def _state_misfit(self) -> str | None:
        example = self.laid_out(np.zeros((1, ARM_NUMBERS), np.float32)).shape[1]
        if example != self.state_numbers:
            return f"{self.checkpoint} reads {self.state_numbers} numbers as its state; the arm's are {example}"
        return problem_of(lambda: self.state_units)

    def check_pictures(self, batch: Mapping[str, Tensor]) -> None:
        """Raise ObservationError unless a batch in lerobot's keys has pictures in [0, 1]: lerobot never rescales.

        Its cameras must be those that are shown, in the configuration's order.
        """
        batch_cameras = [key.removeprefix(IMAGES) for key in batch if key.startswith(IMAGES)]
        if batch_cameras != list(self.shown_cameras):
            raise ObservationError(
                f"cameras {batch_cameras} given; this policy is shown "
                f"{list(self.shown_cameras)} of {list(self.cameras)}, in order"
            )
        for camera in batch_cameras:
            picture = batch[f"{IMAGES}{camera}"]
            if not picture.is_floating_point() or picture.min() < 0 or picture.max() > 1:
                raise ObservationError(
                    f"pictures of {camera} are {picture.dtype} outside [0, 1]; divide bytes by 255"
                )

    def batch(
        self, observations: Sequence[Observation], state: NDArray[np.float32] | None = None
    ) -> dict[str, Tensor]:
        """Return the observations in lerobot's keys; the environment's picture goes to the first camera.

        Args:
            observations: The B rows of the batch.
            state: (B, numbers) as the network reads them; None for that of the observations.
        """
        device = self.config.device
        numbers = self.state(observations) if state is None else state
        tokens, mask = self.tokenise([o.instruction for o in observations], numbers)
        return {
            **{f"{IMAGES}{camera}": self._pictures(camera, observations) for camera in self.shown_cameras},
            STATE: torch.from_numpy(numbers).to(device),
            TOKENS: tokens.to(device),
            MASK: mask.to(device),
        }

    def state(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """Return the states (B, numbers) as the network reads them.

        Raises:
            ObservationError: For another count of numbers.
        """
        rows = self.laid_out(np.stack([np.asarray(o.state, np.float32) for o in observations]))
        if rows.shape[1] != self.state_numbers:
            raise ObservationError(
                f"the state has {rows.shape[1]} numbers; this checkpoint reads {self.state_numbers}"
            )
        return self.state_units.normalise(rows)

    def _pictures(self, camera: str, observations: Sequence[Observation]) -> Tensor:
        """Return the pictures of a camera (B, 3, H, W) in [0, 1], each as this checkpoint looks at it."""
        return self.look(camera, [self.picture_of(camera, observation) for observation in observations])

    def picture_of(self, camera: str, observation: Observation) -> NDArray[np.uint8]:
        """The picture (H, W, 3) of a camera; the first camera is shown the environment's picture.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        return checked_picture(observation.image if camera == self.cameras[0] else observation.cameras[camera])

    def look(self, camera: str, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Return the part of each picture (H, W, 3) that this checkpoint looks at, (B, 3, H, W) in [0, 1]."""
        rows = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
        return self.window(camera)(rows.to(self.config.device).float() / 255)

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """The text that is read, per instruction; `state` is (B, numbers) as the network reads them."""
        del state
        return [text if text.endswith("\n") else f"{text}\n" for text in instructions]

    def tokenise(
        self, instructions: Sequence[str], state: NDArray[np.float32] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return ids and mask (B, tokenizer_max_length); never truncates and never drops a word.

        Args:
            instructions: One per row.
            state: (B, numbers) as the network reads them, for prompts that hold it; None for zeros.

        Raises:
            InstructionError: For a prompt that is too long, and for a word that the tokenizer does not know.
        """
        if state is None:
            state = np.zeros((len(instructions), self.state_numbers), np.float32)
        prompts, length = self.prompts(instructions, state), self.config.tokenizer_max_length
        rows = [self.tokenizer(text)["input_ids"] for text in prompts]
        for text, row in zip(prompts, rows, strict=True):
            if len(row) > length:
                raise InstructionError(
                    f"{text!r} is {len(row)} tokens; this checkpoint reads {length}. Shorten it"
                )
            if self.tokenizer.unk_token_id in row:
                raise InstructionError(
                    f"{text!r} has a word this checkpoint's tokenizer does not know; it would act without "
                    f"reading it. Tokens: {self.tokenizer.convert_ids_to_tokens(row)}"
                )
        tokens = torch.full((len(rows), length), self.tokenizer.pad_token_id or 0)  # masked: any id would do
        mask = torch.zeros((len(rows), length), dtype=torch.bool)
        for index, row in enumerate(rows):
            tokens[index, : len(row)] = torch.tensor(row)
            mask[index, : len(row)] = True
        return tokens, mask

    @classmethod
    def check_words(cls, checkpoint: str, instructions: Sequence[str], **options: Any) -> None:
        """Raise InstructionError as `tokenise` would, from configuration and tokenizer alone."""
        cls._text_reader(checkpoint, options).tokenise(instructions)

    @classmethod
    def _text_reader(cls, checkpoint: str, options: Mapping[str, Any]) -> Self:
        """Return a policy without a network, which packs and tokenises; `options` are those of its loader."""
        text = cls.__new__(cls)
        text.folder, text.evaluation = checkpoint_folder(checkpoint, TEXT_FILES), cls.choice(**options)
        text.config = cls._read_config(text.folder, text.evaluation)
        text.cameras = text.shown_cameras = cameras_of(text.config.image_features, rename_map(text.folder))[:1]
        return text

    def window(self, camera: str) -> PictureWindow:
        """The part of one camera's picture that this checkpoint looks at."""
        if camera not in self._windows:
            size = tuple(self.config.image_features[f"{IMAGES}{camera}"].shape[-2:])
            self._windows[camera] = read_window(self.folder, f"{IMAGES}{camera}", size)
        return self._windows[camera]

    @cached_property
    def _windows(self) -> dict[str, PictureWindow]:
        return {}

    @cached_property
    def state_units(self) -> Normaliser:
        """The map from metres and radians to what the network reads.

        Raises:
            CheckpointError: If nothing says it.
        """
        return self.units_of(STATE, "STATE")

    @cached_property
    def action_units(self) -> Normaliser:
        """The units that turn the network's output into metres and radians.

        Raises:
            CheckpointError: If nothing says them.
        """
        return self.units_of("action", "ACTION")

    def units_of(self, feature: str, kind: str) -> Normaliser:
        """Return the units of one feature, STATE or ACTION.

        Raises:
            CheckpointError: If nothing says them.
        """
        if (units := self.own_units(feature, kind)) is not None:
            return units
        raise CheckpointError(
            f"{self.checkpoint} does not normalise its {feature} and no policy_preprocessor.json says so: "
            "its units are unknown"
        )

    def own_units(self, feature: str, kind: str) -> Normaliser | None:
        """Return the units in the checkpoint's processor files or old buffers; None if it normalises nothing.

        Raises:
            CheckpointError: For statistics that are missing, or of another count of numbers.
        """
        pipeline = PREPROCESSOR if kind == "STATE" else POSTPROCESSOR
        self._check_steps(self.folder, pipeline)  # behind the policy only actions depend on them
        if (self.folder / f"{pipeline}.json").is_file():
            units: Normaliser | None = read_normaliser(self.folder, pipeline, feature, kind)
        else:
            units = from_buffers(self._buffers, self.config.normalization_mapping, feature, kind, self.checkpoint)
        numbers = self.state_numbers if kind == "STATE" else self._action_numbers
        if units is not None and units.mode != "IDENTITY" and units.low.shape != (numbers,):
            raise CheckpointError(
                f"{self.checkpoint} has statistics of shape {units.low.shape} for its {feature}, which has "
                f"{numbers} numbers ({units.source}). Take the statistics of the data set it was trained on"
            )
        return units

    @cached_property
    def _buffers(self) -> dict[str, NDArray[np.float32]]:
        return read_buffers(self.folder)

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of prefix and suffix as the family packs them."""
        return self.packed_roles(
            *self.tokenise([o.instruction for o in observations], self.read_state(observations))
        )

    def read_state(self, observations: Sequence[Observation]) -> NDArray[np.float32] | None:
        """Return (B, numbers) as the network reads them; None where it is given zeros in place of the arm's state.

        A recorded state of the checkpoint's own width is read, whatever the arm has.
        """
        recorded = {np.shape(observation.state) for observation in observations} == {(self.state_numbers,)}
        if self.zero_filled_inputs() and not (recorded and problem_of(lambda: self.state_units) is None):
            return None
        return self.state(observations)

    def packed_roles(self, tokens: Tensor, mask: Tensor) -> dict[str, list[Roles]]:
        """The roles for instructions as (B, tokenizer_max_length) ids and mask."""
        suffix = Roles.from_labels(self.suffix_labels())
        language = [
            self.text_labels(row, valid) for row, valid in zip(tokens.tolist(), mask.tolist(), strict=True)
        ]
        return {
            "backbone": [Roles.from_labels(self.prefix_labels(row)) for row in language],
            self.acting_stream: [suffix] * len(language),
        }

    def text_labels(self, ids: Sequence[int], valid: Sequence[bool]) -> list[str]:
        """The role of every position of a prompt."""
        special = frozenset(self.tokenizer.all_special_ids)
        labels = ["special" if number in special else "language" for number in ids]
        return [label if is_text else PADDING for label, is_text in zip(labels, valid, strict=True)]

    def read_late_files(self) -> None:
        """Read the tokenizer."""
        self.tokenizer  # noqa: B018 - read once, and kept

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each instruction, without padding."""
        tokens, mask = self.tokenise(instructions)
        return [tuple(row[valid].tolist()) for row, valid in zip(tokens, mask, strict=True)]


def problem_of(read: Callable[[], object]) -> str | None:
    """The message of the CheckpointError that `read` raises; None if it raises none."""
    try:
        read()
    except CheckpointError as error:
        return str(error)
    return None
