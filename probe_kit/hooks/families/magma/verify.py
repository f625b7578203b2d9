"""Quantities in which Magma is compared with its golden references.

B batch, S positions, L blocks, N output tokens. References come without a tokenizer; `action_config.json` beside
the checkpoint holds what the original processor and evaluation client know.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_json import load_json
from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.magma.adapter import BINS, Magma, load_magma
from probe_kit.hooks.families.openvla.actions import ActionTokens
from probe_kit.hooks.verification.verify import Comparison, Produce, compare
from probe_kit.models.magma import Choose, Decoded, Grid, Picture, PictureSettings, choose_grid

TOLERANCE = 2e-5
Arrays = Mapping[str, NDArray[Any]]
_CLIENT = "action_config.json"
_INPUTS = (
    "image1_uint8", "image2_uint8", "input_ids", "attention_mask", "text_input_ids", "batch_input_ids",
    "batch_attention_mask", "batch_pixel_values", "batch_image_sizes", "action_token_ids", "crop_sizes_wh",
)  # fmt: skip
# The released processor's numbers, with which the choice of crops is recorded whatever the checkpoint's are.
_RELEASED = PictureSettings(512, 4)


def verify_magma(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Compare a reference."""
    file = folder / "checkpoint" / _CLIENT
    client: dict[str, Any] = load_json(file) if file.is_file() else {}
    steps = int(recorded["generated_ids"].size) if "generated_ids" in recorded else 1
    model = load_magma(
        str(folder / "checkpoint"), shrink=0, steps=steps, statistics=str(file) if "norm_stats" in client else None
    )
    reference = _Reference(model, recorded, client)
    outputs = {name: values for name, values in recorded.items() if name not in _INPUTS}
    return compare(outputs, reference.produced(), TOLERANCE, reference.valid())


@dataclass(frozen=True)
class _Run:
    """One picture and the recorded prompt, through the adapter."""

    picture: Picture
    decoded: Decoded
    tape: ActivationCache


