"""Columns of labels that people wrote or a program made, as values of one type, with the place of every cell."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isinf
from typing import Literal, Self

from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.table_cells import Cell, group_names, name_in, number_or_cell, values_of
from probe_kit._system.text_tables import TextTable
from probe_kit.errors import UsageError

Kind = Literal["text", "boolean", "integer", "number"]

EXACT = 2**53
"""The largest integer up to which every integer has an exact float64."""
_ARTICLE = {"text": "text", "boolean": "true or false", "integer": "a number", "number": "a number"}


@dataclass(frozen=True)
class LabelTable:
    """Some columns of a table of labels, as cells of Python types.

    Attributes:
        source: The path of the file, or `DataFrame`.
        unit: `line` of a file, or `row` where there are no lines.
        names: The headings of all columns of the table.
        columns: The cells of the columns that were asked for: texts of a CSV file, texts and typed values of a
            data frame, None where missing.
        lines: The number of every row in its file.
        semicolons: Whether semicolons separate the cells.
    """

    source: str
    unit: str
    names: tuple[str, ...]
    columns: dict[str, list[Cell]]
    lines: list[int]
    semicolons: bool = False

    @classmethod
    def of_lines(
        cls, file: TextTable, lines: Iterable[tuple[int, Mapping[str, str | None]]], columns: Sequence[str]
    ) -> Self:
        """Return some columns of a file, from number and cells of each line as `TextTable.rows` yields them."""
        table = cls(str(file.path), "line", file.names, {name: [] for name in columns}, [], file.separator == ";")
        for number, cells in lines:
            table.lines.append(number)
            for name in columns:
                table.columns[name].append(cells[name])
        return table

    def where(self, row: int, column: str | None = None) -> str:
        """Return the place of a cell, as errors name it."""
        line = f"{self.source}, {self.unit} {self.lines[row]}"
        return line if column is None else f"{line}, column {terminal_safe(column)!r}"

    def at(self, rows: Sequence[int]) -> "LabelTable":
        """Return the table of some rows, by their indices."""
        columns = {name: [cells[row] for row in rows] for name, cells in self.columns.items()}
        return replace(self, columns=columns, lines=[self.lines[row] for row in rows])

    def values(self, column: str, as_names: bool = False, otherwise: str = "") -> list[Cell]:
        """Return the cells of one column as `values_of` reads them, of one kind. Raises UsageError for others."""
        cells = self.columns[column]
        for row, cell in enumerate(cells):
            if isinstance(cell, str):
                self._kind(row, column, cell)
        values = values_of(cells, lambda row: self.where(row, column), self.semicolons, as_names, otherwise)
        return self._of_one_kind(column, values, otherwise)

    def typed(self, column: str) -> list[Cell]:
        """Return the cells of one column as they are, of one kind. Raises UsageError for others."""
        return self._of_one_kind(column, self.columns[column])

    def _of_one_kind(self, column: str, cells: list[Cell], otherwise: str = "") -> list[Cell]:
        first: tuple[Kind, int] | None = None
        for row, cell in enumerate(cells):
            if cell is None:
                continue
            kind = self._kind(row, column, cell, otherwise)
            if first is None:
                first = kind, row
            elif _ARTICLE[kind] != _ARTICLE[first[0]]:
                raise UsageError(
                    f"{self.where(row, column)}: {cell!r} is {_ARTICLE[kind]}, and {self.unit} "
                    f"{self.lines[first[1]]} has {_ARTICLE[first[0]]}; expected one type. Correct one of the two, "
                    f"or leave the cell empty{otherwise if 'text' in (kind, first[0]) else ''}"
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
        """Return the cells of one column as names, each as it is written; `name_in` says how.

        Raises:
            UsageError: For a missing name, and for a number that may be a name which a program has read as one.
        """
        cells = self.columns[column]
        for row, cell in enumerate(cells):
            if cell is None:
                raise UsageError(f"{self.where(row, column)} is empty; expected a name in every {self.unit}")
            if isinstance(cell, float) and not abs(cell) <= EXACT:
                raise UsageError(
                    f"{self.where(row, column)} is {cell:g}, a number in place of a name, of which digits "
                    f"are lost. Read names as text, in pandas with dtype={{{column!r}: str}}"
                )
            if isinstance(cell, str):
                self._kind(row, column, cell)
        return [name_in(cell) for cell in cells]

    def group_names(self, column: str) -> list[str]:
        """Return the cells of one column as names of groups. Raises UsageError if one is missing."""
        return group_names(self.texts(column), lambda row: self.where(row, column), UsageError)

    def numbers(self, column: str) -> list[Cell]:
        """Return the cells of one column, with numbers in place of the texts that spell them."""
        return [number_or_cell(cell) for cell in self.columns[column]]

    def _kind(self, row: int, column: str, cell: Cell, otherwise: str = "") -> Kind:
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
                raise UsageError(
                    f"{self.where(row, column)} is infinite; expected a finite number or no entry{otherwise}"
                )
            return "number"
        if unsafe := UNSAFE.search(str(cell)):
            raise UsageError(
                f"{self.where(row, column)} holds the control or direction character U+{ord(unsafe[0]):04X}; "
                "expected plain text. Remove it"
            )
        return "text"


def _short(number: int) -> str:
    digits = str(number)
    return digits if len(digits) <= 40 else f"{digits[:12]}… of {len(digits)} digits or more"
