"""Mistakes in a study file: the path of each value, what is wrong, and what would be right."""

import json
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from probe_kit._system.complaints import shortened
from probe_kit.errors import UsageError

Place = tuple[str | int, ...]
_BARE = re.compile(r"[\w.-]+")


@dataclass(frozen=True)
class Mistake:
    """A mistake in a file. path: of the value, such as `("runs", 0, "models")`. text: the fault and the remedy."""

    path: Place
    text: str

    @property
    def field(self) -> str:
        """The path as it would be written, such as `runs[0].models`."""
        parts = [f"[{part}]" if isinstance(part, int) else f".{_key(part)}" for part in self.path]
        return "".join(parts).removeprefix(".") or "the file"


def _key(name: str) -> str:
    """A name on one line, in quotes where it needs them."""
    return shortened(name if _BARE.fullmatch(name) else json.dumps(name))


class StudyFileError(UsageError):
    """A study file has mistakes; the message lists all of them in the order of the file, each with its path."""

    def __init__(self, file: str, content: dict[str, Any], mistakes: Sequence[Mistake]) -> None:
        self.mistakes = tuple(sorted(mistakes, key=lambda mistake: _order(content, mistake.path)))
        super().__init__("\n".join(f"{file}: {mistake.field}: {mistake.text}" for mistake in self.mistakes))


def part_in_file(path: Place, content: Any) -> Place:
    """The part of a path that leads to a value of the content of a file."""
    for at, part in enumerate(path):
        try:
            content = content[part]
        except (KeyError, IndexError, TypeError):
            return path[:at]
    return path


def _order(content: Any, path: Place) -> list[int]:
    """The position of a value among its neighbours, in every table and list around it."""
    positions = []
    for part in part_in_file(path, content):
        positions.append(part if isinstance(part, int) else list(content).index(part))
        content = content[part]
    return positions


def unknown(what: str, name: str, names: Collection[str], none: str = "there are none") -> str:
    """Return a sentence on a name that is unknown, with the nearest match."""
    near = get_close_matches(name, names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"unknown {what} {shortened(name)!r}; known: {', '.join(names) or none}.{hint}"
