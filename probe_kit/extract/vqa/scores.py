"""Scores of an answer from its text and its logits: side, outcome, option-letter bias, and the letter lens."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError
from probe_kit.extract.vqa.parsing import Said
from probe_kit.extract.vqa.phrases import Query
from probe_kit.suite import Side
from probe_kit.suite.items import other_side

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel

Outcome = Literal["correct", "wrong", "oob"]
Placed = Literal["left", "right", "none"]


def side_said(meaning: Said) -> Placed:
    """The side an answer puts the object on; none for everything else it may say."""
    return meaning if meaning in ("left", "right") else "none"


def side_expected(query: Query, side_correct: Side) -> Side | None:
    """Return the side of the object that is asked for; None for an object that is not there."""
    if query == "absent":
        return None
    return side_correct if query == "target" else other_side(side_correct)


def outcome_of(meaning: Said, expected: Side | None) -> Outcome:
    """Judge an answer. Where nothing of the name is there, right is no and every place is wrong."""
    if expected is None:
        return "correct" if meaning == "no" else "oob" if meaning == "none" else "wrong"
    if meaning not in ("left", "right"):
        return "oob"
    return "correct" if meaning == expected else "wrong"


def likeliest(logits: Mapping[Said, float]) -> Said:
    """Return the meaning of the largest logit; none where two are equally large, never the first of them."""
    best = max(logits.values())
    leading = [meaning for meaning, logit in logits.items() if logit == best]
    return leading[0] if len(leading) == 1 else "none"


@dataclass(frozen=True)
class Choice:
    """Logits of the admissible answers, by what each says, in one or two orders of the sides.

    passes: as read with left named first and, where the prompt can be turned round, with right named first.
    """

    passes: Sequence[Mapping[Said, float]]

    @property
    def margins(self) -> list[float]:
        """Per pass left minus right; for an object that is not there, no minus yes."""
        return [logits["left"] - logits["right"] if "left" in logits else logits["no"] - logits["yes"]
                for logits in self.passes]  # fmt: skip

    @property
    def content(self) -> float:
        """The part of the margin that stays when the options change places."""
        return sum(self.margins) / len(self.margins)

    @property
    def letter_bias(self) -> float | None:
        """The part of the margin that goes with the place: above 0 for what is named first; None for one order."""
        if len(self.margins) == 1:
            return None
        first, second = self.margins
        return (first - second) / 2

    @property
    def likeliest(self) -> Said:
        """The likeliest answer of the first pass."""
        return likeliest(self.passes[0])

    @property
    def debiased(self) -> Said:
        """The likeliest answer by the mean of the passes, in which a preference for a place is gone."""
        return likeliest({meaning: sum(logits[meaning] for logits in self.passes) for meaning in self.passes[0]})


def letter_margins(
    model: "AnswerModel", residuals: NDArray[np.float32], letters: NDArray[Any], margin: float
) -> list[float]:
    """The logit lens: the letter for left minus that for right, by the model's own norm and head, at every layer.

    residuals: (L, D) float32 of the position that chooses the letter. letters: (2,) token ids, left and right.
    margin: the same of the model's own answer, which the last layer must give but for rounding. One layer at a
    time, so that no batch changes a number. Raises CaptureError if the last layer gives another margin.
    """
    import torch

    from probe_kit.hooks.contract.model import NEAR_TIE

    unembedding, card = model.unembedding, model.card
    assert unembedding is not None
    layers = torch.from_numpy(residuals).to(card.device, getattr(torch, card.dtype))
    left_id, right_id = (int(letter) for letter in letters)
    rows = [unembedding.logits(row[None, None])[0, 0].float() for row in layers]
    margins = [float(row[left_id] - row[right_id]) for row in rows]
    size = max(1.0, float(rows[-1][[left_id, right_id]].abs().max()))
    if abs(margins[-1] - margin) > NEAR_TIE.get(card.dtype, NEAR_TIE["bfloat16"]) * size:
        raise CaptureError(
            f"the logit lens gives {margins[-1]:.4g} as the margin of {card.family}'s last layer; the model "
            f"answered with {margin:.4g}. Correct `Model.unembedding`: its streams, final norm and head"
        )
    return margins
