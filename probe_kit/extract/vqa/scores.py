"""Scores of an answer from its text and its logits: a side, an outcome, and the option-letter bias."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from probe_kit.extract.vqa.parsing import Said
from probe_kit.extract.vqa.phrases import Query
from probe_kit.suite import Side
from probe_kit.suite.items import other_side

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
    def said(self) -> Said:
        """The likeliest answer of the first pass."""
        return likeliest(self.passes[0])

    @property
    def debiased(self) -> Said:
        """The likeliest answer by the mean of the passes, in which a preference for a place is gone."""
        return likeliest({meaning: sum(logits[meaning] for logits in self.passes) for meaning in self.passes[0]})
