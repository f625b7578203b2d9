"""Cases of a test of which some run by default, and the others with `-m slow`."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def slow_but(default: Collection[Any], names: Iterable[Any]) -> list[Any]:
    """Return every name as a parameter of a test; all but the default ones are slow."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name not in default)) for name in names]
