"""The meaning of a cell in a table that people edit: missing, true or false, a number, a name."""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any
from unicodedata import category, normalize

from probe_kit.errors import UsageError

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
# Of a column that holds nothing but true and false; columns of any values have fewer spellings, below.
TRUE = frozenset({"yes", "y", "true", "t", "1", "1.0"})
FALSE = frozenset({"no", "n", "false", "f", "0", "0.0"})
MOST_DIGITS = 400
"""The digits of an integer that are read: with so many it is refused; Python converts no more than 4,300."""

MOST_COUNT_DIGITS = 18
"""The digits of a number that counts or numbers things; so many fit into 64 bits."""

_INTEGER = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_PLAIN = re.compile(r"[+-]?(0|[1-9][0-9]*)(\.[0-9]*)?")
"""A number that can be no short name: no zeros in front of it, and no exponent."""
_WHOLE = re.compile(r"([+-]?)0*([0-9]+)(?:\.0*)?")
"""A whole number, by its sign and its digits without zeros in front."""
_INFINITE = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)
_MINUS = re.compile(r"^[‐‑−–—－](?=\s*[0-9.,])")
_MARK = re.compile(r"^'(?=[+-]?[.,]?[0-9])")
"""The mark by which spreadsheets keep a number as text."""
_EDGES = "\u200b\u2060\ufeff"
"""Signs of no width, which Python does not count as white space."""


def is_count(text: str) -> bool:
    """Whether a text is a whole number from 0 on in digits alone, of at most `MOST_COUNT_DIGITS`.

    Python converts no more than 4,300 digits, and arrays hold no more than 64 bits.
    """
    return text.isdecimal() and len(text) <= MOST_COUNT_DIGITS


def plain_cell(text: str) -> str:
    """Return the cell without white space around it, and with a space for every line break in it."""
    parts = (part.strip().strip(_EDGES).strip() for part in text.splitlines())
    return " ".join(filter(None, parts))


def is_missing(cell: str) -> bool:
    """Whether a cell that `plain_cell` returned means "no value"."""
    return cell in MISSING


def problem_of(cell: str) -> str | None:
    """Return what is wrong with a cell that is neither a value nor missing for certain; None for any other."""
    word = cell.lower()
    if word in DOUBTFUL:
        return f"{cell!r} may mean a missing value or a class. Leave the cell empty, or write a word for the class"
    if word in FAILED:
        return f"{cell!r} is a failed formula; expected a value. Correct the formula, or leave the cell empty"
    return None


def truth_of(cell: Any) -> bool | None:
    """Return True for yes, y, true, t and 1, False for no, n, false, f and 0, in any case; None for others."""
    word = str(cell).strip().lower()
    return True if word in TRUE else False if word in FALSE else None


def with_minus(cell: str) -> str:
    """Return the cell with a plain minus for a typographic one before digits, and without a mark of texts."""
    return _MINUS.sub("-", _MARK.sub("", cell))


def number_of(cell: str) -> int | float | None:
    """Return the number that a cell spells with digits, a decimal point and an exponent; None for any other."""
    text = with_minus(cell)
    if _INTEGER.fullmatch(text):
        return int(text[:MOST_DIGITS])
    if _NUMBER.fullmatch(text) or _INFINITE.fullmatch(text):
        return float(text)
    return None


def name_of(cell: str) -> str:
    """Return the cell as a name: composed characters (NFC), and one space for every run of white space."""
    return " ".join(normalize("NFC", cell).split())


def name_in(cell: Any) -> str:
    """Return the name that a typed cell spells: a text as it is written, a whole number by its digits.

    Numbers without decimals are integers: tables with empty cells store integers as decimals.
    """
    return str(int(cell)) if isinstance(cell, float) and cell.is_integer() else str(cell)


