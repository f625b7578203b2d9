"""Reads payloads as the page does: what `put` was called with, and the packed arrays."""

import json
import re
from base64 import b64decode
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SCRIPT = re.compile(rb'put\("([^"]+)",(.*)\)\n', re.DOTALL)


def read_payload(script: bytes) -> tuple[str, Any]:
    """Name and value of a payload. Fails for anything but one call of `put`."""
    match = _SCRIPT.fullmatch(script)
    assert match, script[:200]
    return match[1].decode(), json.loads(match[2])


def floats(packed: str) -> NDArray[np.float32]:
    """Values that were packed as float32."""
    return np.frombuffer(b64decode(packed), "<f4")


def log_odds(packed: str) -> NDArray[np.float64]:
    """Log-odds in steps of 1/256; NaN where there are none."""
    steps = np.frombuffer(b64decode(packed), "<i2")
    return np.where(steps == -32768, np.nan, steps / 256)


def words(coded: dict[str, Any]) -> list[Any]:
    """A column of words."""
    return [coded["words"][code] for code in coded["codes"]]
