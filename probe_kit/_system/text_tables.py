"""The one reader of tables of text (CSV, TSV): encoding, separator, heading, rows and cells."""

import csv
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from probe_kit._system.bounded_files import open_regular
from probe_kit._system.escaping import unescape
from probe_kit._system.table_cells import is_missing, plain_cell
from probe_kit.errors import ProbeKitError, UsageError

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
MOST_CHARACTERS = 131_072
"""The most characters of a cell; a picture in a cell needs more."""
MOST_BYTES = 1 << 30
"""The most bytes of a file, whose rows are read one by one."""
_ANY_LENGTH = (1 << 31) - 1
"""The length of a cell of a heading while separators are tried: with a wrong one the whole line is one cell."""
_DECLARED = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_BYTE_ORDER = (
    (b"\xff\xfe\0\0", "UTF-32"),
    (b"\0\0\xfe\xff", "UTF-32"),
    (b"\xff\xfe", "UTF-16"),
    (b"\xfe\xff", "UTF-16"),
)
_NO_TEXT = (
    (b"PK\x03\x04", "a spreadsheet or an archive (XLSX, ODS, ZIP)"),
    (b"\xd0\xcf\x11\xe0", "a spreadsheet (XLS)"),
    (b"PAR1", "a Parquet file without the ending .parquet"),
    (b"\x1f\x8b", "compressed (gzip)"),
)
"""The beginnings of files that people give as tables of text and that are none."""
_REMEDY = "Give a CSV file in UTF-8, as spreadsheets save it under the name CSV UTF-8"
_QUOTE = 'Put a text with the separator between "quotes"'


class _BrokenHeadingError(ProbeKitError):
    """A heading that is no CSV with the separator that was tried."""


@dataclass(frozen=True)
class TextTable:
    """A file whose heading was read.

    Attributes:
        names: The headings; an empty text for a column without one.
        line: The line of the heading, counted from 1.
        encoding: Python's name of the encoding.
        error: The class of the error for rows that cannot be used.
        most_characters: The most characters of a cell.
    """

    path: Path
    names: tuple[str, ...]
    line: int
    separator: str
    encoding: str
    error: type[ProbeKitError]
    most_characters: int

    def where(self, line: int, column: str | None = None) -> str:
        """Return the place of a cell, as errors name it."""
        return f"{self.path}, line {line}" + ("" if column is None else f", column {column!r}")

    def rows(self, columns: Sequence[str] | None = None) -> Iterator[tuple[int, dict[str, str | None]]]:
        """Yield the line and the cells by heading of every row, None for a missing cell.

        Rows without any text are left out. `columns` are those to read, by default all with a heading.

        Raises:
            ProbeKitError: For a column that occurs twice, and for a row with more or fewer cells than the heading.
                By default also for a cell without a heading. Its class is the table's `error`.
        """
        read = [name for name in self.names if name] if columns is None else columns
        unnamed = [at for at, name in enumerate(self.names) if not name] if columns is None else []
        if twice := [name for name in read if self.names.count(name) > 1]:
            raise self.error(
                f"{self.path}, line {self.line} has the column {twice[0]!r} twice. Rename one of them"
            )
        positions = {name: self.names.index(name) for name in read}
        width = len(self.names)
        with _open_text(self.path, self.encoding, self.error) as file:
            for line, record in _records(file, self.separator, self.path, self.error, self.most_characters):
                if line <= self.line or not any(map(str.strip, record)):
                    continue
                if len(record) != width:
                    raise self.error(
                        f"{self.path}, line {line} has {len(record)} fields, the heading has {width}. {_QUOTE}; a "
                        "row may also be cut off"
                    )
                if extra := next((record[at] for at in unnamed if record[at].strip()), None):
                    raise self.error(
                        f"{self.path}, line {line} has {extra!r} in a column without a heading. "
                        "Give the column a heading, or remove it"
                    )
                yield line, {name: cell_of(record[position]) for name, position in positions.items()}


def cell_of(text: str) -> str | None:
    """Return a field as the text of its cell; None where it means "no value"."""
    cell = plain_cell(unescape(text))
    return None if is_missing(cell) else cell


def open_table(
    path: Path,
    keys: Collection[str],
    error: type[ProbeKitError] = UsageError,
    most_characters: int = MOST_CHARACTERS,
) -> TextTable:
    """Read the heading of a CSV or TSV file in UTF-8 or UTF-16.

    The separator is a comma, a semicolon or a tab, or the one that a first line `sep=;` declares.

    Args:
        path: The file.
        keys: Headings of such a table; they decide where a heading has more than one separator.
        error: The class of all errors, also of those for rows that are read later.
        most_characters: The most characters of a cell.

    Raises:
        ProbeKitError: For a file that cannot be read, is in another encoding, or has a heading that several
            separators explain. Its class is `error`.
    """
    encoding = _encoding(path, error)
    with _open_text(path, encoding, error) as file:
        declared = _DECLARED.fullmatch(file.readline(64).rstrip("\r\n"))
    if declared and declared[1] not in SEPARATORS:
        raise error(f"{path}, line 1 declares the separator {declared[1]!r}; expected one of , ; and tab")
    headings: dict[str, tuple[int, tuple[str, ...]]] = {}
    for separator in SEPARATORS if declared is None else [declared[1]]:
        with suppress(_BrokenHeadingError), _open_text(path, encoding, error) as file:
            records = _records(file, separator, path, _BrokenHeadingError, most_characters=_ANY_LENGTH)
            if declared:
                next(records, None)
            line, record = next(records, (1 + bool(declared), []))
            headings[separator] = line, tuple(plain_cell(unescape(name)) for name in record)
    if not headings:
        raise error(f"{path}, line {1 + bool(declared)} is no CSV: its quotation marks do not close a cell")
    separator = _separator(headings, keys, path, error)
    line, names = headings[separator]
    return TextTable(path, names, line, separator, encoding, error, most_characters)


