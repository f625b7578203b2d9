"""Coding of payloads: packed arrays, coded words, and scripts that open from a file and from a server."""

import json
from base64 import b64encode
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from probe_kit._system.escaping import terminal_safe, without_places

LOG_ODDS_SCALE = 256
"""Steps per unit of log-odds: the error is below 0.002."""
MISSING = -32768
"""In place of a log-odds that does not exist, such as that of an inference the episode did not reach."""


class Packed(str):
    """Base64 of a little-endian array, which is data and no text."""

    __slots__ = ()


def pack_floats(values: ArrayLike) -> Packed:
    """The values as float32, row by row."""
    return _packed(values, "<f4")


def pack_log_odds(values: ArrayLike) -> Packed:
    """Log-odds as int16 in steps of 1/256, at most ±127.99; not a number becomes `MISSING`."""
    scaled = np.asarray(values, np.float64) * LOG_ODDS_SCALE
    steps = np.clip(np.round(scaled), MISSING + 1, -MISSING - 1)
    return _packed(np.where(np.isnan(scaled), MISSING, steps), "<i2")


def _packed(values: ArrayLike, kind: str) -> Packed:
    return Packed(b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii"))


def code_words(words: Sequence[Any]) -> dict[str, Any]:
    """`words` once each, and a `codes` entry per place; None stays None."""
    distinct = list(dict.fromkeys(words))
    code = {word: number for number, word in enumerate(distinct)}
    return {"words": distinct, "codes": [code[word] for word in words]}


def rounded(value: Any, digits: int = 4) -> float | None:
    """A JSON number of so many decimals; None for None and for not a number."""
    return None if value is None or value != value else round(float(value), digits)


def payload_script(name: str, value: Any, places: tuple[str, ...] = ()) -> bytes:
    """The script `put(name, value)` in ASCII.

    Text of `value` has visible signs in place of control and direction characters, and the last part alone of
    `places` and other absolute paths. No `<` is left, so that no text can end the script.
    """
    return _script("put", name, _encode(value, places))


def failure_script(name: str, words: str, places: tuple[str, ...] = ()) -> bytes:
    """The script `refuse(name, words)`: why there is no payload of this name, for the page to show."""
    return _script("refuse", name, _encode(words, places))


def _script(function: str, name: str, value: Any) -> bytes:
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return f"{function}({json.dumps(name)},{text})\n".replace("<", "\\u003c").encode("ascii")


def _encode(value: Any, places: tuple[str, ...]) -> Any:
    if isinstance(value, Packed):
        return value
    if isinstance(value, str):
        return without_places(terminal_safe(value), places)
    if isinstance(value, dict):
        return {_encode(key, places): _encode(entry, places) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encode(entry, places) for entry in value]
    return value
