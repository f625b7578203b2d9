"""Quantities in which Prismatic is compared with references recorded from answers to questions.

B rows, T text tokens, P patches, L blocks, D width. Recorded rows were read alone and are padded in front; ids are
recorded without the picture's positions and padded behind.
"""

from collections.abc import Sequence
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
from probe_kit.hooks.families.prismatic.adapter import Prismatic
from probe_kit.hooks.families.prismatic.tokenizer import id_behind
from probe_kit.hooks.families.shared.vlm.decoding import Prefill
from probe_kit.hooks.families.shared.vlm.outputs import LETTERS, answer_outputs, padded_answers, recorded_texts
from probe_kit.hooks.verification.outputs import Arrays, Outputs, Produce, numpy_of, watch

STREAMS = 3e-5
"""Tolerance of activations, absolute."""


def asked_outputs(model: Prismatic, folder: Path, recorded: Arrays) -> Outputs:
    """Ask the recorded questions. Raises UsageError where they do not lie beside the reference."""
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
    """The recorded questions, run through the adapter when something asks for what comes of them."""

    def __init__(self, model: Prismatic, questions: Sequence[Prompt], recorded: Arrays) -> None:
        self.model, self.questions, self.recorded = model, questions, recorded

    @cached_property
    def captured(self) -> list[tuple[ActivationCache, Prefill]]:
        """Every row alone, with everything that is stored of it."""
        runs = (watch(self.model, partial(self.model.prefill, [question])) for question in self.questions)
        return [(tape, prefill) for prefill, tape, _ in runs]

    @property
    def prompts(self) -> list[list[int]]:
        """Ids of every row."""
        return [self.model.prompt(question.text) for question in self.questions]

    @cached_property
    def pixels(self) -> torch.Tensor:
        """The pictures of all rows."""
        return self.model.pixel_values(question.observation.image for question in self.questions)

    def produced(self) -> dict[str, Produce]:
        """Functions that make every output the adapter can make."""
        model, padding = self.model, int(self.model.config.text.pad_token_id or 0)
        lengths = [len(row) for row in self.prompts]
        bare = replace(self.questions[0], pictured=False)

        def behind(rows: Sequence[Sequence[int]], value: int) -> NDArray[np.int64]:
            return np.array([[*row, *[value] * (max(lengths) - len(row))] for row in rows])

        def options() -> NDArray[Any]:
            text = model.frame.around(self.questions[0].text)
            return np.array([id_behind(model.tokenizer, text, option) for option in self.questions[0].options])

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
            "option_ids": options,
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
        """(layers, B, P + T, D)."""
        rows = []
        for tape, _ in self.captured:
            parts = [
                torch.stack([tape[Site(stream, layer, quantity, step)][0] for layer in layers])
                for stream, step in (("backbone", None), (self.model.output, 0))
            ]
            rows.append(numpy_of(torch.cat(parts, dim=1)).transpose(1, 0, 2))
        return self._in_front(rows).transpose(2, 0, 1, 3)

    @staticmethod
    def _in_front(rows: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """(B, longest, …) with zeros in front of shorter rows."""
        longest = max(map(len, rows))
        return np.stack([
            np.concatenate([np.zeros((longest - len(row), *row.shape[1:]), row.dtype), row]) for row in rows
        ])  # fmt: skip

    def _greedy(self) -> NDArray[np.int64]:
        length, text = self.recorded["greedy_ids"].shape[1], self.model.config.text
        with torch.inference_mode():
            answers = [prefill.speak(length, self.model.ends)[0].numpy() for _, prefill in self.captured]
        return padded_answers(answers, length, self.model.ends, int(text.pad_token_id or 0))
