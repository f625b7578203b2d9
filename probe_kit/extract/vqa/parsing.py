"""Parsing of a text answer: left, right, another statement, or unparsable.

An answer that cannot be read is no wrong answer and is not left out: it is `oob`, with the rule that found it so.
An inverted answer is worse than an unreadable one: a text which denies or contradicts itself is unreadable.
"""

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from probe_kit.extract.vqa.mentions import Mentions, mentions_of
from probe_kit.extract.vqa.templates import Order, Template, sides
from probe_kit.suite import Side

Said = Literal["left", "right", "center", "yes", "no", "none"]
Tier = Literal["strict", "clause"]
"""strict: the whole text is an option or a side. clause: one was found among other words."""

_THOUGHT = re.compile(r"<think>.*?</think>", re.DOTALL)
_SPECIAL = re.compile(r"<\|[^<>|]*\|>|</?(?:s|bos|eos|pad|unk|end_of_turn|start_of_turn|loc\d+)>")
_INVISIBLE = re.compile("[\u200b-\u200f\u2060\ufeff]")
_MARKUP = re.compile(r"\\boxed|[*_`$\\{}\[\]()<>#\"\u201c\u201d]|(?<!\w)'|'(?!\w)")
_BRACKETED = re.compile(r"(?<![\w'])([AB])\s*\)")
"""A letter in front of a bracket is an option, not an article."""
_REASON = re.compile(r"\b(?:because|since|due\s+to|as\s+it)\b.*", re.IGNORECASE | re.DOTALL)

