"""The words of a question: the template of instructions, words they must not contain, and other wordings.

`knowledge` is the item's own instruction; `named` says what the correct picture literally shows; `side` says where
it is; `neutral` asks for any picture. A model that fails `knowledge` and passes `named` lacks the knowledge. One
that fails `side` lacks the skill. The score of `neutral` is the share that needs no instruction.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite.items import Episode

VERBATIM = "verbatim"
"""Rule of items whose instruction is their source's own question, not a sentence of ours."""
MOST_WORDS = 12
MOST_CHARACTERS = 80
_SIDE_WORDS = frozenset(
    {"left", "right", "first", "second", "leftmost", "rightmost", "centre", "center", "middle"}
)


def instruction_for(object_phrase: str, article: str) -> str:
    """The imperative that names the object, with `article` "the", or "none" for bare names."""
    return f"Put the cube on {'the ' if article == 'the' else ''}{object_phrase}"


def side_words(text: str) -> tuple[str, ...]:
    """Words that name a side or a place in a row: they would collide with the answers left and right."""
    return tuple(word for word in re.findall(r"[a-z]+", text.lower()) if word in _SIDE_WORDS)


Wording = Literal["knowledge", "named", "side", "neutral"]
WORDINGS: tuple[Wording, ...] = ("knowledge", "named", "side", "neutral")
SIDE = "Put the cube on the {side} picture"
NEUTRAL = "Put the cube on one of the two pictures"
"""What `side` and `neutral` say where an item has no words of its own for them."""


def check_wordings(names: Sequence[str]) -> tuple[Wording, ...]:
    """The names, each once. Raises UsageError for an unknown one, for none, and for one that comes twice."""
    unknown = [name for name in names if name not in WORDINGS]
    if unknown or not names:
        problem = repr(unknown[0]) if unknown else "empty"
        raise UsageError(f"wordings: {problem}; expected some of {', '.join(WORDINGS)}")
    if len(set(names)) < len(names):
        raise UsageError(f"wordings {','.join(names)}: one comes twice; name each once")
    return tuple(name for name in names if name in WORDINGS)


def in_words(episode: Episode, wording: Wording) -> Episode | None:
    """The episode with its instruction in `wording`, or None where the item has none.

    An item's `wordings` say what it has; `{side}` stands for the side of the correct picture in the layout. Raises
    SuiteError if its wording `side` never says where, because it would then tell both layouts the same.
    """
    item = episode.item
    wording_text = item.wordings.get(wording)
    if wording == "knowledge":
        text: str | None = item.instruction
    elif wording == "side":
        text = SIDE if wording_text is None else wording_text
        if "{side}" not in text:
            raise SuiteError(
                f"item {item.item_id}: its wording 'side' is {text!r}; expected a text that contains '{{side}}', "
                "which stands for left or right. Correct it in the suite's metadata."
            )
        text = text.replace("{side}", episode.side_correct)
    else:
        text = NEUTRAL if wording_text is None and wording == "neutral" else wording_text
    return None if not text else replace(episode, item=replace(item, instruction=text), wording=wording)
