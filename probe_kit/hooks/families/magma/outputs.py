"""Quantities in which Magma is compared with its golden references.

B batch, S positions, L blocks, N output tokens. References come without a tokenizer; `action_config.json` beside
the checkpoint holds what the original processor and evaluation client know.
"""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_json import load_json
from probe_kit.hooks.capturing.capture_context import ActivationCache
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.magma.adapter import BINS, Magma
from probe_kit.hooks.families.openvla.actions import ActionTokens
from probe_kit.hooks.families.shared.tokenizer_file import token_ids_of
from probe_kit.hooks.verification.outputs import (
    Arrays,
    Outputs,
    Produce,
    forward_outputs,
    generation_outputs,
    numpy_of,
    watch,
)
from probe_kit.models.decoding import Choose, Decoded
from probe_kit.models.magma import Grid, Picture, PictureSettings, choose_grid

TOLERANCE = 2e-5
_CLIENT = "action_config.json"
_INPUTS = (
    "image1_uint8", "image2_uint8", "input_ids", "attention_mask", "text_input_ids", "batch_input_ids",
    "batch_attention_mask", "batch_pixel_values", "batch_image_sizes", "action_token_ids", "crop_sizes_wh",
)  # fmt: skip
# The released processor's numbers, with which the choice of crops is recorded whatever the checkpoint's are.
_RELEASED = PictureSettings(512, 4)