def check_spellings(
    cells: Sequence[Any], where: Callable[[int], str], error: Callable[[str], Exception], as_names: bool = False
) -> None:
    """Raise `error` for two spellings of what is probably one name: `red` and `Red`, `7` and `007`.

    Signs that print nothing, such as a soft hyphen, are a spelling too.

    Args:
        cells: Texts as they were written, and values of other types, which have one spelling.
        where: The place of a row by its index, for the message.
        error: The class of the error, or a function that makes one of a message.
        as_names: Whether texts of digits are names. Then `7.0` and `7` are two spellings, and `1e5` and `1.10` are
            other names than `100000` and `1.1`.
    """
    spelled: dict[str, tuple[str, int]] = {}
    for row, cell in enumerate(cells):
        if not isinstance(cell, str):
            continue
        name = name_of(cell)
        text, written = (alike(name), name) if as_names else _spelling(name)
        before = spelled.setdefault(text, (written, row))
        if before[0] != written:
            raise error(
                f"{where(row)} is {written!r}, and {where(before[1])} is {before[0]!r}; expected one spelling of "
                "one name. Write both alike, or other names if they differ"
            )


def _spelling(cell: str) -> tuple[str, str]:
    """Return the part that two spellings of one value share, and the spelling: of a number its zeros in front."""
    number = number_of(cell)
    if number is None:
        return _print_cell(cell), cell
    digits = with_minus(cell).lstrip("+-")
    zeros = re.match(r"0+(?=[0-9])", digits)
    value = f"{number:.17g}" if isinstance(number, float) else str(number)
    return value, f"{zeros[0] if zeros else ''}{value.lstrip('-')}"


def _print_cell(text: str) -> str:
    return "".join(sign for sign in text.casefold() if category(sign) != "Cf")


def alike(name: str) -> str:
    """Return what names share that differ only by what programs change: `007`, `7`, `7.0` and `'7`; `Red`, `red`.

    A program that takes names for numbers drops zeros in front, or adds `.0`.
    """
    text = _print_cell(name_of(name))
    match = _WHOLE.fullmatch(with_minus(text))
    return f"{match[1]}{match[2]}" if match else text


def similar_name(name: str, names: Iterable[str]) -> str | None:
    """Return the first of some names that differs from a name only by what programs change; None without one."""
    text = alike(name)
    return next((other for other in names if other != name and alike(other) == text), None)


def group_names(cells: Sequence[Any], where: Callable[[int], str], error: Callable[[str], Exception]) -> list[str]:
    """Return cells as names of groups, each as it is written: names are never numbers.

    Texts are compared as `name_of` returns them. Two spellings of one name, and a cell that may mean a missing
    value, raise `error`.
    """
    for row, cell in enumerate(cells):
        if isinstance(cell, str) and (problem := problem_of(cell)):
            raise error(f"{where(row)}: {problem}")
    names = [name_of(name_in(cell)) for cell in cells]
    check_spellings(names, where, error, as_names=True)
    return names


# -- columns --------------------------------------------------------------------------------------------------

Cell = str | int | float | bool | None
Where = Callable[[int], str]

