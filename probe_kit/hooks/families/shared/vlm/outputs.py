"""Quantities in which vision-language models are compared with their golden references.

B rows, T positions, L blocks, D width, V vocabulary. The questions stand in `dims.json` beside the reference, as
whole prompts; the adapter is given what stands between their frames.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.shared.vlm.adapter import ANSWER, VisionLanguageModel
from probe_kit.hooks.families.shared.vlm.decoding import Prefill
from probe_kit.hooks.verification.outputs import Arrays, Outputs, Produce, numpy_of, watch
from probe_kit.models.packing import LeftPacked

PIXELS, LOGITS = 1e-6, 2e-5
"""Tolerances, absolute."""
LETTERS = ("A", "B")
DIMS_FILE = "dims.json"
# How the templates that references were recorded with mark a picture's place.
_PLACEHOLDER = re.compile(r"<\|vision_end\|>|<IMG_CONTEXT>|<image>")


def vlm_outputs(load: Callable[..., VisionLanguageModel], folder: Path, recorded: Arrays) -> Outputs:
    """Ask the recorded questions; see `VisionLanguageModel.further_outputs` for quantities of a family."""
    model = load(str(folder / "checkpoint"), dtype="float32")
    questions = questions_of(folder, recorded, model)
    produced = Reference(model, questions, recorded).produced()
    produced = {**produced, **model.further_outputs(questions[0], produced)}
    return answer_outputs(produced, recorded, model.stream_tolerance)


def answer_outputs(produced: Mapping[str, Produce], recorded: Arrays, streams: float) -> Outputs:
    """Give every quantity the tolerance of its kind; streams are compared where `attention_mask` says so."""
    kinds = {name: _tolerance(name, streams) for name in recorded}
    mask = recorded["attention_mask"].astype(bool)
    return Outputs(
        produced,
        streams,
        ("pixel_values_index",),
        tolerances=kinds,
        absolute={name for name in recorded if not name.endswith("_sum")},
        valid=dict.fromkeys(("backbone_resid", "backbone_final_norm"), mask),
    )


def _tolerance(name: str, streams: float) -> float:
    if name.startswith("pixel_values"):
        return PIXELS
    return LOGITS if "logits" in name else streams


def recorded_texts(folder: Path) -> list[str]:
    """Return the whole prompts of a reference. Raises UsageError where they do not lie beside it."""
    file = folder / DIMS_FILE
    if not file.is_file():
        raise UsageError(f"{file} is missing: it holds the questions that {folder} was recorded with")
    return [row["text"] for row in load_json(file)["rows"]]


def questions_of(folder: Path, recorded: Arrays, model: VisionLanguageModel) -> list[Prompt]:
    """Return the recorded questions with their pictures. Raises UsageError as `recorded_texts` does."""
    letters = tuple(model.lead + letter for letter in LETTERS)
    pictures = [recorded[f"in_picture_{int(number)}"] for number in recorded["in_rows_picture"]]
    return [
        Prompt(Observation(picture, np.zeros(8, np.float32), ""), _between(text, model), letters)
        for text, picture in zip(recorded_texts(folder), pictures, strict=True)
    ]


def _between(text: str, model: VisionLanguageModel) -> str:
    """The question in a whole prompt: behind the picture's placeholder, before the frame's end."""
    end = model.frame.end
    body = text.removesuffix(end) if end.strip() else text
    return _PLACEHOLDER.split(body)[-1].lstrip("\n")


class Reference:
    """The recorded questions, run through the adapter when something asks for what comes of them."""

    def __init__(self, model: VisionLanguageModel, questions: Sequence[Prompt], recorded: Arrays) -> None:
        self.model, self.questions, self.recorded = model, questions, recorded

    @cached_property
    def picture_inputs(self) -> dict[str, torch.Tensor]:
        """The pictures of all rows as the network gets them."""
        return self.model.picture_inputs([question.observation.image for question in self.questions])

    @cached_property
    def batch(self) -> LeftPacked:
        """All rows."""
        return self.model.packed([self.model.prompt(question) for question in self.questions])

    @cached_property
    def captured(self) -> tuple[ActivationCache, Prefill]:
        """One pass over all rows, with everything that is stored of it."""
        prefill, tape, _ = watch(self.model, lambda: self.model.prefill(self.questions))
        return tape, prefill

    @cached_property
    def alone(self) -> list[Prefill]:
        """Every row by itself."""
        return [self.model.prefill([question]) for question in self.questions]

    @cached_property
    def bare(self) -> Prompt:
        """The first question without its picture."""
        return replace(self.questions[0], pictured=False)

    def produced(self) -> dict[str, Produce]:
        """Functions that make every output the adapter can make, whether recorded or not."""
        return {**self._inputs(), **self._pixels(), **self._streams(), **self._answers()}

    def _inputs(self) -> dict[str, Produce]:
        model = self.model
        return {
            "input_ids": lambda: self.batch.ids.numpy(),
            "attention_mask": lambda: self.batch.mask.numpy(),
            "position_ids": lambda: model.positions(self.batch, self.picture_inputs).numpy(),
            "image_grid_thw": lambda: self.picture_inputs["image_grid_thw"].numpy(),
            "token_type_ids": lambda: model.other_inputs(self.batch)["token_type_ids"].numpy(),
            "mm_token_type_ids": lambda: model.other_inputs(self.batch)["mm_token_type_ids"].numpy(),
            "textonly_input_ids": lambda: np.array([model.prompt(self.bare).ids]),
        }

    def _pixels(self) -> dict[str, Produce]:
        def values() -> NDArray[Any]:
            return self.picture_inputs["pixel_values"].float().numpy()

        def sums() -> NDArray[Any]:
            pixels = values().astype(np.float64)
            return np.array([pixels.sum(), np.abs(pixels).sum()])

        return {
            "pixel_values": values,
            "pixel_values_shape": lambda: np.array(values().shape),
            "pixel_values_at": lambda: values().ravel()[self.recorded["pixel_values_index"]],
            "pixel_values_sum": sums,
            "pixel_values_row0": lambda: self.model.picture_inputs([self.questions[0].observation.image])[
                "pixel_values"
            ].numpy(),
        }

    def _streams(self) -> dict[str, Produce]:
        def joined(layer: int, quantity: str) -> torch.Tensor:
            tape = self.captured[0]
            parts = [Site("backbone", layer, quantity), Site(ANSWER, layer, quantity, 0)]
            return torch.cat([tape[site] for site in parts], dim=1)

        layers = self.model.streams["backbone"].layers
        return {
            "backbone_resid": lambda: numpy_of(
                torch.stack([joined(layer, "residual") for layer in range(layers)])
            ),
            "backbone_final_norm": lambda: numpy_of(joined(layers - 1, "final_norm")),
            "vision_resid_row0": self.vision,
        }

    def vision(self) -> NDArray[Any]:
        """The input of every block of the tower for the first row's picture."""
        sites = self.model.further_streams["vision"].sites()[:-1]
        with capture(self.model, sites) as tape:
            self.model.prefill(self.questions[:1])
        values = numpy_of(torch.stack([tape[site] for site in sites]))
        flat = self.recorded["vision_resid_row0"].ndim < values.ndim
        return values[:, 0] if flat else values

    def _answers(self) -> dict[str, Produce]:
        model = self.model

        def options() -> NDArray[Any]:
            prompt = model.prompt(self.questions[0])
            return np.array([model.text.option(prompt, option) for option in self.questions[0].options])

        return {
            "logits_last": lambda: numpy_of(self.captured[1].logits),
            "single_logits_last": lambda: numpy_of(torch.cat([prefill.logits for prefill in self.alone])),
            "textonly_logits_last": lambda: numpy_of(model.prefill([self.bare]).logits),
            "option_ids": options,
            "option_logits": lambda: model.read(self.questions).option_logits,
            "greedy_ids": self._greedy,
        }

    def _greedy(self) -> NDArray[np.int64]:
        """Greedy ids behind every row, padded behind its end."""
        length = self.recorded["greedy_ids"].shape[1]
        with torch.inference_mode():
            answers = self.captured[1].speak(length, self.model.text.ends).numpy()
        return padded_answers(answers, length, self.model.text.ends, self.model.text.padding)


def padded_answers(
    answers: Sequence[NDArray[np.int64]] | NDArray[np.int64], length: int, ends: Collection[int], padding: int
) -> NDArray[np.int64]:
    """(B, length) ids, each row up to and with its end, padded behind it."""
    padded = np.full((len(answers), length), padding)
    for row, ids in enumerate(answers):
        over = np.isin(ids, list(ends))
        stop = int(over.argmax()) + 1 if over.any() else len(ids)
        padded[row, :stop] = ids[:stop]
    return padded
