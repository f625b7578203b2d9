"""Lines of a TOML text by the path of a value, so that a mistake names the line it stands in."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

Path = tuple[str | int, ...]
_HEADER = re.compile(r"\s*(\[\[?)([^\[\]]+)\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*((?:[\w-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[\w-]+|\"[^\"]*\"|'[^']*'))*)\s*=")
_STRING = re.compile(r"\"(?:\\.|[^\"\\])*\"|'[^']*'")


def line_of(text: str, path: Sequence[str | int]) -> int:
    """The line, from 1, of the value at `path`, or of the nearest table or key around it; 1 for the whole file."""
    known = dict(_places(text))
    for length in range(len(path), 0, -1):
        if (found := known.get(tuple(path[:length]))) is not None:
            return found
    return 1


def _places(text: str) -> Iterator[tuple[Path, int]]:
    """Paths of all headers and keys; of several values of one key only the key has a place."""
    table: Path = ()
    counts: Counter[Path] = Counter()
    open_brackets = 0
    for number, line in enumerate(text.splitlines(), 1):
        plain = _STRING.sub('""', line).partition("#")[0]
        if open_brackets > 0:
            open_brackets += _balance(plain)
            continue
        if (header := _HEADER.match(line)) and not _KEY.match(line):
            table = _path(f"[{header[2]}]")
            if header[1] == "[[":
                table = (*table, counts[table])
                counts[table[:-1]] += 1
            yield table, number
        elif key := _KEY.match(line):
            yield (*table, *_path(f"{key[1]} = 0")), number
            open_brackets = _balance(plain)


def _balance(line: str) -> int:
    return sum(line.count(one) for one in "[{") - sum(line.count(one) for one in "]}")


def _path(line: str) -> Path:
    """The names of a header or key."""
    value: Any = tomllib.loads(line)
    path: list[str] = []
    while isinstance(value, dict) and value:
        ((name, value),) = value.items()
        path.append(name)
    return tuple(path)
