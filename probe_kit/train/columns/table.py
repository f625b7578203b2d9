"""Tables of labels: CSV, Parquet or a DataFrame, with the line of every cell."""

from collections.abc import Sequence
from datetime import date, time
from decimal import Decimal
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import UUID

import numpy as np

from probe_kit._system.bounded_files import check_regular
from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.imports import require
from probe_kit._system.parquet_files import open_parquet, read_parquet
from probe_kit._system.table_cells import Cell
from probe_kit._system.text_tables import MOST_BYTES, cell_of, open_table
from probe_kit._tables.label_table import LabelTable
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    import pandas as pd

EPISODE, INFERENCE = "episode_id", "inference"
"""Key columns of a table: one label per episode, or with both one per captured inference."""
SOURCE, FRAME = "source_episode", "frame"
"""The same of recordings, by the numbers of the data set; read where a table has no `episode_id`."""


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
    return LabelTable.of_lines(opened, opened.rows(read), read)


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
