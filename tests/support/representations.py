"""Spellings of JSON: those that hold the same values, and those that hold others or none."""

import json
from collections.abc import Callable, Mapping
from typing import Any

from probe_kit.runs.records import HASH, as_record

Content = dict[str, Any]
Way = Callable[[Content], bytes]


def _reversed(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _reversed(value[key]) for key in reversed(value)}
    return [_reversed(item) for item in value] if isinstance(value, list) else value


def _twice(content: Content) -> bytes:
    """Each key of the outermost object again at its end, with another value; parsers keep the last one."""
    last = {key: "0" * 64 if key == HASH else None for key in content}
    return (json.dumps(content)[:-1] + "," + json.dumps(last)[1:]).encode()


SPELLINGS: Mapping[str, Way] = {
    "leading space": lambda content: b" " + json.dumps(content).encode(),
    "trailing newline": lambda content: json.dumps(content).encode() + b"\n",
    "CRLF": lambda content: json.dumps(content, indent=1).replace("\n", "\r\n").encode(),
    "indented": lambda content: json.dumps(content, indent=2).encode(),
    "no spaces": lambda content: json.dumps(content, separators=(",", ":")).encode(),
    "other order": lambda content: json.dumps({key: content[key] for key in reversed(content)}).encode(),
    "letters as they are": lambda content: json.dumps(content, ensure_ascii=False).encode(),
    "escaped letters": lambda content: json.dumps(content).replace("a", "\\u0061").encode(),
}
"""Spellings of the same values."""
OTHERS: Mapping[str, Way] = {
    "byte order mark": lambda content: b"\xef\xbb\xbf" + json.dumps(content).encode(),
    "keys twice": _twice,
    "two hashes": lambda content: (json.dumps(content)[:-1] + f', "{HASH}": "{"0" * 64}"}}').encode(),
    "no hash": lambda content: json.dumps({key: value for key, value in content.items() if key != HASH}).encode(),
    "UTF-16": lambda content: json.dumps(content).encode("utf-16"),
}
"""Bytes that are no record, though many parsers read them."""


def rewritten(content: Content) -> bytes:
    """As probe_kit writes it, with its own hash computed anew."""
    return as_record({key: value for key, value in content.items() if key != HASH})
