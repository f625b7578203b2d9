"""Quantities in which Prismatic models are compared with their golden references.

B batch, P patches, T text tokens, S = P + T positions, L blocks, N output tokens.
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.hooks.families.prismatic.adapter import PrismaticModel
from probe_kit.hooks.families.prismatic.asked_outputs import asked_outputs
from probe_kit.hooks.verification.outputs import (
    Arrays,
    Outputs,
    Produce,
    forward_outputs,
    generation_outputs,
    numpy_of,
    watch,
)
from probe_kit.models.prismatic import prepare_picture

TOLERANCE = 2e-5
INPUTS = (
    "image_uint8", "prompt_ids_without_empty", "attention_mask", "batch_input_ids", "batch_attention_mask",
    "batch_pixel_values",
)  # fmt: skip
"""What a reference records of what went in, beside the prompt's ids."""


def prismatic_outputs(load: Callable[..., Any], folder: Path, recorded: Arrays) -> Outputs:
    """Compare a reference of a vision-language model: of one prompt, or of several questions."""
    checkpoint = str(folder / "checkpoint")
    if "in_rows_picture" in recorded:
        return asked_outputs(load(checkpoint, dtype="float32"), folder, recorded)
    steps = recorded["generated_ids"].size if "generated_ids" in recorded else 1
    reference = Reference(load(checkpoint, steps=steps), recorded, recorded["input_ids"].ravel().tolist())
    return reference.outputs((*INPUTS, "input_ids"))


class Reference:
    """The recorded inputs, run through the adapter. prompt: ids of its text tokens."""

    def __init__(self, model: PrismaticModel, recorded: Arrays, prompt: list[int]) -> None:
        self.model, self.recorded, self.prompt = model, recorded, prompt
        self.pixels = model.pixel_values([recorded["image_uint8"]])
        self.decoded, self.tape, _ = watch(model, lambda: model.generate(self.pixels, [prompt]))

    def outputs(self, inputs: Collection[str], **family_outputs: Produce) -> Outputs:
        """Everything that the adapter can make, whether recorded or not. inputs: recorded names that went in."""
        valid: dict[str, NDArray[np.bool_]] = {}
        if "batch_attention_mask" in self.recorded:
            mask = self.recorded["batch_attention_mask"].astype(bool)
            patches = np.ones((len(mask), self.model.network.patches), bool)
            positions = np.concatenate([mask[:, :1], patches, mask[:, 1:]], axis=1)
            valid = dict.fromkeys(("batch_hidden_states", "batch_logits"), positions)
        return Outputs({**self._produced(), **family_outputs}, TOLERANCE, inputs, valid=valid)

    def _produced(self) -> dict[str, Produce]:
        forced = [*self.prompt, *self.decoded.ids[0].tolist()]
        return {
            **self._vision(),
            **generation_outputs(self.model, self.model.output, self.tape, self.decoded),
            "input_ids": lambda: np.array([self.prompt]),
            "batch_hidden_states": lambda: self._batch[0],
            "batch_logits": lambda: self._batch[1],
            "text_hidden_states": lambda: self._forward(self.prompt, None)[0],
            "text_logits": lambda: self._forward(self.prompt, None)[1],
            "teacher_forced_ids": lambda: np.array([forced]),
            "teacher_forced_hidden_states": lambda: self._forward(forced, self.pixels)[0],
            "teacher_forced_logits": lambda: self._forward(forced, self.pixels)[1],
        }

    def _vision(self) -> dict[str, Produce]:
        image, settings, network = self.recorded["image_uint8"], self.model.pictures, self.model.network

        @torch.inference_mode()
        def tower_blocks(index: int) -> NDArray[Any]:
            tower = network.vision_backbone.towers[index]
            channels = self.pixels[:, 3 * index : 3 * index + 3]
            return numpy_of(torch.stack(tower.get_intermediate_layers(channels, n=len(tower.blocks))))

        @torch.inference_mode()
        def patches(*functions: Callable[[Any], Any]) -> NDArray[Any]:
            features = network.vision_backbone(self.pixels)
            return numpy_of(functions[0](features) if functions else features)

        def pixels(**changes: Any) -> NDArray[Any]:
            return prepare_picture(image, replace(settings, **changes))[None]

        produced: dict[str, Produce] = {
            "pixel_values": lambda: numpy_of(self.pixels),
            "pixel_values_224": partial(pixels, sides=tuple(224 for _ in settings.sides)),
            "vision_patches": patches,
            "projector_features": partial(patches, network.projector),
        }
        for strategy in ("letterbox", "resize-crop", "resize-naive"):
            produced[f"pixel_values_{strategy.replace('-', '_')}"] = partial(pixels, strategy=strategy)
        for index, tower in enumerate(self.model.config.towers):
            produced[f"{_kind(tower.timm_id)}_blocks"] = partial(tower_blocks, index)
        return produced

    def _forward(self, ids: list[int], pixels: torch.Tensor | None) -> tuple[NDArray[Any], NDArray[Any]]:
        row = torch.tensor([ids])
        return forward_outputs(self.model.network, row, torch.ones_like(row, dtype=torch.bool), pixels)

    @cached_property
    def _batch(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Hidden states and logits of the recorded batch, packed as the adapter packs it.

        Reordered to the recorded layout, where padding stands behind the last token.
        """
        ids, mask = self.recorded["batch_input_ids"], self.recorded["batch_attention_mask"].astype(bool)
        packed = self.model.pack([row[valid].tolist() for row, valid in zip(ids, mask, strict=True)])
        pixels = torch.from_numpy(self.recorded["batch_pixel_values"])
        states, logits = forward_outputs(self.model.network, packed.ids, packed.mask, pixels)
        for row, length in enumerate(mask.sum(axis=1) + self.model.network.patches):
            states[:, row, length - 1], logits[row, length - 1] = states[:, row, -1], logits[row, -1]
        return states, logits


def _kind(timm_id: str) -> str:
    return next((name for name in ("dino", "siglip", "clip") if name in timm_id), "in1k")
