"""Quantities in which Prismatic models are compared with their golden references.

B batch, P patches, T text tokens, S = P + T positions, L blocks, N output tokens.
"""

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.prismatic.adapter import PrismaticModel, load_prismatic
from probe_kit.hooks.families.prismatic.verify_asked import verify_asked
from probe_kit.hooks.verification.verify import Comparison, Produce, compare
from probe_kit.models.prismatic import prepare_picture

TOLERANCE = 2e-5
Arrays = Mapping[str, NDArray[Any]]
INPUTS = frozenset({
    "image_uint8", "prompt_ids_without_empty", "attention_mask", "batch_input_ids", "batch_attention_mask",
    "batch_pixel_values",
})  # fmt: skip
"""What a reference records of what went in, beside the prompt's ids."""


def verify_prismatic(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Compare a reference of a vision-language model: of one prompt, or of several questions."""
    if "in_rows_picture" in recorded:
        return verify_asked(load_prismatic(str(folder / "checkpoint"), dtype="float32"), folder, recorded)
    steps = recorded["generated_ids"].size if "generated_ids" in recorded else 1
    model = load_prismatic(str(folder / "checkpoint"), steps=steps)
    prompt: list[int] = recorded["input_ids"].ravel().tolist()
    return compare_outputs(model, recorded, Reference(model, recorded, prompt).produced(), {*INPUTS, "input_ids"})


def compare_outputs(
    model: PrismaticModel, recorded: Arrays, produced: Mapping[str, Produce], inputs: AbstractSet[str]
) -> tuple[Comparison, ...]:
    """Compare everything recorded but `inputs` with what the adapter produced."""
    outputs = {name: values for name, values in recorded.items() if name not in inputs}
    valid: dict[str, NDArray[np.bool_]] = {}
    if "batch_attention_mask" in recorded:
        mask = recorded["batch_attention_mask"].astype(bool)
        patches = np.ones((len(mask), model.network.patches), bool)
        whole = np.concatenate([mask[:, :1], patches, mask[:, 1:]], axis=1)
        valid = dict.fromkeys(("batch_hidden_states", "batch_logits"), whole)
    return compare(outputs, produced, TOLERANCE, valid)


class Reference:
    """The recorded inputs, run through the adapter. prompt: ids of its text tokens."""

    def __init__(self, model: PrismaticModel, recorded: Arrays, prompt: list[int]) -> None:
        self.model, self.recorded, self.prompt = model, recorded, prompt
        self.pixels = model.pixel_values([recorded["image_uint8"]])
        with capture(model, [*model.sites(), *model.sites("final_norm")]) as self.tape:
            self.decoded = model.generate(self.pixels, [self.prompt])

    def produced(self) -> dict[str, Produce]:
        """How to make every output the adapter can make, whether recorded or not."""
        states, output = self._prompt_states, self.model.output
        generated = self.decoded.ids[0].tolist()
        return {
            **self._vision(),
            "input_ids": lambda: np.array([self.prompt]),
            "hidden_states": lambda: _numpy(states()),
            "logits": lambda: _numpy(self._head(states()[-1])),
            "batch_hidden_states": lambda: self._batch()[0],
            "batch_logits": lambda: self._batch()[1],
            "text_hidden_states": lambda: self._forward(self.prompt, None)[0],
            "text_logits": lambda: self._forward(self.prompt, None)[1],
            "generated_ids": lambda: np.array(generated),
            "generated_step_logits": lambda: _numpy(self.decoded.logits[0]),
            "generated_step_hidden": lambda: _numpy(
                torch.stack([_column(self.tape, self.model, output, step)[:, 0, 0] for step in self._steps])
            ),
            "teacher_forced_ids": lambda: np.array([[*self.prompt, *generated]]),
            "teacher_forced_hidden_states": lambda: self._forward([*self.prompt, *generated], self.pixels)[0],
            "teacher_forced_logits": lambda: self._forward([*self.prompt, *generated], self.pixels)[1],
        }

    @property
    def _steps(self) -> range:
        return range(self.model.steps)

    def _vision(self) -> dict[str, Produce]:
        image, settings, network = self.recorded["image_uint8"], self.model.pictures, self.model.network
        side = tuple(224 for _ in settings.sides)

        @torch.inference_mode()
        def tower_blocks(index: int) -> NDArray[Any]:
            tower = network.vision_backbone.towers[index]
            channels = self.pixels[:, 3 * index : 3 * index + 3]
            return _numpy(torch.stack(tower.get_intermediate_layers(channels, n=len(tower.blocks))))

        @torch.inference_mode()
        def patches() -> NDArray[Any]:
            return _numpy(network.vision_backbone(self.pixels))

        @torch.inference_mode()
        def projected() -> NDArray[Any]:
            return _numpy(network.projector(network.vision_backbone(self.pixels)))

        def pixels(**changes: Any) -> NDArray[Any]:
            return prepare_picture(image, replace(settings, **changes))[None]

        produced: dict[str, Produce] = {
            "pixel_values": lambda: _numpy(self.pixels),
            "pixel_values_224": partial(pixels, sides=side),
            "vision_patches": patches,
            "projector_features": projected,
        }
        for strategy in ("letterbox", "resize-crop", "resize-naive"):
            produced[f"pixel_values_{strategy.replace('-', '_')}"] = partial(pixels, strategy=strategy)
        for index, tower in enumerate(self.model.config.towers):
            produced[f"{_kind(tower.timm_id)}_blocks"] = partial(tower_blocks, index)
        return produced

    def _prompt_states(self) -> Tensor:
        """(L+1, 1, S, D): every prompt position, from the two streams that share the stack."""
        prompt = _column(self.tape, self.model, "backbone", None)
        return torch.cat([prompt, _column(self.tape, self.model, self.model.output, 0)], dim=2)

    def _head(self, normed: Tensor) -> Tensor:
        with torch.inference_mode():
            logits: Tensor = self.model.network.language_model.lm_head(normed)
        return logits

    def _forward(self, ids: list[int], pixels: Tensor | None) -> tuple[NDArray[Any], NDArray[Any]]:
        """Hidden states (L+1, 1, S, D) and logits of one pass."""
        row = torch.tensor([ids])
        with torch.inference_mode():
            output = self.model.network(row, torch.ones_like(row, dtype=torch.bool), pixels)
        return _numpy(torch.stack(output.hidden_states)), _numpy(output.logits)

    def _batch(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Hidden states and logits of the recorded batch, packed as the adapter packs it.

        Reordered to the recorded layout, where padding stands behind the last token.
        """
        ids, mask = self.recorded["batch_input_ids"], self.recorded["batch_attention_mask"].astype(bool)
        packed = self.model.pack([row[seen].tolist() for row, seen in zip(ids, mask, strict=True)])
        with torch.inference_mode():
            pixels = torch.from_numpy(self.recorded["batch_pixel_values"])
            output = self.model.network(packed.ids, packed.mask, pixels)
        states, logits = _numpy(torch.stack(output.hidden_states)), _numpy(output.logits)
        for row, length in enumerate(mask.sum(axis=1) + self.model.network.patches):
            states[:, row, length - 1], logits[row, length - 1] = states[:, row, -1], logits[row, -1]
        return states, logits


def _column(tape: ActivationCache, model: PrismaticModel, stream: str, iteration: int | None) -> Tensor:
    """(L+1, 1, positions, D) as transformers counts them: the stream at every block, and normed at the end."""
    blocks = model.streams[stream].layers - 1
    layers = [tape[Site(stream, layer, iteration=iteration)] for layer in range(blocks)]
    return torch.stack([*layers, tape[Site(stream, blocks, "final_norm", iteration)]])


def _kind(timm_id: str) -> str:
    return next((name for name in ("dino", "siglip", "clip") if name in timm_id), "in1k")


def _numpy(tensor: Tensor) -> NDArray[Any]:
    return np.array(tensor.float().cpu().numpy())
