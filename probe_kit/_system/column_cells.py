"""Cells of a column that people wrote as values: numbers, true and false, classes, or missing."""

import re
from collections.abc import Callable, Sequence

from probe_kit._system.table_cells import check_spellings, name_of, number_of, problem_of, with_minus
from probe_kit.errors import UsageError

Cell = str | int | float | bool | None
Where = Callable[[int], str]

# Spellings of truth values, and of answers in a column that has yes or no. 1 and 0 are numbers in either.
_BOOLEANS = {"true": True, "t": True, "false": False, "f": False}
_ANSWERS = {"yes": "yes", "y": "yes", "true": "yes", "t": "yes", "no": "no", "n": "no", "false": "no", "f": "no"}
_FOREIGN = {"ja", "j", "nein", "oui", "non", "si", "sí", "1", "0"}
"""What may mean yes or no beside one of them, and is not read as either."""
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
"""Any word is a unit behind a decimal number: names count in whole ones, such as `2 cups`."""
_NUMBER_AND_WORD = re.compile(r"[+-]?\d+\s*([^\W\d_].*)")
"""A whole number and a word, which is a unit where all cells have the same one and other numbers."""


def values_of(
    cells: Sequence[Cell], where: Where, semicolons: bool = False, as_names: bool = False, otherwise: str = ""
) -> list[Cell]:
    """The values of a column whose texts spell numbers, true and false, classes, or nothing.

    cells: texts as `cell_of` gives them, or typed values of a data frame. where: the place of a row, for messages.
    semicolons: whether they separate the cells: where a comma is the decimal sign, `1.000` may be a thousand.
    as_names: whether texts such as `10 cm` are names of classes. otherwise: how the caller says so, for a message.
    Numbers may have a decimal comma or a percent sign where the whole column has it. A column with yes or no has
    the classes `yes` and `no`. Raises UsageError for a text that looks like a quantity and is not a plain number
    (unless they are `as_names`), for a cell that may mean a missing value, and for two spellings of
    one class.
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
    check_spellings(texts, where, UsageError)
    return numbers


def _answers(cells: Sequence[Cell], where: Where) -> list[Cell] | None:
    """Truth values, or the texts `yes` and `no`; None for a column of anything else."""
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
    """The cells with numbers in place of the texts that spell them."""
    texts = {row: with_minus(cell) for row, cell in enumerate(cells) if isinstance(cell, str)}
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
    """Return the number that a text spells; any other cell as it is."""
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
