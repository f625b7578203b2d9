"""Sentences of the fence: on another processor their decimals may differ by rounding, their words may not."""

from typing import Any

import pytest

from tests.acceptance.fence_comparison import differences

SENTENCE = "the best site backbone.00.residual has R² 0.46 (chance -0.05, p 0.031; state -0.00). Label 12 groups."


def content(sentence: str, processor: str) -> dict[str, Any]:
    return {"platform": {"processor": processor}, "runs": {"run": {"table": {"row": {"why": sentence}}}}}


@pytest.mark.parametrize(
    ("sentence", "is_same"),
    [
        (SENTENCE, True),
        (SENTENCE.replace("-0.00", "0.00"), True),
        (SENTENCE.replace("0.031", "0.062"), True),
        (SENTENCE.replace("0.46", "0.76"), False),
        (SENTENCE.replace("state", "pixels"), False),
        (SENTENCE.replace("12 groups", "13 groups"), False),
        (SENTENCE.replace("backbone.00", "backbone.01"), False),
    ],
)
def test_a_sentence_of_another_processor_may_differ_in_the_rounding_of_its_decimals(
    sentence: str, is_same: bool
) -> None:
    stored = content(SENTENCE, "Intel")
    assert (differences(stored, content(sentence, "AMD"), "run") == []) is is_same


def test_a_sentence_of_the_same_processor_is_equal_letter_by_letter() -> None:
    changed = content(SENTENCE.replace("-0.00", "0.00"), "Intel")
    assert len(differences(content(SENTENCE, "Intel"), changed, "run")) == 1
