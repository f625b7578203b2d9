"""Parsing of a text answer: left, right, another statement, or unparsable.

An answer that cannot be read is no wrong answer and is not left out: it is `oob`, with the rule that found it so.
"""

import re
import unicodedata
from dataclasses import dataclass
from typing import Literal

from probe_kit.extract.vqa.templates import Order, Template, sides

Said = Literal["left", "right", "center", "yes", "no", "none"]

_THOUGHT = re.compile(r"<think>.*?</think>", re.DOTALL)
_SPECIAL = re.compile(r"<\|[^<>|]*\|>|</?(?:s|bos|eos|pad|unk|end_of_turn|start_of_turn|loc\d+)>")
_OPENING = r"[\s\"'`*_(\[{<#:.,!-]*"
_BEFORE_LETTER = (
    rf"^{_OPENING}(?:(?:yes|yeah|sure)\b{_OPENING})?"
    rf"(?:(?:the\s+)?(?:(?:correct|right|best)\s+)?(?:answer|option|choice|letter)\b{_OPENING}(?:is\b|:)?{_OPENING})?"
    rf"(?:option\b{_OPENING})?"
)
_SIDE = r"(?:left|right|cent(?:er|re)|middle)(?:most)?"
_LETTER = re.compile(
    rf"{_BEFORE_LETTER}(?i:(?P<letter>[ab]))(?=$|[^\w\s]|\s*$|\s+[^\w\s]|\s+{_SIDE}\b|\s*\n)", re.IGNORECASE
)
_SIDES = re.compile(rf"\b(?P<side>{_SIDE})\b", re.IGNORECASE)
_REFUSAL = re.compile(
    r"\b(?:sorry|cannot|can not|can't|unable|not sure|unsure|don't know|do not know|not able|unclear)\b",
    re.IGNORECASE,
)
_NO = re.compile(
    r"^\W*(?:(?:no|nope|none)\b|there (?:is|are) no\b|i (?:do not|don't|can not|cannot|can't) see\b)",
    re.IGNORECASE,
)
_YES = re.compile(r"^\W*(?:yes|yeah|yep)\b", re.IGNORECASE)
_SIDE_OF = {"left": "left", "right": "right", "center": "center", "centre": "center", "middle": "center"}


@dataclass(frozen=True)
class Answer:
    """What was read. rule: how, as the outcome of an episode records it."""

    said: Said
    rule: str


def read_answer(text: str, template: Template, order: Order = "original") -> Answer:
    """What an answer to `template`, its sides named in `order`, says."""
    plain = _stripped(text)
    if not plain:
        return Answer("none", "empty")
    if template.yes_or_no:
        return _yes_or_no(plain)
    return (_by_letter(plain, order) if template.lettered else None) or _in_words(plain)


def _stripped(text: str) -> str:
    """Without thoughts, special tokens and spaces around it; nothing of a thought that was not ended."""
    plain = _SPECIAL.sub("", _THOUGHT.sub("", unicodedata.normalize("NFKC", text)))
    return plain.partition("<think>")[0].replace("\u2019", "'").strip()


def _by_letter(plain: str, order: Order) -> Answer | None:
    """The option whose letter begins the answer; None if none does, such as in "A red star"."""
    found = _LETTER.match(plain)
    if found is None:
        return None
    first, second = sides(order)
    letter = found["letter"].upper()
    behind = plain[found.end() :]
    if re.search(rf"\b{'B' if letter == 'A' else 'A'}\b(?!\s+[a-z])", behind):
        return Answer("none", "several sides")
    side = first if letter == "A" else second
    if _named(behind) - {side}:
        return Answer("none", "contradicts itself")
    return Answer(side, "letter")


def _yes_or_no(plain: str) -> Answer:
    """Of an answer to "do you see …? If yes, where": a no outweighs every side behind it."""
    if _NO.match(plain):
        return Answer("no", "said no")
    answer = _in_words(plain)
    if answer.rule == "unparsable" and _YES.match(plain):
        return Answer("yes", "no side")
    return answer


def _in_words(plain: str) -> Answer:
    named = _named(plain)
    if len(named) > 1:
        return Answer("none", "several sides")
    if named:
        (side,) = named
        return Answer("center", "center") if side == "center" else Answer(side, "side word")
    return Answer("none", "refusal" if _REFUSAL.search(plain) else "unparsable")


def _named(text: str) -> set[Said]:
    """The sides that a text names."""
    words = (place["side"].lower().removesuffix("most") for place in _SIDES.finditer(text))
    return {_SIDE_OF[word] for word in words}  # type: ignore[misc]