# Spellings of truth values, and of answers in a column that has yes or no. 1 and 0 are numbers in either.
_BOOLEANS = {"true": True, "t": True, "false": False, "f": False}
_ANSWERS = {"yes": "yes", "y": "yes", "true": "yes", "t": "yes", "no": "no", "n": "no", "false": "no", "f": "no"}
_FOREIGN = {"ja", "j", "nein", "oui", "non", "si", "sí", "1", "0"}
"""Words that may mean yes or no beside one of them, and are not read as either."""
_COMMA = re.compile(r"[+-]?([0-9]+,[0-9]+|,[0-9]+)([eE][+-]?[0-9]+)?")
"""A number with a decimal comma."""
_THOUSAND = re.compile(r"[+-]?[1-9][0-9]{0,2}[,.][0-9]{3}")
"""A number whose only sign may be a decimal one or a separator of thousands."""
_PERCENT = re.compile(r"(.*\S)\s*%")
_UNITS = (
    "%|‰|°|º|°?[CFK]|nm|µm|μm|um|mm|cm|dm|m|km|in|inch|inches|ft|feet|ns|µs|μs|us|ms|s|sec|secs|seconds?|min|mins|"
    "minutes?|h|hours?|mg|g|kg|lb|lbs|N|mN|kN|Nm|N·m|Pa|kPa|V|mV|A|mA|W|Hz|kHz|deg|degrees?|rad|rad/s|m/s|m/s²|"
    "cm/s|mm/s|px|pixels?|met(?:er|re)s?|centimet(?:er|re)s?|millimet(?:er|re)s?|[$€£¥]"
)
_DIGITS = r"\d+(?:[ '’_.,]\d{3})*(?:[.,．，٫]\d*)?|[.,]\d+"
_QUANTITY = re.compile(
    rf"[=~≈<>≤≥±(]*\s*[$€£¥]?\s*[+\-‐‑−–—－±]?\s*[$€£¥]?\s*(?:{_DIGITS})(?:[eE][+-]?\d+|\s*[x×·*]\s*10\^?\S+)?"
    rf"\s*(?:{_UNITS})?\)?"
)
"""A number with signs, separators or a unit around it, such as `≈ 1 200 mm` or `±0,5 €`."""
_FRACTION = re.compile(r"[+-]?\d+\s*[/⁄]\s*\d+|\d*[½¼¾⅓⅔⅛]|\d+:\d\d(?::\d\d)?(?:[.,]\d+)?")
"""A fraction, or a time such as `1:30`."""
_DECIMAL_AND_WORD = re.compile(r"[+-]?(?:\d+[.,]\d+|[.,]\d+)\s*[^\W\d].*")
"""A decimal number and any word, which is a unit: names count in whole numbers, such as `2 cups`."""
_NUMBER_AND_WORD = re.compile(r"[+-]?\d+\s*([^\W\d_].*)")
"""A whole number and a word, which is a unit where all cells have the same one and other numbers."""


def values_of(
    cells: Sequence[Cell], where: Where, semicolons: bool = False, as_names: bool = False, otherwise: str = ""
) -> list[Cell]:
    """Return the values of a column whose texts spell numbers, true and false, classes, or nothing.

    Numbers may have a decimal comma or a percent sign if the whole column has it. A column with yes or no has the
    classes `yes` and `no`.

    Args:
        cells: Texts as `cell_of` returns them, or typed values of a data frame.
        where: The place of a row by its index, for messages.
        semicolons: Whether they separate the cells: where a comma is the decimal sign, `1.000` may be a thousand.
        as_names: Whether texts such as `10 cm` are names of classes. Then `01`, `1e5` and numbers beside texts
            stay texts as well.
        otherwise: How the caller declares texts `as_names`, at the end of a message.

    Raises:
        UsageError: For a text that looks like a quantity and is not a plain number, unless texts are `as_names`.
            Also for a cell that may mean a missing value, and for two spellings of one class.
    """
    texts: list[Cell] = [name_of(cell) if isinstance(cell, str) else cell for cell in cells]
    for row, cell in enumerate(texts):
        if isinstance(cell, str) and (problem := problem_of(cell)):
            raise UsageError(f"{where(row)}: {problem}")
    answers = _answers(texts, where)
    if answers is not None:
        return answers
    numbers = _numbers(texts, where, semicolons, as_names)
    if not as_names:
        _check_quantities(numbers, where, otherwise)
    are_names = as_names and any(isinstance(cell, str) and number_of(cell) is not None for cell in numbers)
    check_spellings(texts, where, UsageError, as_names=are_names)
    return numbers


def _answers(cells: Sequence[Cell], where: Where) -> list[Cell] | None:
    """Return truth values, or the texts `yes` and `no`; None for a column of anything else."""
    words = {cell.lower() for cell in cells if isinstance(cell, str)}
    words |= {str(cell).lower() for cell in cells if isinstance(cell, bool)}
    has_numbers = any(isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells)
    # In a column with other words too, `y` or `true` may be a class beside yes.
    strange = _FOREIGN if words <= set(_ANSWERS) | _FOREIGN else _FOREIGN | set(_ANSWERS) - {"yes", "no"}
    if words & {"yes", "no"} and (foreign := words & strange):
        row = next(row for row, cell in enumerate(cells) if isinstance(cell, str) and cell.lower() in foreign)
        raise UsageError(
            f"{where(row)} is {cells[row]!r} in a column of yes and no; expected yes or no. Write one"
        )
    if has_numbers or not words:
        return None
    if words <= set(_BOOLEANS) and words & {"true", "false"}:
        return [_word(cell, _BOOLEANS) for cell in cells]
    if words <= set(_ANSWERS) and words & {"yes", "no"}:
        return [_word(cell, _ANSWERS) for cell in cells]
    return None


