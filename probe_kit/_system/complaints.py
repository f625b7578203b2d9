"""The complaints of pydantic about values, in our words: what was seen and what is expected."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

_BOUNDS = {"ge": "at least", "le": "at most", "gt": "more than", "lt": "less than"}
_LONGEST = 60
"""The characters of a name or value that a message quotes."""
MISSING, UNKNOWN = "is missing", "is unknown"

Complaint = tuple[tuple[int | str, ...], str]
"""The path of a value, and what is wrong with it, such as `is -1; expected at least 0`."""


def complaints_of(error: ValidationError) -> Iterator[Complaint]:
    """Yield every complaint. The path of a union's choice ends in a word of pydantic for the choice."""
    for mistake in error.errors(include_url=False):
        # Validators of ours stand in pydantic's paths under the names of their functions.
        path = tuple(part for part in mistake["loc"] if not str(part).startswith("function-"))
        yield path, _complaint(dict(mistake))


def in_words(error: ValidationError, most: int | None = 1) -> str:
    """Return the first `most` complaints in a line, each with its path; None for all."""
    sentences = [f"{'.'.join(map(str, path))} {text}".strip() for path, text in complaints_of(error)]
    return "; ".join(sentences[:most])


def _complaint(mistake: Mapping[str, Any]) -> str:
    if mistake["type"] in (missing := {"missing": MISSING, "extra_forbidden": UNKNOWN}):
        return missing[mistake["type"]]
    value, context, message = mistake["input"], mistake.get("ctx", {}), mistake["msg"]
    bounds = [f"{words} {context[bound]}" for bound, words in _BOUNDS.items() if bound in context]
    if mistake["type"] == "value_error":  # of a validator of ours, whose sentence says all
        expected = str(context["error"])
    elif bounds:
        expected = f"expected {' and '.join(bounds)}"
    elif "expected" in context:
        choices = context["expected"].replace("'", "").replace(" or ", ", ")
        expected = f"expected {'one of ' if ', ' in choices else ''}{choices}"
    elif (plain := message.removeprefix("Input should be ")) != message:
        expected = f"expected {plain}"
    else:
        expected = f"{message[:1].lower()}{message[1:]}"
    if isinstance(value, Mapping):  # a whole table is no help beside what is expected in its place
        return expected if mistake["type"] == "value_error" else f"is a table; {expected}"
    return f"is {shorten_text(repr(value))}; {expected}"


def shorten_text(text: str) -> str:
    """Return a text, or the beginning of a long one."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def join_complaints(texts: Sequence[str]) -> str:
    """Return as one complaint what the choices of a union say about one value."""
    first, *alternatives = texts
    return " or ".join([first, *(text.partition("expected ")[2] or text for text in alternatives)])
