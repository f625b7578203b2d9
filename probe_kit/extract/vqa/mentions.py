"""Mentions of sides and option letters in a text answer, and whether each of them is denied."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

Named = Literal["left", "right", "center"]

_SIDE_OF: dict[str, Named] = {
    "left": "left", "right": "right", "center": "center", "centre": "center", "middle": "center",
}  # fmt: skip
_SIDE = re.compile(r"\b(left|right|cent(?:er|re)|middle)(?:most|hand)?\b", re.IGNORECASE)
_LETTER = re.compile(r"(?<![\w'])([AB])(?![\w'])")
_CLAUSE = re.compile(
    r"[.,;:!\n]+|[^.,;:!\n]*\?+"
    r"|(?<!everything)(?<!anything)(?<!all)\s+but\b"
    r"|\s+(?:instead(?!\s+of)|rather(?!\s+than)|so|therefore|hence|though|although)\b",
    re.IGNORECASE,
)
_DENIAL = re.compile(
    r"\b(?:not|no|never|nowhere|neither|nor|without|except|avoid|cannot|isnt|wrong|incorrect|false|hardly|barely"
    r"|unlikely|doubt|doubtful|exclud(?:e|ed|ing)|reject(?:ed|ing)?|discard(?:ed|ing)?|eliminat(?:e|ed|ing)"
    r"|(?:rule|rules|ruled|ruling)\s+out|far\s+from|least"
    r"|(?:rather|other)\s+than|instead\s+of|opposite\s+of|(?:everything|anything|all)\s+but)\b|n't\b",
    re.IGNORECASE,
)
_DENIED_BEHIND = re.compile(
    r"\s+(?:(?:one|side|picture|image|tile|option|answer)\s+)?"
    r"(?:(?:is|are|was|were|would\s+be|can\s+be|seems|looks)\s+"
    r"(?:not|hardly|barely|wrong|incorrect|false|unlikely|excluded|rejected|eliminated|ruled\s+out)\b"
    r"|(?:is|was|are|were|does|do|did|ca)n't\b|(?:does|do|did|can)\s+not\b|cannot\b"
    r"|(?:lacks|fails|misses)\b|(?:has|shows|contains|depicts)\s+(?:no|neither)\b)",
    re.IGNORECASE,
)
_DENIED_LABEL = re.compile(
    r"\b(wrong|incorrect|false)((?:\s+(?:one|side|picture|image|tile|option|answer|choice|letter))?)\s*:",
    re.IGNORECASE,
)
"""In front of what is denied: its colon ends no clause."""
_NO_DENIAL = re.compile(
    r"\b(?:no\s+(?:doubt|problem|question|worries)|without\s+(?:a\s+|any\s+)?doubt|not\s+only)\b", re.IGNORECASE
)

_ADVERBIAL = r"(?:now|here|there|next|away|beside|between|behind|above|below|under|in|on|at|after|before|beneath)"
_RIGHT_IS_NO_SIDE = re.compile(
    r"\b(?:that(?:'s|\s+is)|you(?:'re|\s+are)|all|quite)\s+right\b"
    r"|\bright\s+(?:answer|option|choice|letter|decision|place)\b|\bis\s+the\s+right\s+one\b"
    rf"|(?<!the\s)(?<!your\s)(?<!upper\s)(?<!lower\s)(?<!bottom\s)(?<!top\s)(?<!far\s)\bright\s+{_ADVERBIAL}\b"
    r"|\b[ab]\s+(?:is|seems|looks|sounds)\s+right\b(?!\s+(?:side|picture|image|tile))"
    r"|\b(?:seems|looks|sounds)\s+right\b",
    re.IGNORECASE,
)
"""Praise, truth and adverbs."""
_RIGHT_MAY_BE_A_SIDE = re.compile(
    r"\b(?:it|this|which|answer)\s+is\s+right\b(?!\s+(?:side|picture|image|tile))|\bright\s+one\b", re.IGNORECASE
)
"""Truth or a side: it names no side, and beside the other side nothing is clear."""
_PRAISE = re.compile(r"\s*right\s*[,:!.]", re.IGNORECASE)
"""In front of a side; in front of a letter it may be the side."""
_LEFT_IS_NO_SIDE = re.compile(
    r"\b(?:has|have|had)\s+left\b|\bnothing\s+left\b|\bleft\s+(?:over(?!\s+(?:the\s+)?right)|out|behind)\b",
    re.IGNORECASE,
)
_VERB = re.compile(
    r"\s+(?:is|isn't|was|or|and|not|as|seems?|looks?|appears?|shows?|has|matches|contains|depicts|fits|would"
    r"|left|right|cent(?:er|re)|middle)\b",
    re.IGNORECASE,
)


@dataclass
class Mentions:
    """The sides and letters of a text, and those that it denies. Letters are `A` and `B`, sides those of `Named`.

    has_unclear_right: whether a `right` is truth or a side.
    """

    letters: set[str] = field(default_factory=set)
    denied_letters: set[str] = field(default_factory=set)
    sides: set[Named] = field(default_factory=set)
    denied_sides: set[Named] = field(default_factory=set)
    has_unclear_right: bool = False


def mentions_of(text: str) -> Mentions:
    """All of a text, clause by clause: a denial reaches to the end of its clause. Questions are left out."""
    mentions = Mentions()
    for clause in _clauses(text):
        mentions.has_unclear_right |= bool(_RIGHT_MAY_BE_A_SIDE.search(_blanked(_RIGHT_IS_NO_SIDE, clause)))
        for side, is_denied in _sides(clause):
            (mentions.denied_sides if is_denied else mentions.sides).add(side)
        for letter, is_denied in _letters(clause):
            (mentions.denied_letters if is_denied else mentions.letters).add(letter)
    return mentions


def _clauses(text: str) -> Iterator[str]:
    plain = _DENIED_LABEL.sub(r"\1\2", _NO_DENIAL.sub(" ", text))
    praise = _PRAISE.match(plain)
    if praise is not None and _SIDE.search(plain, praise.end()):
        plain = plain[praise.end() :]
    yield from filter(str.strip, _CLAUSE.split(plain))


def _sides(clause: str) -> Iterator[tuple[Named, bool]]:
    clean = clause
    for pattern in (_RIGHT_IS_NO_SIDE, _RIGHT_MAY_BE_A_SIDE, _LEFT_IS_NO_SIDE):
        clean = _blanked(pattern, clean)
    for match in _SIDE.finditer(clean):
        yield _SIDE_OF[match[1].lower()], _is_denied(clean, match)


def _letters(clause: str) -> Iterator[tuple[str, bool]]:
    """Upper case alone; `A` in front of a noun is an article if it begins a clause without another letter."""
    letters = list(_LETTER.finditer(clause))
    is_alone = all(match[1] == "A" for match in letters)
    for match in letters:
        before, behind = clause[: match.start()], clause[match.end() :]
        is_before_noun = re.match(r"\s+(?:[^\W\d_]{2}|[a-z])", behind) and not _VERB.match(behind)
        if not (match[1] == "A" and is_alone and is_before_noun and not before.strip()):
            yield match[1], _is_denied(clause, match)


def _is_denied(clause: str, match: re.Match[str]) -> bool:
    before, behind = clause[: match.start()], clause[match.end() :]
    return bool(_DENIAL.search(before) or _DENIED_BEHIND.match(behind))


def _blanked(pattern: re.Pattern[str], text: str) -> str:
    """The text with spaces where the pattern is found, so that positions stay."""
    return pattern.sub(lambda match: " " * len(match[0]), text)
