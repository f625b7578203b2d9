"""Answers in words: mentions of sides, the meaning of a text, and scores from text and logits.

An answer that cannot be read is no wrong answer and is not left out: it is `oob`, with the rule that found it so.
An inverted answer is worse than an unreadable one: a text which denies or contradicts itself is unreadable.
"""

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError
from probe_kit.extract.prompts import Order, Query, Template, sides
from probe_kit.suite import Side
from probe_kit.suite.items import other_side

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel


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
"""A label in front of what is denied: its colon ends no clause."""
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
"""Uses of "right" as praise, truth and adverbs."""
_RIGHT_MAY_BE_A_SIDE = re.compile(
    r"\b(?:it|this|which|answer)\s+is\s+right\b(?!\s+(?:side|picture|image|tile))|\bright\s+one\b", re.IGNORECASE
)
"""Uses of "right" as truth or a side: it names no side, and beside the other side nothing is clear."""
_PRAISE = re.compile(r"\s*right\s*[,:!.]", re.IGNORECASE)
"""Praise in front of a side; in front of a letter it may be the side."""
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

    Attributes:
        has_unclear_right: Whether a `right` is truth or a side.
    """

    letters: set[str] = field(default_factory=set)
    denied_letters: set[str] = field(default_factory=set)
    sides: set[Named] = field(default_factory=set)
    denied_sides: set[Named] = field(default_factory=set)
    has_unclear_right: bool = False


def mentions_of(text: str) -> Mentions:
    """Return all mentions of a text, clause by clause: a denial reaches to the end of its clause.

    Questions are left out.
    """
    mentions = Mentions()
    for clause in _clauses(text):
        mentions.has_unclear_right |= bool(_RIGHT_MAY_BE_A_SIDE.search(_blank_matches(_RIGHT_IS_NO_SIDE, clause)))
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
        clean = _blank_matches(pattern, clean)
    for match in _SIDE.finditer(clean):
        yield _SIDE_OF[match[1].lower()], _is_denied(clean, match)


def _letters(clause: str) -> Iterator[tuple[str, bool]]:
    """Yield upper-case letters and whether each is denied.

    `A` in front of a noun is an article if it begins a clause without another letter.
    """
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


def _blank_matches(pattern: re.Pattern[str], text: str) -> str:
    """Return the text with spaces where the pattern matches, so that positions stay."""
    return pattern.sub(lambda match: " " * len(match[0]), text)


# -- the meaning of a text ---------------------------------------------------------------------------------------


Said = Literal["left", "right", "center", "yes", "no", "none"]
Tier = Literal["strict", "clause"]
"""The certainty of a reading.

`strict`: the whole text is an option or a side. `clause`: one was found among other words.
"""

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
"""A phrase of two denials, as in "It's not that I can't see it"."""
_REFUSAL = re.compile(
    r"\b(?:sorry|cannot|can\s+not|can't|unable|not\s+sure|unsure|don't\s+know|do\s+not\s+know|not\s+able|unclear"
    r"|not\s+certain|uncertain|impossible)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Answer:
    """An answer as it was read.

    Attributes:
        rule: The rule that decided, as the outcome of an episode records it.
        tier: The certainty of the reading; None for no meaning.
    """

    meaning: Said
    rule: str
    tier: Tier | None = None


def read_answer(text: str, template: Template, order: Order = "original") -> Answer:
    """Read an answer to `template`, its sides named in `order`. The first rule that applies decides."""
    plain = _strip_markup(text)
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


def _strip_markup(text: str) -> str:
    """Return a text without thoughts, special tokens, markup, reasons and outer spaces.

    Nothing of an unfinished thought remains.
    """
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
    """Return the option that is named; None where the text has no letter."""
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


# -- scores ------------------------------------------------------------------------------------------------------


Outcome = Literal["correct", "wrong", "oob"]
Placed = Literal["left", "right", "none"]


def side_said(meaning: Said) -> Placed:
    """Return the side an answer puts the object on; none for everything else it may say."""
    return meaning if meaning in ("left", "right") else "none"


def side_expected(query: Query, side_correct: Side) -> Side | None:
    """Return the side of the object that is asked for; None for an object that neither picture shows."""
    if query == "absent":
        return None
    return side_correct if query == "target" else other_side(side_correct)


def outcome_of(meaning: Said, expected: Side | None) -> Outcome:
    """Judge an answer. Where neither picture shows the object, "no" is correct and every place is wrong."""
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
    """The logits of the admissible answers, by what each says, in one or two orders of the sides.

    Attributes:
        passes: The logits with left named first and, where the prompt can be turned round, with right named first.
    """

    passes: Sequence[Mapping[Said, float]]

    @property
    def margins(self) -> list[float]:
        """The margin of every pass: left minus right; for an object that is not visible, no minus yes."""
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
    """Return the logit lens at every layer: the letter for left minus that for right, by the model's own head.

    The model's own norm comes before its head. One layer is computed at a time, so that no batch changes a number.

    Args:
        model: A model with an unembedding.
        residuals: (L, D) float32 of the position that chooses the letter.
        letters: (2,) token ids, left and right.
        margin: The margin of the model's own answer, which the last layer must give up to rounding.

    Raises:
        CaptureError: If the last layer gives another margin.
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
