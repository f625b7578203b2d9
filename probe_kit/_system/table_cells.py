"""The meaning of a cell in a table that people edit: missing, true or false, a number, a name."""

import re
from collections.abc import Callable, Sequence
from typing import Any
from unicodedata import category, normalize

MISSING = frozenset(
    {"", "NA", "N/A", "n/a", "#N/A", "#NA", "<NA>", "NaN", "nan", "NAN", "NaT", "None", "null", "NULL", "Null"}
)
"""Cells that mean "no value": what R, pandas, Python, SQL and spreadsheets write."""
DOUBTFUL = frozenset(
    {"na", "n/a", "n.a.", "<na>", "nan", "-nan", "nat", "null", "none", "nil", "?", "??", ".", "..", "...", "…"}
    | {mark * times for mark in "-‐‑−–—" for times in (1, 2, 3)}
)
"""Cells that some write for "no value" and others for a class, in lower case; `MISSING` comes first."""
FAILED = frozenset(
    {"#value!", "#ref!", "#div/0!", "#name?", "#num!", "#null!", "#spill!", "#calc!", "#getting_data"}
)
"""Cells in which a spreadsheet's formula failed, in lower case."""
# Of a column that holds nothing but true and false; columns of any values have fewer spellings, in `column_cells`.
TRUE = frozenset({"yes", "y", "true", "t", "1", "1.0"})
FALSE = frozenset({"no", "n", "false", "f", "0", "0.0"})
MOST_DIGITS = 400
"""Of an integer that are read: with so many it is refused, and Python converts no more than 4,300."""

_INTEGER = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_INFINITE = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)
_MINUS = re.compile(r"^[‐‑−–—－](?=\s*[0-9.,])")
_MARK = re.compile(r"^'(?=[+-]?[.,]?[0-9])")
"""By which spreadsheets keep a number as text."""
_EDGES = "\u200b\u2060\ufeff"
"""Signs of no width, which Python does not count as white space."""


def plain_cell(text: str) -> str:
    """The cell without white space around it, and with a space for every line break in it."""
    parts = (part.strip().strip(_EDGES).strip() for part in text.splitlines())
    return " ".join(filter(None, parts))


def is_missing(cell: str) -> bool:
    """Return whether a cell that `plain_cell` gave means "no value"."""
    return cell in MISSING


def problem_of(cell: str) -> str | None:
    """Return what is wrong with a cell that is neither a value nor missing for certain; None for others."""
    word = cell.lower()
    if word in DOUBTFUL:
        return f"{cell!r} may mean a missing value or a class. Leave the cell empty, or write a word for the class"
    if word in FAILED:
        return f"{cell!r} is a failed formula; expected a value. Correct the formula, or leave the cell empty"
    return None


def truth_of(cell: Any) -> bool | None:
    """Return True for yes, y, true, t and 1, false for no, n, false, f and 0, in any case; None for others."""
    word = str(cell).strip().lower()
    return True if word in TRUE else False if word in FALSE else None


def with_minus(cell: str) -> str:
    """The cell with a plain minus where a typographic one stands before digits, and without a mark of texts."""
    return _MINUS.sub("-", _MARK.sub("", cell))


def number_of(cell: str) -> int | float | None:
    """The number that a cell spells with digits, a decimal point and an exponent; None for others."""
    text = with_minus(cell)
    if _INTEGER.fullmatch(text):
        return int(text[:MOST_DIGITS])
    if _NUMBER.fullmatch(text) or _INFINITE.fullmatch(text):
        return float(text)
    return None


def name_of(cell: str) -> str:
    """The cell as a name: composed characters (NFC), and one space for every run of white space."""
    return " ".join(normalize("NFC", cell).split())


def check_spellings(cells: Sequence[Any], where: Callable[[int], str], error: Callable[[str], Exception]) -> None:
    """Raise `error` for two spellings of what is probably one name: `red` and `Red`, `7` and `007`.

    Signs that print nothing, such as a soft hyphen, are a spelling too.
    cells: texts as they were written, and values of other types, which have one spelling. where: the place of a
    row, for the message.
    """
    spelled: dict[str, tuple[str, int]] = {}
    for row, cell in enumerate(cells):
        if not isinstance(cell, str):
            continue
        text, written = _spelling(name_of(cell))
        before = spelled.setdefault(text, (written, row))
        if before[0] != written:
            raise error(
                f"{where(row)} is {written!r}, and {where(before[1])} is {before[0]!r}; expected one spelling of "
                "one name. Write both alike, or other names if they differ"
            )


def _spelling(cell: str) -> tuple[str, str]:
    """The part that two spellings of one name share, and the spelling: of a number its zeros in front."""
    number = number_of(cell)
    if number is None:
        return "".join(sign for sign in cell.casefold() if category(sign) != "Cf"), cell
    digits = with_minus(cell).lstrip("+-")
    zeros = re.match(r"0+(?=[0-9])", digits)
    value = f"{number:.17g}" if isinstance(number, float) else str(number)
    return value, f"{zeros[0] if zeros else ''}{value.lstrip('-')}"


def group_names(cells: Sequence[Any], where: Callable[[int], str], error: Callable[[str], Exception]) -> list[str]:
    """Cells as names of groups: `7` and `7.0` are one group, texts are compared as `name_of` has them.

    Raises `error` for two spellings of one name, and for a cell that may mean a missing value.
    """
    names = []
    for row, cell in enumerate(cells):
        if isinstance(cell, str):
            if problem := problem_of(cell):
                raise error(f"{where(row)}: {problem}")
            number = number_of(cell)
            cell = name_of(cell) if number is None else number
        if isinstance(cell, float) and cell.is_integer():
            cell = int(cell)
        names.append(str(cell))
    check_spellings(cells, where, error)
    return names