class _Reference:
    """The recorded inputs, run through the adapter when something asks for what comes of them."""

    def __init__(self, model: Magma, recorded: Arrays, client: Mapping[str, Any]) -> None:
        self.model, self.recorded, self.client = model, recorded, client
        self.prompt: list[int] = recorded["input_ids"].ravel().tolist()

    @cached_property
    def first(self) -> _Run:
        return self._run(self.recorded["image1_uint8"])

    @cached_property
    def second(self) -> _Run:
        return self._run(self.recorded["image2_uint8"])

    def _run(self, image: NDArray[np.uint8]) -> _Run:
        model, picture = self.model, self.model.picture(image)
        sites = [*model.sites(), *model.sites("final_norm")]
        sites += [site for stream in model.further_streams.values() for site in stream.sites()]
        with capture(model, sites) as tape:
            decoded = model.generate([self.prompt], [picture], self._choose)
        return _Run(picture, decoded, tape)

    @property
    def _choose(self) -> Choose:
        """The likeliest token that does not end the turn: the recording asked for a fixed number of them."""
        end = self.client.get("special_ids", {}).get("eos", self.model.config.text.eos_token_id)
        ends = [int(number) for number in (end if isinstance(end, list) else [end]) if number is not None]

        def choose(logits: Tensor) -> Tensor:
            return logits.index_fill(1, torch.tensor(ends, dtype=torch.long), float("-inf")).argmax(dim=-1)

        return choose

    def valid(self) -> dict[str, NDArray[np.bool_]]:
        """Which positions of the recorded batch are no padding."""
        if "batch_attention_mask" not in self.recorded or "batch_logits" not in self.recorded:
            return {}
        mask = np.zeros(self.recorded["batch_logits"].shape[:2], bool)
        for row, length in enumerate(self._batch_lengths):
            mask[row, mask.shape[1] - length :] = True
        return dict.fromkeys(("batch_hidden_states", "batch_logits"), mask)

    def produced(self) -> dict[str, Produce]:
        """How to make every output the adapter can make, whether recorded or not."""
        return {**self._pictures(), **self._streams(), **self._passes(), **self._actions()}

    def _pictures(self) -> dict[str, Produce]:
        def stage(number: int) -> Produce:
            return lambda: self._map(f"vision_{number}", -1)

        return {
            "pixel_values": lambda: _numpy(self.first.picture.crops[None]),
            "pixel_values_2": lambda: _numpy(self.second.picture.crops[None]),
            "image_sizes": lambda: _sizes(self.first.picture),
            "image_sizes_2": lambda: _sizes(self.second.picture),
            "crop_grids_hw": self._grids,
            "stem": lambda: self._map("vision_0", 0),
            **{f"stage{number}": stage(number) for number in range(len(self.model.further_streams))},
            "projected": self._projected,
        }

    def _grids(self) -> NDArray[np.int64]:
        chosen = [
            choose_grid(width, height, _RELEASED) for width, height in self.recorded["crop_sizes_wh"].tolist()
        ]
        return np.array([(grid.rows, grid.columns) for grid in chosen])

    def _map(self, stream: str, layer: int) -> NDArray[Any]:
        """(N, C, h, w) of the tokens that a vision stream's tap gives; maps have the shape of what was shown."""
        layers = self.model.further_streams[stream].layers
        tokens = self.first.tape[Site(stream, layer % layers)]
        height, width = self.model.network.shown(self.first.picture).shape[-2:]
        high = round(np.sqrt(tokens.shape[1] * height / width))
        return _numpy(tokens.transpose(1, 2).reshape(len(tokens), -1, high, tokens.shape[1] // high))

    @torch.inference_mode()
    def _projected(self) -> NDArray[Any]:
        network = self.model.network
        maps = network.vision_tower(network.shown(self.first.picture))
        return _numpy(network.multi_modal_projector(maps.permute(0, 2, 3, 1)))

    def _streams(self) -> dict[str, Produce]:
        steps = range(self.model.steps)
        return {
            "merged_embeds": lambda: _numpy(self._states(self.first)[0]),
            "hidden_states": lambda: _numpy(self._states(self.first)),
            "logits": lambda: _numpy(self._head(self._states(self.first)[-1])),
            "hidden_states_2": lambda: _numpy(self._states(self.second)),
            "logits_2": lambda: _numpy(self._head(self._states(self.second)[-1])),
            "generated_ids": lambda: _numpy(self.first.decoded.ids[0]),
            "generated_step_logits": lambda: _numpy(self.first.decoded.logits[0]),
            "generated_step_hidden": lambda: _numpy(
                torch.stack([self._column(self.first.tape, "action", step)[:, 0, 0] for step in steps])
            ),
        }

    def _states(self, run: _Run) -> Tensor:
        """(L+1, 1, S, D): every prompt position, from the two streams that share the stack."""
        parts = [self._column(run.tape, "backbone", None), self._column(run.tape, "action", 0)]
        return torch.cat(parts, dim=2)

    def _column(self, tape: ActivationCache, stream: str, iteration: int | None) -> Tensor:
        """(L+1, 1, positions, D) as transformers counts them: the stream at every block, and normed at the end."""
        blocks = self.model.streams[stream].layers - 1
        layers = [tape[Site(stream, layer, iteration=iteration)] for layer in range(blocks)]
        return torch.stack([*layers, tape[Site(stream, blocks, "final_norm", iteration)]])

    @torch.inference_mode()
    def _head(self, normed: Tensor) -> Tensor:
        logits: Tensor = self.model.network.language_model.lm_head(normed)
        return logits

    def _passes(self) -> dict[str, Produce]:
        def forced() -> list[int]:
            return [*self.prompt, *self.first.decoded.ids[0].tolist()]

        def text() -> list[int]:
            ids: list[int] = self.recorded["text_input_ids"].ravel().tolist()
            return ids

        return {
            "teacher_forced_ids": lambda: np.array([forced()]),
            "teacher_forced_hidden_states": lambda: self._forward([forced()], [self.first.picture])[0],
            "teacher_forced_logits": lambda: self._forward([forced()], [self.first.picture])[1],
            "text_hidden_states": lambda: self._forward([text()], None)[0],
            "text_logits": lambda: self._forward([text()], None)[1],
            "batch_hidden_states": lambda: self._batch[0],
            "batch_logits": lambda: self._batch[1],
        }

    @torch.inference_mode()
    def _forward(
        self, prompts: Sequence[Sequence[int]], pictures: Sequence[Picture] | None
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Hidden states (L+1, B, S, D) and logits of one pass."""
        output = self.model.network(prompts, pictures)
        return _numpy(torch.stack(output.hidden_states)), _numpy(output.logits)

    @cached_property
    def _batch_prompts(self) -> list[list[int]]:
        ids, mask = self.recorded["batch_input_ids"], self.recorded["batch_attention_mask"].astype(bool)
        return [row[seen].tolist() for row, seen in zip(ids, mask, strict=True)]

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
        """Of the recorded batch, packed as the adapter packs it and reordered to padding in front of every row."""
        states, logits = self._forward(self._batch_prompts, self._batch_pictures)
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


def _numpy(tensor: Tensor) -> NDArray[Any]:
    values: NDArray[Any] = tensor.detach().cpu().numpy().copy()
    return values
