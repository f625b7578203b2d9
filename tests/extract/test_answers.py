"""Answers in words and by logits: what is read of them, and what it scores."""

import pytest

from probe_kit.extract.prompts import P1, SEEN, Order, Template
from probe_kit.extract.rollout.answers import (
    Choice,
    Said,
    likeliest,
    outcome_of,
    read_answer,
    side_expected,
    side_said,
)
from tests.extract.answer_cases import (
    AFTER_AUDIT,
    AUDIT_LETTERED,
    AUDIT_SEEN,
    AUDIT_UNREAD,
    HELD_OUT,
    LATER_LETTERED,
    LATER_SEEN,
    MADE_LETTERED,
    MADE_SEEN,
    MADE_SWAPPED,
    Cases,
)

LETTERED = [
    ("A", "left", "letter"),
    ("B", "right", "letter"),
    ("B.", "right", "letter"),
    ("(A)", "left", "letter"),
    ("**B**", "right", "letter"),
    ('"A"', "left", "letter"),
    ("a", "left", "letter"),
    ("Ａ", "left", "letter"),
    ("A left", "left", "letter"),
    ("B) right", "right", "letter"),
    ("Yes, A", "left", "letter"),
    ("The answer is B.", "right", "letter"),
    ("Option A", "left", "letter"),
    ("<think>left? right?</think>\n\nB<|im_end|>", "right", "letter"),
    ("A right", "none", "contradicts itself"),
    ("A left\nB right", "none", "several sides"),
    ("A, B", "none", "several sides"),
    ("A red star", "none", "unparsable"),
    ("A star on the left", "left", "side word"),
    ("It is on the Right.", "right", "side word"),
    ("leftmost", "left", "side word"),
    ("left and right", "none", "several sides"),
    ("in the middle", "center", "center"),
    ("I'm sorry, but I can't tell", "none", "refusal"),
    ("I am not sure", "none", "refusal"),
    ("", "none", "empty"),
    (" <|im_end|>\n", "none", "empty"),
    ("<think>It could be A", "none", "empty"),
    ("Yes", "none", "unparsable"),
    ("banana", "none", "unparsable"),
    ("Above", "none", "unparsable"),
]
WORDS = [
    ("Yes, left.", "left", "side word"),
    ("yes. It is on the right side", "right", "side word"),
    ("left", "left", "side word"),
    ("Yes", "yes", "no side"),
    ("Yes, centre", "center", "center"),
    ("No", "no", "said no"),
    ("No, it is on the left", "no", "said no"),
    ("I don\u2019t see it", "no", "said no"),
    ("Yes: left or right", "none", "several sides"),
    ("I cannot say", "none", "refusal"),
    ("A", "none", "unparsable"),
]


def read(text: str, template: Template, order: Order = "original") -> tuple[Said, str]:
    reading = read_answer(text, template, order)
    return reading.meaning, reading.rule


@pytest.mark.parametrize(("text", "meaning", "rule"), LETTERED)
def test_answers_by_letter(text: str, meaning: str, rule: str) -> None:
    assert read(text, P1) == (meaning, rule)


@pytest.mark.parametrize(("text", "meaning", "rule"), WORDS)
def test_answers_in_words(text: str, meaning: str, rule: str) -> None:
    assert read(text, SEEN) == (meaning, rule)


@pytest.mark.parametrize(("text", "meaning", "rule"), LETTERED)
def test_with_options_exchanged_letters_change_their_meaning_and_words_do_not(
    text: str, meaning: str, rule: str
) -> None:
    reading = read(text, P1, "swapped")
    if text in ("A right", "A left", "B) right"):
        assert reading == (("right", "letter") if text == "A right" else ("none", "contradicts itself"))
    elif rule == "letter":
        assert reading == ({"left": "right", "right": "left"}[meaning], "letter")
    else:
        assert reading == (meaning, rule)


# -- tables of cases -------------------------------------------------------------------------------------------

TABLES: dict[str, tuple[Cases, Template, Order]] = {
    "made, lettered": (MADE_LETTERED, P1, "original"),
    "made, swapped": (MADE_SWAPPED, P1, "swapped"),
    "made, seen": (MADE_SEEN, SEEN, "original"),
    "held out": (HELD_OUT, P1, "original"),
    "later, lettered": (LATER_LETTERED, P1, "original"),
    "later, seen": (LATER_SEEN, SEEN, "original"),
    "audit, lettered": (AUDIT_LETTERED, P1, "original"),
    "audit, seen": (AUDIT_SEEN, SEEN, "original"),
    "after the audit": (AFTER_AUDIT, P1, "original"),
}
UNREAD = {
    "made, lettered": {"Right: A"},
    "held out": {"Isn't it left?"},
    "later, lettered": {"not the left one but the right one"},
    "later, seen": {"It is there"},
}
"""What a person reads in some way and the rules leave unreadable."""


@pytest.mark.parametrize("name", TABLES)
def test_what_a_person_reads_is_read_or_left_unreadable_and_never_inverted(name: str) -> None:
    cases, template, order = TABLES[name]
    wrong = {
        text: reading.meaning
        for meaning, texts in cases.items()
        for text in texts
        if (reading := read_answer(text, template, order)).meaning != meaning
    }
    every = {text for texts in cases.values() for text in texts}
    assert wrong == dict.fromkeys(UNREAD.get(name, AUDIT_UNREAD & every), "none")


def test_a_side_that_is_read_has_a_tier_and_nothing_else_has() -> None:
    for cases, template, order in TABLES.values():
        for text in (text for texts in cases.values() for text in texts):
            reading = read_answer(text, template, order)
            assert (reading.tier is None) == (reading.meaning == "none"), text


@pytest.mark.parametrize(
    ("text", "tier"),
    [
        ("A", "strict"),
        ("The answer is B.", "strict"),
        ("Yes, left", "strict"),
        ("A left", "strict"),
        ("right side", "strict"),
        ("A, not B", "clause"),
        ("I think A", "clause"),
        ("It is on the left, not the right", "clause"),
    ],
)
def test_strict_is_an_option_or_a_side_and_nothing_else(text: str, tier: str) -> None:
    assert read_answer(text, P1).tier == tier


def test_outcomes_are_right_wrong_or_unread() -> None:
    assert [outcome_of(meaning, "left") for meaning in ("left", "right", "center", "yes", "no", "none")] == [
        "correct", "wrong", "oob", "oob", "oob", "oob",
    ]  # fmt: skip
    assert [outcome_of(meaning, None) for meaning in ("no", "left", "center", "yes", "none")] == [
        "correct", "wrong", "wrong", "wrong", "oob",
    ]  # fmt: skip
    assert [side_said(meaning) for meaning in ("left", "right", "center", "no")] == [
        "left",
        "right",
        "none",
        "none",
    ]


def test_the_expected_side_depends_on_the_object_that_is_asked_for() -> None:
    assert [side_expected(asked_object, "left") for asked_object in ("target", "distractor", "absent")] == [
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
