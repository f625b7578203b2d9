"""JSON for other programs to read: numbers as JSON has them, which are finite."""

import json
from collections.abc import Mapping
from math import isfinite
from typing import Any


def json_text(value: Any, indent: int | None = 2) -> str:
    """Return a value as JSON that every reader takes.

    Python would write NaN and infinity as words that are no JSON, at which JavaScript, for one, gives up.

    Args:
        value: A value of plain types. A number that is not finite becomes null.
        indent: The blanks per level; None for one line.
    """
    try:
        return json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), indent=indent, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not isfinite(value) else value
