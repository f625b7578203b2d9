"""The formats of numbers in tables, sentences and figures: a dash stands for a missing number."""

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

NONE = "–"
"""The sign in place of a missing number."""
Limits = tuple[float | None, float | None]
"""A 95 % interval; (None, None) where the data set no limits."""
Write = Callable[[float | None], str]


def plain(value: Any) -> str:
    """Return a count or a text as it is; a dash for None."""
    return NONE if value is None else str(value)


def percent(value: float | None, digits: int = 1) -> str:
    """Return a share as a percentage, by default with one decimal."""
    return number(None if value is None else 100 * value, digits)


def whole_percent(value: float | None) -> str:
    """Return a share as a percentage without decimals."""
    return percent(value, 0)


def number(value: float | None, digits: int = 2) -> str:
    """Return a number, by default with two decimals, and zero without a sign; a dash for None and NaN."""
    return NONE if value is None or is_missing(value) else f"{value:z.{digits}f}"


def with_sign(value: float | None, digits: int = 2) -> str:
    """Return a number with its sign, by default with two decimals; a dash for None and NaN."""
    return NONE if value is None or is_missing(value) else f"{value:+z.{digits}f}"


def points(value: float | None) -> str:
    """Return a difference of shares in percentage points, with its sign and one decimal."""
    return with_sign(None if value is None else 100 * value, 1)


def p_text(value: float | None) -> str:
    """Return a p-value with three decimals."""
    return "< 0.001" if value is not None and value < 0.001 else number(value, 3)


def span(values: Sequence[int]) -> str:
    """Return the least and the largest of some whole numbers, or the only one."""
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low}–{high}"


def is_missing(value: float | None) -> bool:
    """Whether there is no number: None or NaN."""
    return value is None or value != value


def limits_text(limits: Limits, write: Write) -> str:
    """Return an interval in brackets, both ends in the format `write`."""
    low, high = limits
    if low is None or high is None or not (isfinite(low) and isfinite(high)):
        return "[no limits]"
    return f"[{write(low)}, {write(high)}]"


def with_limits(value: float | None, limits: Limits | None, write: Write) -> str:
    """Return a value with its interval in brackets, if it has one, both in the format `write`."""
    if limits is None or is_missing(value):
        return write(value)
    return f"{write(value)} {limits_text(limits, write)}"
