"""CSV and Markdown in which a spreadsheet computes no cell, and a cell ends no row."""

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


_FORMULA = re.compile(r"'*(?:[\t\r\n]|\s*[=+\-@＝＋－＠])")
"""How a cell begins that spreadsheets compute or cut, or one that `escaped` made."""


def escaped(cell: Any) -> Any:
    """A text that a spreadsheet would compute with a `'` in front, which marks it as text; all else as it is.

    Numbers stay numbers: only `str` is looked at. `unescaped` gives every text back.
    """
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell


def unescaped(cell: str) -> str:
    """The text that `escaped` was given."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def csv_of_frame(frame: "pd.DataFrame") -> str:
    """A frame as comma-separated values with a header, without its index; texts are `escaped`."""
    import pandas as pd

    safe = frame.rename(columns=escaped)
    for position, (_, column) in enumerate(frame.items()):
        if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_datetime64_any_dtype(column)):
            cells = pd.Series([escaped(cell) for cell in column], index=column.index, dtype=object)
            safe.isetitem(position, cells.array)  # by position: two columns may have one name
    lines = _Lines()
    safe.to_csv(lines, index=False, lineterminator=_Lines.END)
    return lines.getvalue()


def csv_of_rows(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as comma-separated values with a header; texts are `escaped`."""
    lines = _Lines()
    table = csv.DictWriter(lines, columns, lineterminator=_Lines.END)
    table.writerow({name: escaped(name) for name in columns})
    table.writerows({name: escaped(cell) for name, cell in row.items()} for row in rows)
    return lines.getvalue()


class _Lines(io.StringIO):
    """Ends lines in a newline whose writer ends them in `END`: only what ends its lines is quoted by Python's."""

    END = "\r\n"

    def __init__(self) -> None:
        super().__init__(newline="")

    def write(self, line: str) -> int:
        return super().write(line.removesuffix(self.END) + "\n")


_MARKUP = re.compile(
    r"""
    [\\*|$]                        # escapes, emphasis, cells, mathematics
    | (?<![^\W_])_ | _(?![^\W_])   # emphasis; not inside a word, where it means nothing
    | ~(?=~) | (?<=~)~             # struck out
    | <(?=[A-Za-z/!?])             # HTML and links in angle brackets
    | &(?=\#?\w+;)                 # entities
    | \](?=[(\[:])                 # links, pictures and their definitions
    | ^\s*(?:\#|>|[-+](?=[-\s]|$)|=+\s*$|```|~~~)   # headings, quotations, lists, rules, code
    | ^\s*\d{1,9}[.)](?=\s|$)      # numbered lists
    | (?<=:)/(?=/)                 # addresses, which become links by themselves
    | (?<=www)\.
    | (?<=\w)@(?=[\w.-]*\.[a-z])
    """,
    re.VERBOSE | re.IGNORECASE,
)


def markdown_safe(text: str) -> str:
    """Return one line of Markdown that shows `text`; line ends become spaces."""
    return _MARKUP.sub(_escaped, re.sub(r"\s*[\r\n\u2028\u2029]+\s*", " ", text))


def _escaped(match: re.Match[str]) -> str:
    sign = match[0].lstrip()
    if sign[0].isdigit():
        return f"{match[0][:-1]}\\{sign[-1]}"
    return match[0][: len(match[0]) - len(sign)] + f"\\{sign}"