def _word[Value: (bool, str)](cell: Cell, words: dict[str, Value]) -> Value | None:
    return None if cell is None else words[str(cell).lower()]


def _numbers(cells: Sequence[Cell], where: Where, semicolons: bool, as_names: bool) -> list[Cell]:
    """Return the cells with numbers in place of the texts that spell them."""
    texts = {row: with_minus(cell) for row, cell in enumerate(cells) if isinstance(cell, str)}
    if as_names and not all(_PLAIN.fullmatch(text) for text in texts.values()):
        return [cell if cell is None or isinstance(cell, bool) else name_in(cell) for cell in cells]
    numbers = [number_or_cell(cell) for cell in cells]
    if as_names:
        return numbers
    percents = {row: match[1] for row, text in texts.items() if (match := _PERCENT.fullmatch(text))}
    percents = {
        row: text for row, text in percents.items() if _COMMA.fullmatch(text) or number_of(text) is not None
    }
    _check_all_percent(cells, percents, where)
    texts |= percents
    commas = dict.fromkeys(row for row, text in texts.items() if _COMMA.fullmatch(text))
    points = [row for row, text in texts.items() if "." in text and number_of(text) is not None]
    first = next(iter(commas), 0)
    if commas and points:
        raise UsageError(
            f"{where(first)} is {cells[first]!r} and {where(points[0])} is {cells[points[0]]!r}; expected "
            "one decimal sign. Write all numbers with a decimal point and without separators of thousands"
        )
    for rows in (list(commas), points if semicolons else []):
        if rows and all(_THOUSAND.fullmatch(texts[row]) for row in rows):
            digits = texts[rows[0]].replace(",", ".")
            raise UsageError(
                f"{where(rows[0])}: {cells[rows[0]]!r} may be {digits} or {digits.replace('.', '')}. Write "
                "numbers with a decimal point and without separators of thousands, in a table with commas"
            )
    for row in commas:
        numbers[row] = number_of(texts[row].replace(",", "."))
    for row, text in percents.items():
        number = numbers[row] if row in commas else number_of(text)
        assert isinstance(number, int | float)
        numbers[row] = number / 100
    return numbers


def number_or_cell(cell: Cell) -> Cell:
    """Return the number that a text spells, and any other cell as it is."""
    number = number_of(cell) if isinstance(cell, str) else None
    return cell if number is None else number


def _check_all_percent(cells: Sequence[Cell], percents: dict[int, str], where: Where) -> None:
    """Raise UsageError for a column in which some numbers have a percent sign and other cells have none."""
    if not percents:
        return
    for row, cell in enumerate(cells):
        if cell is not None and row not in percents:
            first = next(iter(percents))
            raise UsageError(
                f"{where(row)} is {cell!r} and {where(first)} is {cells[first]!r}; expected a percent sign in "
                "every cell or in none. Write all numbers in one unit"
            )


def _check_quantities(cells: Sequence[Cell], where: Where, otherwise: str) -> None:
    """Raise UsageError for a text that looks like a quantity, because it would be decoded as a class."""
    texts = {row: cell for row, cell in enumerate(cells) if isinstance(cell, str)}
    counted = {row: match[1] for row, text in texts.items() if (match := _NUMBER_AND_WORD.fullmatch(text))}
    units = {word.casefold().rstrip("s") for word in counted.values()}
    alike = len(counted) == len(texts) and len(units) == 1 and len(set(texts.values())) > 1
    for row, text in texts.items():
        matches = (pattern.fullmatch(text) for pattern in (_QUANTITY, _FRACTION, _DECIMAL_AND_WORD))
        if alike or any(matches):
            raise UsageError(
                f"{where(row)}: {text!r} looks like a quantity, and is not a plain number. Write the number "
                f"alone, such as -0.5 or 1200, and its unit in the heading{otherwise}"
            )
