"""The quantities in which Prismatic is compared with golden references, also with those recorded from answers.

B rows, T text tokens, P patches, L blocks, D width. Rows of answers were read one at a time and are padded in
front. Their ids are recorded without the picture's positions and padded at the end.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.hooks.capturing.capture_context import ActivationCache
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.prismatic.adapter import Prismatic, PrismaticModel
from probe_kit.hooks.families.prismatic.network import prepare_picture
from probe_kit.hooks.families.shared.vlm import LETTERS, Prefill, answer_outputs, padded_answers, recorded_texts
from probe_kit.hooks.outputs import (
    Arrays,
    Outputs,
    Produce,
    forward_outputs,
    generation_outputs,
    numpy_of,
    pass_outputs,
    watch,
)

STREAMS = 3e-5
"""The absolute tolerance of activations."""


def asked_outputs(model: Prismatic, folder: Path, recorded: Arrays) -> Outputs:
    """Ask the recorded questions.

    Raises:
        UsageError: Where they do not lie beside the reference.
    """
    frame = model.frame
    questions = [
        Prompt(
            Observation(recorded[f"in_picture_{int(number)}"], np.zeros(8, np.float32), ""),
            text.removeprefix(frame.before).removesuffix(frame.behind),
            tuple(model.lead + letter for letter in LETTERS),
        )
        for text, number in zip(recorded_texts(folder), recorded["in_rows_picture"], strict=True)
    ]
    return answer_outputs(_Asked(model, questions, recorded).produced(), recorded, STREAMS)


class _Asked:
    """The recorded questions, run through the adapter at the first request for a result of them."""

    def __init__(self, model: Prismatic, questions: Sequence[Prompt], recorded: Arrays) -> None:
        self.model, self.questions, self.recorded = model, questions, recorded

    @cached_property
    def captured(self) -> list[tuple[ActivationCache, Prefill]]:
        """The activations and the prefill of every row alone, with everything that is stored of it."""
        runs = (watch(self.model, partial(self.model.prefill, [question])) for question in self.questions)
        return [(activations, prefill) for prefill, activations, _ in runs]

    @property
    def prompts(self) -> list[list[int]]:
        """The ids of every row."""
        return [self.model.prompt(question.text) for question in self.questions]

    @cached_property
    def pixels(self) -> torch.Tensor:
        """The pictures of all rows."""
        return self.model.pixel_values(question.observation.image for question in self.questions)

    def produced(self) -> dict[str, Produce]:
        """Return functions that make every output the adapter can make."""
        model, padding = self.model, int(self.model.config.text.pad_token_id or 0)
        lengths = [len(row) for row in self.prompts]
        bare = replace(self.questions[0], pictured=False)

        def behind(rows: Sequence[Sequence[int]], value: int) -> NDArray[np.int64]:
            return np.array([[*row, *[value] * (max(lengths) - len(row))] for row in rows])

        return {
            "input_ids": lambda: behind(self.prompts, padding),
            "input_mask": lambda: behind([[1] * length for length in lengths], 0),
            "attention_mask": lambda: self._in_front([np.ones(n + model.network.patches, int) for n in lengths]),
            "pixel_values": lambda: numpy_of(self.pixels),
            "projector_features": self._projected,
            "backbone_resid": lambda: self._streams(range(model.streams["backbone"].layers), "residual"),
            "backbone_final_norm": lambda: self._streams([model.streams["backbone"].layers - 1], "final_norm")[0],
            "logits_last": lambda: numpy_of(torch.cat([prefill.logits for _, prefill in self.captured])),
            "batch_logits_last": lambda: numpy_of(model.prefill(self.questions).logits),
            "option_ids": lambda: np.array(model.option_ids(self.questions[0])),
            "option_logits": lambda: model.read(self.questions).option_logits,
            "textonly_input_ids": lambda: np.array([self.prompts[0]]),
            "textonly_logits_last": lambda: numpy_of(model.prefill([bare]).logits),
            "greedy_ids": self._greedy,
        }

    @torch.inference_mode()
    def _projected(self) -> NDArray[Any]:
        network = self.model.network
        return numpy_of(network.projector(network.vision_backbone(self.pixels)))

    def _streams(self, layers: Sequence[int], quantity: str) -> NDArray[Any]:
        """Return the activations of both streams, (layers, B, P + T, D)."""
        rows = []
        for activations, _ in self.captured:
            parts = [
                torch.stack([activations[Site(stream, layer, quantity, step)][0] for layer in layers])
                for stream, step in (("backbone", None), (self.model.output, 0))
            ]
            rows.append(numpy_of(torch.cat(parts, dim=1)).transpose(1, 0, 2))
        return self._in_front(rows).transpose(2, 0, 1, 3)

    @staticmethod
    def _in_front(rows: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return rows as (B, longest, …) with zeros in front of shorter rows."""
        longest = max(map(len, rows))
        return np.stack([
            np.concatenate([np.zeros((longest - len(row), *row.shape[1:]), row.dtype), row]) for row in rows
        ])  # fmt: skip

    def _greedy(self) -> NDArray[np.int64]:
        length, text = self.recorded["greedy_ids"].shape[1], self.model.config.text
        with torch.inference_mode():
            answers = [prefill.speak(length, self.model.ends)[0].numpy() for _, prefill in self.captured]
        return padded_answers(answers, length, self.model.ends, int(text.pad_token_id or 0))


TOLERANCE = 2e-5
INPUTS = (
    "image_uint8", "prompt_ids_without_empty", "attention_mask", "batch_input_ids", "batch_attention_mask",
    "batch_pixel_values",
)  # fmt: skip
"""The names under which a reference records what went in, beside the prompt's ids."""


def prismatic_outputs(load: Callable[..., Any], folder: Path, recorded: Arrays) -> Outputs:
    """Compare a reference of a vision-language model: of one prompt, or of several questions."""
    checkpoint = str(folder / "checkpoint")
    if "in_rows_picture" in recorded:
        return asked_outputs(load(checkpoint, dtype="float32"), folder, recorded)
    steps = recorded["generated_ids"].size if "generated_ids" in recorded else 1
    reference = Reference(load(checkpoint, steps=steps), recorded, recorded["input_ids"].ravel().tolist())
    return reference.outputs((*INPUTS, "input_ids"))


class Reference:
    """The recorded inputs, run through the adapter.

    Args:
        model: The adapter.
        recorded: The arrays of the reference.
        prompt: Ids of the text tokens of the prompt.
    """

    def __init__(self, model: PrismaticModel, recorded: Arrays, prompt: list[int]) -> None:
        self.model, self.recorded, self.prompt = model, recorded, prompt
        self.pixels = model.pixel_values([recorded["image_uint8"]])
        self.decoded, self.activations, _ = watch(model, lambda: model.generate(self.pixels, [prompt]))

    def outputs(self, inputs: Collection[str], **family_outputs: Produce) -> Outputs:
        """Return everything that the adapter can make, whether recorded or not.

        Args:
            inputs: Recorded names that went in.
            **family_outputs: Functions that make further outputs, by name.
        """
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
            **generation_outputs(self.model, self.model.output, self.activations, self.decoded),
            "input_ids": lambda: np.array([self.prompt]),
            "teacher_forced_ids": lambda: np.array([forced]),
            **pass_outputs(
                batch=self._batch,
                text=lambda: self._forward(self.prompt, None),
                teacher_forced=lambda: self._forward(forced, self.pixels),
            ),
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

    def _batch(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return hidden states and logits of the recorded batch, packed as the adapter packs it.

        They are reordered to the recorded layout, where padding stands behind the last token.
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
