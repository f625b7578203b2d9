"""Foreign text in which a terminal obeys nothing, a spreadsheet computes nothing, and Markdown reads no markup."""

import csv
import io
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


_BIDI = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
UNSAFE = re.compile(f"[\x00-\x08\x0b-\x1f\x7f-\x9f{_BIDI}\u2028\u2029\ufeff\ud800-\udfff]")
"""Control characters but tab and newline, bidirectional marks, foreign line ends, halves of surrogate pairs."""


def as_argument(path: object) -> str:
    """Return a path or an address as it is typed behind a command: in quotes where a shell would split it.

    One that begins with a dash, which would be an option, gets `./` in front.
    """
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def terminal_safe(text: str) -> str:
    """Return `text` without anything that a terminal obeys; such characters become visible signs, such as ␛."""
    return UNSAFE.sub(_sign, text)


def _sign(match: re.Match[str]) -> str:
    code = ord(match[0])
    return chr(0x2400 + code) if code < 0x20 else "\u2421" if code == 0x7F else "\ufffd"


_QUOTED = re.compile(r"""(["'`])((?:file://)?(?:~|[A-Za-z]:)?[/\\][^"'`\n]*[/\\][^"'`\n]*)\1""")
"""A whole path in quotes, as in JSON; it may hold spaces."""
_PART = r"[\w.@+~%=-]+"
_BARE = re.compile(
    r"(?<![\w:/\\.\]})>…-])(?:file://)?"
    rf"(?:(?:~|[A-Za-z]:)?(?:/{_PART}){{2,}}|~/{_PART}|[A-Za-z]:(?:\\{{1,2}}{_PART})+)/?"
)
"""A path of two parts or more in a sentence."""


def without_folders(text: str, paths: tuple[str, ...] = ()) -> str:
    """Return `text` with only the last part of every absolute path, and of `paths`, which may hold spaces."""
    for path in sorted(filter(None, paths), key=len, reverse=True):
        text = text.replace(path, _last(path))
    text = _QUOTED.sub(lambda match: f"{match[1]}{_last(match[2])}{match[1]}", text)
    return _BARE.sub(lambda match: _last(match[0]), text)


def _last(path: str) -> str:
    return re.split(r"[/\\]", path.rstrip("/\\"))[-1]


_FORMULA = re.compile(r"'*(?:[\t\r\n]|\s*[=+\-@＝＋－＠])")
"""The beginning of a cell that spreadsheets compute or cut, or of one that `escape_formula` made."""


def escape_formula(cell: Any) -> Any:
    """Return a text that a spreadsheet would compute with a `'` in front, which marks it as text.

    Every other cell is returned as it is. Numbers stay numbers: only `str` is looked at. `unescape` restores
    every text.
    """
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell


def unescape(cell: str) -> str:
    """Return the text that `escape_formula` was given."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def csv_of_frame(frame: "pd.DataFrame") -> str:
    """Return a frame as comma-separated values with a header, without its index; see `escape_formula`."""
    import pandas as pd

    safe = frame.rename(columns=escape_formula)
    for position, (_, column) in enumerate(frame.items()):
        if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_datetime64_any_dtype(column)):
            cells = pd.Series([escape_formula(cell) for cell in column], index=column.index, dtype=object)
            safe.isetitem(position, cells.array)  # by position: two columns may have one name
    lines = _Lines()
    safe.to_csv(lines, index=False, lineterminator=_Lines.END)
    return lines.getvalue()


def csv_of_rows(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as comma-separated values with a header; see `escape_formula`."""
    lines = _Lines()
    table = csv.DictWriter(lines, columns, lineterminator=_Lines.END)
    table.writerow({name: escape_formula(name) for name in columns})
    table.writerows({name: escape_formula(cell) for name, cell in row.items()} for row in rows)
    return lines.getvalue()


class _Lines(io.StringIO):
    """A text that ends lines in a newline, whose writer ends them in `END`.

    Python's writer quotes a sign of line ends only where it ends its own lines.
    """

    END = "\r\n"

    def __init__(self) -> None:
        super().__init__(newline="")

    def write(self, line: str) -> int:
        return super().write(line.removesuffix(self.END) + "\n")


_MARKUP = re.compile(
    r"""
    [\\*|$~]                       # escapes, emphasis, cells, mathematics, struck out (GitHub: by one ~ as well)
    | (?<![^\W_])_ | _(?![^\W_])   # emphasis; not inside a word, where it means nothing
    | <(?=[A-Za-z/!?])             # HTML and links in angle brackets
    | &(?=\#?\w+;)                 # entities
    | \](?=[(\[:])                 # links, pictures and their definitions
    | ^\s*(?:\#|>|[-+](?=[-\s]|$)|=+\s*$|```)   # headings, quotations, lists, rules, code
    | ^\s*\d{1,9}[.)](?=\s|$)      # numbered lists
    | (?<=:)/(?=/)                 # addresses, which become links by themselves
    | (?<=www)\.
    | (?<=\w)@(?=[\w.-]*\.[a-z])
    """,
    re.VERBOSE | re.IGNORECASE,
)


def markdown_safe(text: str) -> str:
    """Return one line of Markdown that shows `text`; line ends become spaces."""
    return _MARKUP.sub(_escape_text, re.sub(r"\s*[\r\n\u2028\u2029]+\s*", " ", text))


def _escape_text(match: re.Match[str]) -> str:
    sign = match[0].lstrip()
    if sign[0].isdigit():
        return f"{match[0][:-1]}\\{sign[-1]}"
    return match[0][: len(match[0]) - len(sign)] + f"\\{sign}"