_LEAD = r"(?:(?:the|my)\s+)?(?:(?:correct|right|best|final)\s+)?(?:answer|option|choice|letter)\s*(?:is\b)?[\s:]*"
_PLACE = (
    r"(?:it\s+is\s+|it's\s+)?(?:(?:on|to|at|in)\s+)?(?:the\s+)?(?P<side>left|right|cent(?:er|re)|middle)(?:most)?"
    r"(?:-hand)?(?:\s+(?:side|picture|image|tile))?"
)
_STRICT = re.compile(
    rf"[\s:.,!-]*(?P<yes>(?:yes|yeah|yep|sure)\b[\s,.:!-]*)?(?:{_LEAD})?(?:option\s+)?"
    rf"(?:(?P<letter>[ab])\b(?:[\s,.:-]+(?:is\s+)?(?P<same>left|right))?|{_PLACE})[\s.:,!]*",
    re.IGNORECASE,
)
_YES = re.compile(r"\W*(?:that(?:'s|\s+is)\s+right|yes|yeah|yep|sure|correct|indeed)\b", re.IGNORECASE)
_JUST_YES, _JUST_NO = re.compile(r"\W*yes\W*", re.IGNORECASE), re.compile(r"\W*no\W*", re.IGNORECASE)
_NO = re.compile(
    r"^\W*(?:no|nope|none|nothing|never)\b(?!\s+(?:problem|doubt|worries|question))"
    r"|^\W*(?:it\s+is\s+|it's\s+)?not\s+(?:visible|present|there|seen|shown)\b"
    r"|\bthere\s+(?:(?:is|are)\s+(?:no|not)|(?:is|are)n't)\b(?!\s+(?:any\s+|a\s+)?(?:problem|doubt|question))|\bunable\s+to\s+(?:see|find)\b"
    r"|\b(?:(?:do|does|can|could|did)(?:\s+not|n't|not)|can't)\s+(?:\w+\s+)?(?:see|find|show|contain|have|depict|appear)\b"
    r"|\b(?:is|are)(?:\s+not|n't)\s+(?:\w+\s+)?(?:visible|present|there|seen|shown)\b",
    re.IGNORECASE,
)
_NOT_THAT = re.compile(r"\bnot\s+that\b", re.IGNORECASE)
"""It's not that I can't see it: two denials."""
_REFUSAL = re.compile(
    r"\b(?:sorry|cannot|can\s+not|can't|unable|not\s+sure|unsure|don't\s+know|do\s+not\s+know|not\s+able|unclear"
    r"|not\s+certain|uncertain|impossible)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Answer:
    """An answer as it was read. rule: as the outcome of an episode records it. tier: None for no meaning."""

    meaning: Said
    rule: str
    tier: Tier | None = None


def read_answer(text: str, template: Template, order: Order = "original") -> Answer:
    """Read an answer to `template`, its sides named in `order`. The first rule that applies decides."""
    plain = _stripped(text)
    if not plain:
        return Answer("none", "empty")
    options = dict(zip("AB", sides(order), strict=True)) if template.lettered else {}
    strict = _strictly(plain, options)
    if strict is not None:
        return strict
    if template.yes_or_no and _NO.search(plain) and not _NOT_THAT.search(plain):
        if _YES.match(plain):
            return Answer("none", "contradicts itself")
        return Answer("no", "said no", "strict" if _JUST_NO.fullmatch(plain) else "clause")
    answer = _by_clauses(plain, options)
    if template.yes_or_no and answer.rule in ("unparsable", "denied") and _YES.match(plain):
        if re.search(r"\bno\b", plain, re.IGNORECASE):
            return Answer("none", "contradicts itself")
        return Answer("yes", "no side", "strict" if _JUST_YES.fullmatch(plain) else "clause")
    return answer


def _stripped(text: str) -> str:
    """Without thoughts, special tokens, markup, reasons and spaces around it; nothing of an unfinished thought."""
    plain = _SPECIAL.sub("", _THOUGHT.sub("", unicodedata.normalize("NFKC", text))).partition("<think>")[0]
    plain = _BRACKETED.sub(r"\1:", plain)
    plain = _MARKUP.sub(" ", _INVISIBLE.sub("", plain).replace("\u2019", "'"))
    return _REASON.sub("", plain).strip()


def _strictly(plain: str, options: Mapping[str, Side]) -> Answer | None:
    """Read a text that is nothing but an option or a side; None for every other."""
    match = _STRICT.fullmatch(plain)
    if match is None:
        return None
    if match["letter"] is None:
        mentioned = mentions_of(match["side"]).sides
        (side,) = mentioned
        return Answer(side, "center" if side == "center" else "side word", "strict")
    meaning = options.get(match["letter"].upper())
    if meaning is None or (match["same"] or meaning).lower() != meaning:
        return None
    return Answer(meaning, "letter", "strict")


def _by_clauses(plain: str, options: Mapping[str, Side]) -> Answer:
    """Read what the clauses affirm, if that is one thing and is denied nowhere."""
    mentions = mentions_of(plain)
    if _REFUSAL.search(plain):
        return Answer("none", "refusal")
    if options:
        lettered = _by_letter(mentions, options)
        if lettered is not None:
            return lettered
    if len(mentions.sides) > 1 or mentions.sides & mentions.denied_sides:
        return Answer("none", "several sides")
    if mentions.sides:
        (side,) = mentions.sides
        if mentions.has_unclear_right and side != "right":
            return Answer("none", "several sides")
        return Answer(side, "center" if side == "center" else "side word", "clause")
    return Answer("none", "denied" if mentions.denied_sides else "unparsable")


def _by_letter(mentions: Mentions, options: Mapping[str, Side]) -> Answer | None:
    """The option that is named; None where the text has no letter."""
    if len(mentions.letters) > 1 or mentions.letters & mentions.denied_letters:
        return Answer("none", "several sides")
    if mentions.letters:
        (letter,) = mentions.letters
        meaning = options[letter]
        is_other = bool(mentions.sides - {meaning}) or meaning in mentions.denied_sides
        return Answer("none", "contradicts itself") if is_other else Answer(meaning, "letter", "clause")
    denied = {options[letter] for letter in mentions.denied_letters}
    if not denied:
        return None
    if not mentions.sides:
        return Answer("none", "denied")
    return Answer("none", "contradicts itself") if denied & mentions.sides else None