def magma_outputs(load: Callable[..., Magma], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded pictures and prompt through the adapter."""
    file = folder / "checkpoint" / _CLIENT
    client: dict[str, Any] = load_json(file) if file.is_file() else {}
    steps = int(recorded["generated_ids"].size) if "generated_ids" in recorded else 1
    statistics = str(file) if "norm_stats" in client else None
    model = load(str(folder / "checkpoint"), shrink=0, steps=steps, statistics=statistics)
    reference = _Reference(model, recorded, client)
    return Outputs(reference.produced(), TOLERANCE, _INPUTS, valid=reference.valid())


class _Reference:
    """The recorded inputs, run through the adapter when something asks for what comes of them."""

    def __init__(self, model: Magma, recorded: Arrays, client: Mapping[str, Any]) -> None:
        self.model, self.recorded, self.client = model, recorded, client
        self.prompt: list[int] = recorded["input_ids"].ravel().tolist()

    @cached_property
    def first(self) -> tuple[Picture, Decoded, ActivationCache]:
        """The first picture and the recorded prompt, through the adapter."""
        return self._run(self.recorded["image1_uint8"])

    def _run(self, image: NDArray[np.uint8]) -> tuple[Picture, Decoded, ActivationCache]:
        picture = self.model.picture(image)
        decoded, tape, _ = watch(self.model, lambda: self.model.generate([self.prompt], [picture], self._choose))
        return picture, decoded, tape

    @cached_property
    def second(self) -> tuple[Picture, dict[str, Produce]]:
        """The second picture, and what comes of it and the prompt."""
        picture, decoded, tape = self._run(self.recorded["image2_uint8"])
        return picture, generation_outputs(self.model, "action", tape, decoded)

    @property
    def _choose(self) -> Choose:
        """The likeliest token that does not end the turn: the recording asked for a fixed number of them."""
        end = self.client.get("special_ids", {}).get("eos", self.model.config.text.eos_token_id)
        ends = sorted(token_ids_of(end))

        def choose(logits: Tensor) -> Tensor:
            return logits.index_fill(1, torch.tensor(ends, dtype=torch.long), float("-inf")).argmax(dim=-1)

        return choose

    def valid(self) -> dict[str, NDArray[np.bool_]]:
        """The positions of the recorded batch that are no padding."""
        if "batch_attention_mask" not in self.recorded or "batch_logits" not in self.recorded:
            return {}
        mask = np.zeros(self.recorded["batch_logits"].shape[:2], bool)
        for row, length in enumerate(self._batch_lengths):
            mask[row, mask.shape[1] - length :] = True
        return dict.fromkeys(("batch_hidden_states", "batch_logits"), mask)

    def produced(self) -> dict[str, Produce]:
        """Functions that make every output the adapter can make, whether recorded or not."""
        return {**self._pictures(), **self._streams(), **self._passes(), **self._actions()}

    def _pictures(self) -> dict[str, Produce]:
        def stage(number: int) -> Produce:
            return lambda: self._map(f"vision_{number}", -1)

        return {
            "pixel_values": lambda: numpy_of(self.first[0].crops[None]),
            "pixel_values_2": lambda: numpy_of(self.second[0].crops[None]),
            "image_sizes": lambda: _sizes(self.first[0]),
            "image_sizes_2": lambda: _sizes(self.second[0]),
            "crop_grids_hw": self._grids,
            "stem": lambda: self._map("vision_0", 0),
            **{f"stage{number}": stage(number) for number in range(len(self.model.further_streams))},
            "projected": self._projected,
        }

    def _grids(self) -> NDArray[np.int64]:
        grids = [
            choose_grid(width, height, _RELEASED) for width, height in self.recorded["crop_sizes_wh"].tolist()
        ]
        return np.array([(grid.rows, grid.columns) for grid in grids])

    def _map(self, stream: str, layer: int) -> NDArray[Any]:
        """(N, C, h, w) of the tokens that a vision stream's tap gives; maps have the shape of what was shown."""
        layers = self.model.further_streams[stream].layers
        tokens = self.first[2][Site(stream, layer % layers)]
        height, width = self.model.network.trunk_input(self.first[0]).shape[-2:]
        high = round(np.sqrt(tokens.shape[1] * height / width))
        return numpy_of(tokens.transpose(1, 2).reshape(len(tokens), -1, high, tokens.shape[1] // high))

    @torch.inference_mode()
    def _projected(self) -> NDArray[Any]:
        network = self.model.network
        maps = network.vision_tower(network.trunk_input(self.first[0]))
        return numpy_of(network.multi_modal_projector(maps.permute(0, 2, 3, 1)))

    def _streams(self) -> dict[str, Produce]:
        _, decoded, tape = self.first
        outputs = generation_outputs(self.model, "action", tape, decoded)
        return {
            **outputs,
            "merged_embeds": lambda: outputs["hidden_states"]()[0],
            "hidden_states_2": lambda: self.second[1]["hidden_states"](),
            "logits_2": lambda: self.second[1]["logits"](),
        }

    def _passes(self) -> dict[str, Produce]:
        picture, decoded, _ = self.first
        forced = [*self.prompt, *decoded.ids[0].tolist()]
        network = self.model.network

        def text() -> list[int]:
            ids: list[int] = self.recorded["text_input_ids"].ravel().tolist()
            return ids

        return {
            "teacher_forced_ids": lambda: np.array([forced]),
            "teacher_forced_hidden_states": lambda: forward_outputs(network, [forced], [picture])[0],
            "teacher_forced_logits": lambda: forward_outputs(network, [forced], [picture])[1],
            "text_hidden_states": lambda: forward_outputs(network, [text()], None)[0],
            "text_logits": lambda: forward_outputs(network, [text()], None)[1],
            "batch_hidden_states": lambda: self._batch[0],
            "batch_logits": lambda: self._batch[1],
        }

    @cached_property
    def _batch_prompts(self) -> list[list[int]]:
        ids, mask = self.recorded["batch_input_ids"], self.recorded["batch_attention_mask"].astype(bool)
        return [row[is_token].tolist() for row, is_token in zip(ids, mask, strict=True)]

    @cached_property
    def _batch_pictures(self) -> list[Picture]:
        pictures = []
        for crops, size in zip(
            self.recorded["batch_pixel_values"], self.recorded["batch_image_sizes"][:, 0].tolist(), strict=True
        ):
            grid = Grid(*size)
            pictures.append(Picture(torch.from_numpy(crops[: grid.rows * grid.columns]), grid))
        return pictures

    @property
    def _batch_lengths(self) -> list[int]:
        network, side = self.model.network, int(self.recorded["batch_pixel_values"].shape[-1])
        return [
            len(ids) - 1 + network.span(ids, picture.grid, side).length
            for ids, picture in zip(self._batch_prompts, self._batch_pictures, strict=True)
        ]

    @cached_property
    def _batch(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """The pass over the recorded batch, packed by the adapter, reordered to padding in front of every row."""
        states, logits = forward_outputs(self.model.network, self._batch_prompts, self._batch_pictures)
        for row, length in enumerate(self._batch_lengths):
            for values in (states[:, row], logits[None, row]):
                first = values[:, : length - 1].copy()
                values[:, values.shape[1] - length : -1] = first
        return states, logits

    def _actions(self) -> dict[str, Produce]:
        vocabulary = self.model.config.base_vocabulary or self.client.get("tokenizer_vocab_size")
        if vocabulary is None:
            return {}
        tokens = ActionTokens(int(vocabulary), int(self.client.get("n_action_bins", BINS)))
        ids = self.recorded.get("action_token_ids", np.zeros((0, self.model.steps), np.int64))
        return {
            "normalized_actions": lambda: tokens.values(ids),
            "actions": lambda: self.model.statistics.restore(tokens.values(ids)),
            "detok_table": lambda: tokens.values(np.arange(int(self.model.config.text.vocab_size))),
        }


def _sizes(picture: Picture) -> NDArray[np.int64]:
    return np.array([[[picture.grid.rows, picture.grid.columns]]])
