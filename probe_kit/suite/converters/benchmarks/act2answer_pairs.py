"""The questions of a set in Act2Answer's format: `pairs.json`, with checks of what its release would misread."""

from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from probe_kit.errors import SuiteError
from probe_kit.suite.converters.files import field_of, read_json
from probe_kit.suite.items import Side

SOURCE = "act2answer"
PAIRS = "pairs.json"
REMEDY = "Name the folder of one set, such as carrot/test_colors, with its shapes."
_SIDES: dict[str, Side] = {"left": "left", "right": "right"}


@dataclass(frozen=True)
class Pair:
    """One question. left, right: names of its tiles. concepts: what their pictures are called, left and right."""

    index: int
    left: str
    right: str
    question: str
    answer: Side
    concepts: tuple[str, str]


def read_pairs(root: Path) -> list[Pair]:
    """Every question in the order of its index.

    Raises SuiteError for an answer that is no side (the release takes it for left), for one tile on both sides (it
    has one body per name), and for indices that are not 0, 1, 2 … (it asks for them one by one).
    """
    path = root / PAIRS
    records = read_json(path, SOURCE, REMEDY)
    if not isinstance(records, list) or not records:
        raise SuiteError(f"{SOURCE}: {path} holds {type(records).__name__}; expected a list of questions.")
    read = (_pair(record, position, path) for position, record in enumerate(records))
    pairs = sorted(read, key=attrgetter("index"))
    gap = next((place for place, pair in enumerate(pairs) if pair.index != place), None)
    if gap is not None:
        raise SuiteError(
            f"{SOURCE}: {path} has {len(pairs)} questions, and index {pairs[gap].index} where {gap} was "
            "expected; the release asks for 0, 1, 2 … without a gap. Correct the file."
        )
    return pairs


def _pair(record: Any, position: int, path: Path) -> Pair:
    where = f"question {position} of {path}"
    index = record.get("index", position) if isinstance(record, dict) else position
    if not isinstance(index, int) or isinstance(index, bool):
        raise SuiteError(f"{SOURCE}: {where}: index is {index!r}; expected a whole number.")
    left, right, question, answer = (
        field_of(record, name, str, SOURCE, where) for name in ("left", "right", "question", "answer")
    )
    side = answer.strip().lower()
    if side not in _SIDES:
        raise SuiteError(
            f"{SOURCE}: {where}: answer is {answer!r}; expected Left or Right. The release would take it for left."
        )
    if left == right:
        raise SuiteError(
            f"{SOURCE}: {where}: the tile {left!r} lies on both sides; the release has one body per name."
        )
    if not question.strip() or len(question.splitlines()) != 1:
        raise SuiteError(f"{SOURCE}: {where}: question is {question!r}; expected one line of words.")
    labels = tuple(str(record.get(f"{side}_label") or "").strip() for side in _SIDES)
    concepts = (labels[0], labels[1]) if all(labels) and labels[0] != labels[1] else (left, right)
    return Pair(index, left, right, question, _SIDES[side], concepts)


def object_of(question: str) -> tuple[str, str]:
    """What a question asks for, and its article: the words behind "on"; all words where there is no "on"."""
    _, found, behind = question.partition(" on ")
    phrase = (behind if found else question).strip().rstrip(".").strip()
    article, space, noun = phrase.partition(" ")
    return (noun.strip(), "the") if space and article.lower() == "the" else (phrase, "none")
