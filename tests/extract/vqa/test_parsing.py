"""The parsing table: what may be read as an answer, and why everything else is not."""

import pytest

from probe_kit.extract.vqa.parsing import Answer, read_answer
from probe_kit.extract.vqa.templates import P1, SEEN

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
    ("A left\nB right", "none", "contradicts itself"),
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


@pytest.mark.parametrize(("text", "said", "rule"), LETTERED)
def test_answers_by_letter(text: str, said: str, rule: str) -> None:
    assert read_answer(text, P1) == Answer(said, rule)  # type: ignore[arg-type]


@pytest.mark.parametrize(("text", "said", "rule"), WORDS)
def test_answers_in_words(text: str, said: str, rule: str) -> None:
    assert read_answer(text, SEEN) == Answer(said, rule)  # type: ignore[arg-type]


@pytest.mark.parametrize(("text", "said", "rule"), LETTERED)
def test_with_options_exchanged_letters_change_their_meaning_and_words_do_not(
    text: str, said: str, rule: str
) -> None:
    exchanged = read_answer(text, P1, "swapped")
    if text in ("A right", "A left", "B) right"):
        expected = {"A right": Answer("right", "letter")}.get(text, Answer("none", "contradicts itself"))
    elif rule == "letter":
        expected = Answer({"left": "right", "right": "left"}[said], "letter")  # type: ignore[arg-type]
    else:
        expected = Answer(said, rule)  # type: ignore[arg-type]
    assert exchanged == expected
