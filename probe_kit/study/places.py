"""Lines of a TOML text by the path of a value, so that a mistake names the line it stands in."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

Place = tuple[str | int, ...]
_HEADER = re.compile(r"\s*(\[\[?)([^\[\]]+)\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*((?:[\w-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[\w-]+|\"[^\"]*\"|'[^']*'))*)\s*=")
_TOKEN = re.compile(r"#[^\n]*|\"\"\"(?:\\.|[^\\])*?\"\"\"|'''.*?'''|\"(?:\\.|[^\"\\\n])*\"|'[^'\n]*'", re.DOTALL)
_STRING = re.compile(r"\"(?:\\.|[^\"\\])*\"|'[^']*'")


def line_of(text: str, path: Sequence[str | int]) -> int:
    """The line, from 1, of the value at `path`, or of the nearest table or key around it; 1 for the whole file."""
    known = dict(_places(text))
    for length in range(len(path), 0, -1):
        around = tuple(path[:length])
        if around in known:
            return known[around]
        if inside := [line for place, line in known.items() if place[:length] == around]:
            return inside[0]
    return 1


def part_in_file(path: Place, content: Any) -> Place:
    """The part of a path that leads to a value of the content of a file."""
    for at, part in enumerate(path):
        try:
            content = content[part]
        except (KeyError, IndexError, TypeError):
            return path[:at]
    return path


def _places(text: str) -> Iterator[tuple[Place, int]]:
    """Paths of all headers and keys; of several values of one key only the key has a place."""
    table: Place = ()
    counts: Counter[Place] = Counter()
    open_brackets = 0
    for number, line in enumerate(_TOKEN.sub(_on_one_line, text).split("\n"), 1):
        plain = _STRING.sub('""', line).partition("#")[0]
        if open_brackets > 0:
            open_brackets += _balance(plain)
            continue
        if (header := _HEADER.match(line)) and not _KEY.match(line):
            table = _inside(_path(f"[{header[2]}]"), counts)
            if header[1] == "[[":
                table = (*table, counts[table])
                counts[table[:-1]] += 1
            yield table, number
        elif key := _KEY.match(line):
            yield (*table, *_path(f"{key[1]} = 0")), number
            open_brackets = _balance(plain)


def _inside(names: Place, counts: Counter[Place]) -> Place:
    """The path of a header, in the last table of every list of tables around it."""
    path: Place = ()
    for name in names:
        path = (*path, counts[path] - 1, name) if path and counts[path] else (*path, name)
    return path


def _on_one_line(token: re.Match[str]) -> str:
    """A string of several lines as an empty one and its line ends; other strings and comments as they are."""
    several = token[0].startswith(('"""', "'''"))
    return f'""{"\n" * token[0].count("\n")}' if several else token[0]


def _balance(line: str) -> int:
    return sum(line.count(one) for one in "[{") - sum(line.count(one) for one in "]}")


def _path(line: str) -> Place:
    """The names of a header or key."""
    value: Any = tomllib.loads(line)
    path: list[str] = []
    while isinstance(value, dict) and value:
        ((name, value),) = value.items()
        path.append(name)
    return tuple(path)
