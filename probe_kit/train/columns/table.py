"""Tables of labels: CSV, Parquet or a DataFrame, with the line of every cell."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, time
from decimal import Decimal
from math import isinf, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import UUID

import numpy as np

from probe_kit._system.bounded_files import check_regular
from probe_kit._system.optional_dependencies import require
from probe_kit._system.parquet_files import open_parquet, read_parquet
from probe_kit._system.table_cells import group_names, number_of
from probe_kit._system.text_tables import MOST_BYTES, cell_of, open_table
from probe_kit._terminal.plain_text import UNSAFE, terminal_safe
from probe_kit.errors import UsageError
from probe_kit.train.choices import Task
from probe_kit.train.columns.cells import Cell, values_of

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["text", "boolean", "integer", "number"]

EPISODE, INFERENCE = "episode_id", "inference"
"""Key columns of a table: one label per episode, or with both one per captured inference."""
SOURCE, FRAME = "source_episode", "frame"
"""The same of recordings, by the numbers of the data set; read where a table has no `episode_id`."""
EXACT = 2**53
"""Integers beyond it have no exact float64."""
_ARTICLE = {"text": "text", "boolean": "true or false", "integer": "a number", "number": "a number"}


@dataclass(frozen=True)
class LabelTable:
    """Some columns of a table of labels, as cells of Python types.

    source: the file, or `DataFrame`. unit: `line` of a file, or `row` where there are no lines. names: all columns
    of the table. columns: cells of those that were asked for: texts of a CSV file, texts and typed values of a
    data frame, None where missing. lines: number of every row in its file. semicolons: whether they separate
    the cells.
    """

    source: str
    unit: str
    names: tuple[str, ...]
    columns: dict[str, list[Cell]]
    lines: list[int]
    semicolons: bool = False

    def where(self, row: int, column: str | None = None) -> str:
        """The place of a cell, as errors name it."""
        line = f"{self.source}, {self.unit} {self.lines[row]}"
        return line if column is None else f"{line}, column {terminal_safe(column)!r}"

    def at(self, rows: Sequence[int]) -> "LabelTable":
        """The table of some rows."""
        columns = {name: [cells[row] for row in rows] for name, cells in self.columns.items()}
        return replace(self, columns=columns, lines=[self.lines[row] for row in rows])

    def values(self, column: str, task: Task | None) -> list[Cell]:
        """The cells of one column as `values_of` reads them, of one kind. Raises UsageError."""
        cells = self.columns[column]
        for row, cell in enumerate(cells):
            if isinstance(cell, str):
                self._kind(row, column, cell)
        values = values_of(cells, lambda row: self.where(row, column), task, self.semicolons)
        return self._of_one_kind(column, values)

    def typed(self, column: str) -> list[Cell]:
        """The cells of one column as they are, of one kind. Raises UsageError for others."""
        return self._of_one_kind(column, self.columns[column])

    def _of_one_kind(self, column: str, cells: list[Cell]) -> list[Cell]:
        first: tuple[Kind, int] | None = None
        for row, cell in enumerate(cells):
            if cell is None:
                continue
            kind = self._kind(row, column, cell)
            if first is None:
                first = kind, row
            elif _ARTICLE[kind] != _ARTICLE[first[0]]:
                raise UsageError(
                    f"{self.where(row, column)}: {cell!r} is {_ARTICLE[kind]}, and {self.unit} "
                    f"{self.lines[first[1]]} has {_ARTICLE[first[0]]}; expected one type. Correct one of the two, "
                    "or leave the cell empty"
                )
        self._check_exact(column, cells)
        return cells

    def _check_exact(self, column: str, cells: Sequence[Cell]) -> None:
        """Raise UsageError for decimals that are all whole, one beyond 2^53: they may be rounded integers.

        A table with empty cells stores integers as decimals.
        """
        numbers = {row: cell for row, cell in enumerate(cells) if isinstance(cell, float)}
        beyond = [row for row, cell in numbers.items() if abs(cell) > EXACT]
        if beyond and all(cell.is_integer() for cell in numbers.values()):
            raise UsageError(
                f"{self.where(beyond[0], column)}: the whole number {numbers[beyond[0]]:g} is beyond 2^53, so it "
                "may be a rounded integer. Put a letter in front if it is a name, or give a larger unit"
            )

    def texts(self, column: str) -> list[str]:
        """The cells of one column as they are written, none of them missing. Raises UsageError."""
        cells = self.columns[column]
        for row, cell in enumerate(cells):
            if cell is None:
                raise UsageError(f"{self.where(row, column)} is empty; expected a name in every {self.unit}")
            self._kind(row, column, cell)
        return [str(cell) for cell in cells]

    def group_names(self, column: str) -> list[str]:
        """The cells of one column as names of groups, none of them missing. Raises UsageError."""
        self.texts(column)
        return group_names(self.columns[column], lambda row: self.where(row, column), UsageError)

    def numbers(self, column: str) -> list[Cell]:
        """The cells of one column, with numbers in place of the texts that spell them."""
        spelled = ((cell, number_of(cell) if isinstance(cell, str) else None) for cell in self.columns[column])
        return [cell if number is None else number for cell, number in spelled]

    def _kind(self, row: int, column: str, cell: Cell) -> Kind:
        if isinstance(cell, bool):
            return "boolean"
        if isinstance(cell, int):
            if abs(cell) > EXACT:
                raise UsageError(
                    f"{self.where(row, column)}: the integer {_short(cell)} is beyond 2^53, so it has no exact "
                    "float64. Put a letter in front if it is a name, or subtract an offset"
                )
            return "integer"
        if isinstance(cell, float):
            if isinf(cell):
                raise UsageError(f"{self.where(row, column)} is infinite; expected a finite number or no entry")
            return "number"
        if unsafe := UNSAFE.search(str(cell)):
            raise UsageError(
                f"{self.where(row, column)} holds the control or direction character U+{ord(unsafe[0]):04X}; "
                "expected plain text. Remove it"
            )
        return "text"


def read_table(table: "Path | str | pd.DataFrame", requested: Sequence[str]) -> LabelTable:
    """The key columns and the columns `requested` of a table. requested: those that it lacks are left out.

    table: a CSV file (see `open_table`), a Parquet file (`.parquet`), or a DataFrame. Raises UsageError for a file
    that is no such table, or has no column `episode_id`; MissingExtraError for Parquet without pyarrow.
    """
    if not isinstance(table, str | Path):
        return _of_frame(table, "DataFrame", requested)
    path = Path(table)
    if path.suffix.lower() in (".parquet", ".pq"):
        _check_file(path)
        return _of_parquet(path, requested)
    return _of_csv(path, requested)


def _check_file(path: Path) -> None:
    try:
        check_regular(path, MOST_BYTES)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}. Give a CSV or Parquet file") from error


def _of_csv(path: Path, requested: Sequence[str]) -> LabelTable:
    opened = open_table(path, (EPISODE, SOURCE))
    read = list(_places(opened.names, requested, str(path), opened.line))
    columns: dict[str, list[Cell]] = {name: [] for name in read}
    lines = []
    for line, cells in opened.rows(read):
        lines.append(line)
        for name, cell in cells.items():
            columns[name].append(cell)
    return LabelTable(str(path), "line", opened.names, columns, lines, opened.separator == ";")


def _places(names: Sequence[str], requested: Sequence[str], source: str, line: int = 1) -> dict[str, int]:
    """Position of every column to read. Raises UsageError without the key, and for a name used twice."""
    if EPISODE not in names and SOURCE not in names:
        listed = ", ".join(terminal_safe(name) for name in names[:12]) or "no column"
        raise UsageError(
            f"{source}, line {line} lacks the key column {EPISODE!r}; it has {listed}. "
            f"{_other_delimiter(names)}`probe-kit labels RUN` writes a table with the keys of a run"
        )
    keys = (EPISODE, INFERENCE) if EPISODE in names else (SOURCE, FRAME)
    read = [name for name in dict.fromkeys((*keys, *requested)) if name in names]
    if unsafe := [character for name in read if (character := UNSAFE.search(name))]:
        raise UsageError(
            f"{source}, line {line}: the name of a column holds the control or direction character "
            f"U+{ord(unsafe[0][0]):04X}; expected plain text. Rename the column"
        )
    if twice := [name for name in read if names.count(name) > 1]:
        raise UsageError(
            f"{source}, line {line} has the column {terminal_safe(twice[0])!r} twice. Rename one of them"
        )
    return {name: names.index(name) for name in read}


def _other_delimiter(names: Sequence[str]) -> str:
    """Return advice for a heading that holds the key and another delimiter than a comma; empty for others."""
    for delimiter, name in (("|", "bars"), (":", "colons")):
        fields = {field.strip().strip('"') for heading in names for field in heading.split(delimiter)}
        if len(fields) > len(names) and fields & {EPISODE, SOURCE}:
            return f"Its fields are separated by {name}; save it with commas, semicolons or tabs. "
    return ""


def _short(number: int) -> str:
    digits = str(number)
    return digits if len(digits) <= 40 else f"{digits[:12]}… of {len(digits)} digits or more"


def _of_parquet(path: Path, requested: Sequence[str]) -> LabelTable:
    """Cells by arrow, because pandas rounds large integers beside empty cells."""
    require("pyarrow.parquet", "export")
    try:
        with open_parquet(path, "export") as file:
            names = file.schema_arrow.names
            position_of = _places(names, requested, str(path))
            read = read_parquet(file, list(position_of))
    except UsageError:
        raise
    except OSError as error:
        reason = str(error.strerror or error).rstrip(".")
        raise UsageError(f"{path} cannot be read: {reason}. Give a CSV or Parquet file") from error
    except Exception as error:  # pyarrow raises many kinds for files that are no Parquet
        reason = str(error).rstrip(".")
        raise UsageError(f"{path} is no Parquet file: {reason}. Write it again, or give a CSV file") from error
    cells = {name: read.column(name).to_pylist() for name in position_of}
    return _of_cells(cells, tuple(names), len(read), str(path))


def _of_frame(frame: "pd.DataFrame", source: str, requested: Sequence[str]) -> LabelTable:
    if any(name is not None for name in frame.index.names):
        frame = frame.reset_index()
    names = [str(name) for name in frame.columns]
    position_of = _places(names, requested, source)
    cells = {name: frame.iloc[:, number].tolist() for name, number in position_of.items()}
    return _of_cells(cells, tuple(names), len(frame), source)


def _of_cells(cells: dict[str, list[Any]], names: tuple[str, ...], count: int, source: str) -> LabelTable:
    table = LabelTable(source, "row", names, {}, list(range(1, count + 1)))
    for name, column in cells.items():
        table.columns[name] = [_plain(cell, table, row, name) for row, cell in enumerate(column)]
    return table


def _plain(cell: Any, table: LabelTable, row: int, column: str) -> Cell:
    """A cell of a frame or Parquet file as a Python type; whatever means "missing" is None. Dates are texts.

    Raises UsageError for other objects, such as lists.
    """
    import pandas as pd

    if isinstance(cell, np.generic):
        cell = cell.item()
    if cell is None or cell is pd.NA or cell is pd.NaT:
        return None
    if isinstance(cell, Decimal):
        cell = float(cell)
    if isinstance(cell, float):
        return None if isnan(cell) else cell
    if isinstance(cell, bool | int):
        return cell
    if isinstance(cell, str):
        return cell_of(cell)
    if isinstance(cell, date | time | UUID):
        return str(cell)
    raise UsageError(
        f"{table.where(row, column)} is of type {type(cell).__name__}; expected text, a number, or true or false. "
        "Write one such value per row, a duration as a number of seconds"
    )
