"""The sentence template of instructions, and the words that instructions must not contain."""

import re

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