def read_lines(path: Path, error: type[ProbeKitError] = UsageError, most: int = 10_000) -> list[str]:
    """Return the lines of a text file in UTF-8 or UTF-16, without spaces around them.

    Args:
        path: The file.
        error: The class of all errors.
        most: The most lines.

    Raises:
        ProbeKitError: As `open_table` raises it for a file that is no text, and for more lines, as `error`.
    """
    lines: list[str] = []
    with _open_text(path, _encoding(path, error), error) as file:
        while text := file.readline(MOST_CHARACTERS):
            if len(lines) == most:
                raise error(f"{path} has more than {most:,} lines; expected a short list. Give another file")
            lines.append(text.strip())
    return lines


def _separator(
    headings: dict[str, tuple[int, tuple[str, ...]]], keys: Collection[str], path: Path, error: type[ProbeKitError]
) -> str:
    """Return the only separator of a heading, or of several the one that gives the most keys."""
    several = [separator for separator, (_, names) in headings.items() if len(names) > 1]
    if len(several) < 2:
        return (several or list(headings))[0]
    keyed = {separator: len(set(keys) & set(headings[separator][1])) for separator in several}
    most = max(keyed.values())
    best = [separator for separator in several if keyed[separator] == most]
    if len(best) > 1 and most:
        raise error(
            f"{path}: its heading has {' and '.join(SEPARATORS[name] for name in best)}; expected one separator. "
            "Write sep=; as the first line, with the right one"
        )
    return best[0]


def _encoding(path: Path, error: type[ProbeKitError]) -> str:
    """Return UTF-8, or UTF-16 if a byte order mark says so; raise `error` for a file without end, or too large."""
    try:
        with open_regular(path, MOST_BYTES) as file:
            start = file.read(4)
    except FileNotFoundError:
        where = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise error(f"there is no file {path}{where}; expected a table, as a CSV file in UTF-8") from None
    except OSError as problem:
        raise error(f"{path} cannot be read as a table: {problem.strerror}. {_REMEDY}") from problem
    if other := next((name for beginning, name in _NO_TEXT if start.startswith(beginning)), None):
        raise error(f"{path} is {other}, not a table of text. {_REMEDY}")
    marked = next((name for mark, name in _BYTE_ORDER if start.startswith(mark)), None)
    if marked == "UTF-32" or (marked is None and b"\0" in start):
        raise error(f"{path} is in {marked or 'UTF-16 without a byte order mark'}. {_REMEDY}")
    return "utf-8-sig" if marked is None else "utf-16"


@contextmanager
def _open_text(path: Path, encoding: str, error: type[ProbeKitError]) -> Iterator[TextIO]:
    try:
        with path.open(encoding=encoding, newline="") as file:
            yield file
    except UnicodeError as problem:
        raise error(
            f"{path} cannot be read as a table: {_undecodable(path, encoding, problem)}. {_REMEDY}; or convert "
            f"it: iconv -f WINDOWS-1252 -t UTF-8 {path.name} > utf8.csv"
        ) from problem
    except OSError as problem:
        raise error(f"{path} cannot be read as a table: {problem}. {_REMEDY}") from problem


def _undecodable(path: Path, encoding: str, problem: UnicodeError) -> str:
    """Return the line and the byte that are not in the file's encoding, as words."""
    if encoding == "utf-16":
        return str(problem)
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as broken:
                byte = line[broken.start]
                return f"line {number} holds the byte 0x{byte:02X}, which is not UTF-8 (perhaps Windows-1252)"
    return str(problem)


def _records(
    file: TextIO, separator: str, path: Path, error: type[ProbeKitError], most_characters: int
) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and fields of every record that is not empty."""
    reader = csv.reader(file, delimiter=separator, strict=True)
    before = 0
    while True:
        try:
            with _cells_of(most_characters):
                record: Any = next(reader, None)
        except csv.Error as problem:
            raise error(f"{path}, line {reader.line_num} is no CSV: {problem}. Write the table again") from problem
        if record is None:
            return
        if record:
            yield before + 1, record  # the line in which it begins: a cell in quotes may hold line breaks
        before = reader.line_num


@contextmanager
def _cells_of(most_characters: int) -> Iterator[None]:
    """Set the limit of a cell for the body; the csv module has one limit for all readers of a process."""
    limit = csv.field_size_limit(most_characters)
    try:
        yield
    finally:
        csv.field_size_limit(limit)
