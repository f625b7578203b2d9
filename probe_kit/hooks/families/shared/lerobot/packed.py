"""Base adapter of policies whose prompts lerobot's own processor steps pack: pictures, words and state as one."""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.state_layout import ARM_NUMBERS
from probe_kit.hooks.families.shared.lerobot.features import IMAGES
from probe_kit.hooks.families.shared.lerobot.flow import DenoisingPolicy

Tokens = list[tuple[int, str]]
"""The id and the role of every position of one prompt."""


class PackedRow(NamedTuple):
    """One packed observation. inputs: what lerobot packs, with a batch axis of 1. labels: a role per position."""

    inputs: dict[str, Tensor]
    labels: list[str]

    @property
    def tokens(self) -> Tokens:
        """The ids of the prompt with their roles."""
        return list(zip(self.inputs["input_ids"][0].tolist(), self.labels, strict=True))


@dataclass(frozen=True)
class PackedBatch:
    """Packed observations. inputs: what the network reads. rows: of each, its prompt without the actions."""

    inputs: dict[str, Tensor]
    rows: list[Tokens]


def chat_labels(
    ids: Sequence[int], pictures: Iterable[str], picture: int, words: tuple[int, int], state: int | None = None
) -> list[str]:
    """The role of every position of a chat: `language` between two marks, else `special`.

    pictures: the roles of the pictures, each a run of patches, in their order. picture, state: the ids of a patch
    and of the state. words: the ids of the marks; the first counts where it stands last.
    """
    begin = len(ids) - ids[::-1].index(words[0])
    end, roles, role = ids.index(words[1], begin), iter(pictures), ""
    labels = []
    for index, token in enumerate(ids):
        if token == picture and (not index or ids[index - 1] != picture):
            role = next(roles)
        other = "language" if begin <= index < end else "state" if token == state else "special"
        labels.append(role if token == picture else other)
    return labels


class PackedPolicy(DenoisingPolicy):
    """A denoising policy that packs as lerobot's processors do; the packing says the role of every position."""

    masked_cameras = 0
    word_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    """The tokens that stand for an instruction where two are compared."""

    @cached_property
    @abstractmethod
    def packing(self) -> Any:
        """lerobot's packing; it has the `tokenizer`, and `row` and `batch` for `pack`."""

    def pack(self, observations: Sequence[Observation], state: NDArray[np.float32]) -> PackedBatch:
        """The observations as the network reads them. state: (B, numbers) as it reads them.

        Raises InstructionError for a text that it cannot take in.
        """
        rows: list[PackedRow] = [
            self.packing.row(self.pictures_of(observation), observation.instruction, numbers)
            for observation, numbers in zip(observations, state, strict=True)
        ]
        return PackedBatch(self.packing.batch(rows), [row.tokens for row in rows])

    @cached_property
    def tokenizer(self) -> Any:
        """The tokenizer of the packing."""
        return self.packing.tokenizer

    def pictures_of(self, observation: Observation) -> dict[str, NDArray[np.uint8]]:
        """The pictures (H, W, 3) of the shown cameras. Raises ObservationError."""
        return {camera: self.picture_of(camera, observation) for camera in self.shown_cameras}

    def batch(
        self, observations: Sequence[Observation], state: NDArray[np.float32] | None = None
    ) -> dict[str, Tensor]:
        """Return a batch in lerobot's keys. state: (B, numbers) as the network reads them."""
        packed = self.pack(observations, self.state(observations) if state is None else state)
        return {name: tensor.to(self.config.device) for name, tensor in packed.inputs.items()}

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Roles from the packing itself; streams besides the acting one have the backbone's tokens."""
        state = self.read_state(observations)
        rows = self.pack(observations, self._no_state(len(observations)) if state is None else state).rows
        prompts = Roles.padded([[label for _, label in row] for row in rows])
        suffix = [Roles.from_labels(self.suffix_labels())] * len(rows)
        return {name: suffix if name == self.acting_stream else prompts for name in self.streams}

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each prompt, without pictures and without the state, which change at every inference."""
        height, width = self.config.image_features[f"{IMAGES}{self.cameras[0]}"].shape[-2:]
        blank, state = np.zeros((height, width, 3), np.uint8), np.zeros(ARM_NUMBERS, np.float32)
        cameras = dict.fromkeys(self.shown_cameras[1:], blank)
        observations = [Observation(blank, state, text, cameras=cameras) for text in instructions]
        rows = [self.pack([observation], self._no_state(1)).rows[0] for observation in observations]
        return [tuple(number for number, role in row if role in self.word_roles) for row in rows]

    @classmethod
    def check_words(cls, checkpoint: str, instructions: Sequence[str], **options: Any) -> None:
        """Raise InstructionError as `pack` would, from configuration and tokenizer alone."""
        cls._text_reader(checkpoint, options).token_ids(instructions)

    def _no_state(self, rows: int) -> NDArray[np.float32]:
        return np.zeros((rows, self._state_numbers), np.float32)
