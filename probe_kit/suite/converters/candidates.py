"""Candidates: questions with their pictures from any source, before pairing."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from probe_kit.hashing import sha256_text


@dataclass(frozen=True)
class SourcePicture:
    """A picture of the source. `load` gives it upright and RGB; two equal ids are one picture.

    least_side: what the shorter side must have in pixels, None for the usual limit.
    operation: what `load` did to it. original: path or key it is read from.
    """

    image_id: str
    load: Callable[[], Image.Image] = field(compare=False, repr=False)
    original: str
    operation: str = "none"
    least_side: int | None = None
    real_face: bool = False


@dataclass(frozen=True)
class Wording:
    """The wording of an item: its phrase, and the opposite phrase if the question has one."""

    phrase: str
    rule_id: str
    opposite: str | None = None
    article: str = "the"
    proposed_by: Mapping[str, str] | None = None  # model, prompt_sha256, raw reply


@dataclass(frozen=True)
class Candidate:
    """One question of the source with the picture that answers it, and with the one that does not if it has one.

    answer: short answer in words, where the pictures are the answer to a question in words.
    wording: given where the source says what the picture shows; else the rewriting rules have to find one.
    family: pictures are paired inside one family first. forbids: names that must not be in the other picture;
    shows: names it is known to show. needs_person: only a person can accept it.
    """

    source_id: str
    category: str
    question: str
    target: SourcePicture
    distractor: SourcePicture | None = None
    answer: str = ""
    wording: Wording | None = None
    concept: str = ""
    construction: str = "native_pair"
    family: str = ""
    shows: frozenset[str] = frozenset()
    forbids: frozenset[str] = frozenset()
    needs_person: bool = False
    side_word: bool = False

    @property
    def question_sha256(self) -> str:
        """Changes with the question, so that a stale review is noticed."""
        return sha256_text(f"{self.question}\n{self.answer}")


@dataclass
class Reading:
    """The content of a source: candidates, the number of records per category, and why others were left out.

    files: annotation files read. license, attribution, url and revision are those of the source.
    """

    license: str
    attribution: str
    url: str
    redistributable: bool = False
    revision: str = "unknown"
    split: str = "unknown"
    pool: Counter[str] = field(default_factory=Counter)
    candidates: list[Candidate] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)
    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)
