"""VLMs that look at nothing: they answer by the place of an option, or by the word for a side."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from torch import nn

from probe_kit.hooks import AnswerModel, ModelCard, Observation, Prompt, Reading, Roles, Site, Stream, Tap

Liking = Callable[[str, str], float]
"""The logit of an option (without its lead) behind a question."""


class PositionModel(AnswerModel):
    """Says what it likes best. liking: logit of every option. said: the text that is spoken, by question."""

    absent_inputs = frozenset({"instruction", "picture"})

    def __init__(self, liking: Liking, answer_to: Callable[[str], str]) -> None:
        self.card = ModelCard(
            "stub", "none", "0" * 64, False, 1, "float32", "cpu", "none", ("primary",), 0, 0, settings={}
        )
        self.streams: Mapping[str, Stream] = {"backbone": Stream("backbone", 1, 1, quantities=("residual",))}
        self.role_names = {"backbone": ("image.primary", "language")}
        self._liking, self._said = liking, answer_to

    def read(self, questions: Sequence[Prompt]) -> Reading:
        logits = [
            [self._liking(question.text, option.strip()) for option in question.options] for question in questions
        ]
        return Reading(np.array(logits, np.float32), np.full(len(logits), 0.9, np.float32), list(questions))

    def speak(self, reading: Reading, tokens: int) -> list[str]:
        return [" ".join(self._said(question.text).split()[:tokens]) for question in reading.state]

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        return {"backbone": [Roles.from_labels(["image.primary", "language"])] * len(observations)}

    def tap(self, site: Site) -> Tap:
        self.stream_of(site)
        return Tap(nn.Identity(), 1)


def likes(option: str) -> Liking:
    """One for this option, whatever the question, and zero for every other."""
    return lambda _, other: float(other == option)


def always(text: str) -> Callable[[str], str]:
    return lambda _: text
