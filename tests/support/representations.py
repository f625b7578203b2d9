"""Other bytes for the content of a record, and what becomes of the hash that it carries."""

import json
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from probe_kit.runs.records import HASH, as_json, as_record, digest

Content = dict[str, Any]
Way = Callable[[Content], bytes]
_LINE = re.compile(rb'\s*"blake2b"\s*:\s*"[^"]*"\s*,?')
_INTEGER = re.compile(r"(?<=[\s\[:,])(-?\d+)(?=[\s,\]}])")


def text_of(content: Content) -> str:
    """As probe_kit writes it, with the hash that is given, or none, first."""
    rest = as_json({key: value for key, value in content.items() if key != HASH}).decode()
    return f'{{\n "{HASH}": "{content[HASH]}",{rest[1:]}' if HASH in content else rest


def _reversed(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _reversed(value[key]) for key in reversed(value)}
    return [_reversed(one) for one in value] if isinstance(value, list) else value


def _twice(content: Content) -> bytes:
    """Each key of the outermost object again at its end, with another value; parsers keep the last one."""
    last = {key: "0" * 64 if key == HASH else None for key in content}
    return (text_of(content)[:-2] + "," + json.dumps(last)[1:]).encode()


def _second_hash(content: Content) -> bytes:
    return (text_of(content)[:-2] + f',\n "{HASH}": "{"0" * 64}"\n}}').encode()


def _numbers(spell: Callable[[str], str]) -> Way:
    return lambda content: _INTEGER.sub(lambda found: spell(found[1]), text_of(content)).encode()


def _exponent(digits: str) -> str:
    return f"{digits[:-1]}e1" if digits.endswith("0") and len(digits) > 1 else f"{digits}e0"


WAYS: Mapping[str, Way] = {
    "leading space": lambda content: b" " + text_of(content).encode(),
    "trailing newline": lambda content: text_of(content).encode() + b"\n",
    "byte order mark": lambda content: b"\xef\xbb\xbf" + text_of(content).encode(),
    "CRLF": lambda content: text_of(content).replace("\n", "\r\n").encode(),
    "indented by json.dump": lambda content: json.dumps(content, indent=2).encode(),
    "in one line": lambda content: json.dumps(content).encode(),
    "other order": lambda content: json.dumps(_reversed(content), indent=1).encode(),
    "keys twice": _twice,
    "two hashes": _second_hash,
    "10.0 for 10": _numbers(lambda digits: f"{digits}.0"),
    "1e1 for 10": _numbers(_exponent),
    "escaped letters": lambda content: text_of(content).replace("a", "\\u0061").encode(),
    "UTF-16": lambda content: text_of(content).encode("utf-16"),
}
"""Ways to write content that probe_kit never writes; every parser of JSON reads nearly all of them."""


def carrying(content: Content, kept: str, way: Way) -> Iterable[tuple[str, bytes]]:
    """The bytes with the hash of before, with that of the content, with that of all other bytes, and with none."""
    rest = {key: value for key, value in content.items() if key != HASH}
    yield "the hash kept", way({HASH: kept, **rest})
    yield "the hash of the content", way({HASH: digest(as_json(rest)), **rest})
    own = digest(_LINE.sub(b"", way({HASH: kept, **rest}), count=1))
    yield "the hash of the bytes", way({HASH: own, **rest})
    yield "no hash", way(rest)


def rewritten(content: Content) -> bytes:
    """As probe_kit writes it, with its own hash computed anew."""
    return as_record({key: value for key, value in content.items() if key != HASH})
