"""Logits as sides: a tie is no answer, and a preference for a letter is separated from knowledge."""

import pytest

from probe_kit.extract.rollout.answers import Choice, likeliest, outcome_of, side_expected, side_said


def test_outcomes_are_right_wrong_or_unread() -> None:
    assert [outcome_of(said, "left") for said in ("left", "right", "center", "yes", "no", "none")] == [
        "correct", "wrong", "oob", "oob", "oob", "oob",
    ]  # fmt: skip
    assert [outcome_of(said, None) for said in ("no", "left", "center", "yes", "none")] == [
        "correct", "wrong", "wrong", "wrong", "oob",
    ]  # fmt: skip
    assert [side_said(said) for said in ("left", "right", "center", "no")] == ["left", "right", "none", "none"]


def test_where_the_asked_object_lies() -> None:
    assert [side_expected(asked, "left") for asked in ("target", "distractor", "absent")] == [
        "left",
        "right",
        None,
    ]


def test_a_tie_is_no_answer_and_never_the_first_option() -> None:
    assert likeliest({"left": 1.5, "right": 1.5}) == "none"
    assert likeliest({"left": 1.5, "right": 1.0, "center": 1.5}) == "none"
    assert likeliest({"left": 1.0, "right": 1.5, "center": 1.4}) == "right"


@pytest.mark.parametrize(("content", "bias"), [(0.75, 2.0), (-0.25, 0.5), (0.0, -1.0)])
def test_letter_bias_and_content_are_separated(content: float, bias: float) -> None:
    """A is left in the first pass and right in the second; a preference for A applies in both."""
    first = {"left": 3 + content / 2 + bias, "right": 3 - content / 2}
    second = {"left": 1 + content / 2, "right": 1 - content / 2 + bias}
    choice = Choice([first, second])
    assert choice.margins == [content + bias, content - bias]
    assert (choice.content, choice.letter_bias) == (content, bias)
    assert choice.debiased == ("none" if content == 0 else "left" if content > 0 else "right")
    assert choice.likeliest == ("left" if content + bias > 0 else "right")


def test_one_order_cannot_tell_a_bias() -> None:
    choice = Choice([{"left": 2.0, "right": 1.0}])
    assert (choice.content, choice.letter_bias, choice.debiased) == (1.0, None, "left")


def test_of_an_absent_object_the_margin_is_no_minus_yes() -> None:
    assert Choice([{"yes": 1.0, "no": 3.0}]).content == 2.0
