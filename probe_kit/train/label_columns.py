"""Tables of labels (CSV, Parquet, DataFrame) with the line of every cell, and values of a column under a task."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, time
from decimal import Decimal
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import check_regular
from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.imports import require
from probe_kit._system.parquet_files import open_parquet, read_parquet
from probe_kit._system.table_cells import Cell
from probe_kit._system.text_tables import MOST_BYTES, cell_of, open_table
from probe_kit._tables.label_table import LabelTable
from probe_kit.errors import LfsPointerError, UsageError
from probe_kit.train.choices import TASKS, Task

if TYPE_CHECKING:
    import pandas as pd


EPISODE, INFERENCE = "episode_id", "inference"
"""Key columns of a table: one label per episode, or with both one per captured inference."""
SOURCE, FRAME = "source_episode", "frame"
"""The key columns of recordings, by the numbers of the data set; read where a table has no `episode_id`."""
SOURCES, FRAMES = (SOURCE, "episode_index"), (FRAME, "frame_index")
"""The names of these two columns: ours, and those of a LeRobotDataset.

Its column `index` is no key: it counts the frames of all episodes, of which a run may show a few, and a data frame
whose index was reset has a column of that name.
"""


def read_table(
    table: "Path | str | pd.DataFrame | pd.Series[Any]", requested: Sequence[str], names: Sequence[str] = ()
) -> LabelTable:
    """Return the key columns and some other columns of a table.

    Args:
        table: A CSV file (see `open_table`), a Parquet file (`.parquet`), a DataFrame, or a Series whose index has
            the keys.
        requested: Names of columns; those that the table lacks are left out.
        names: Names of further columns, whose cells are names.

    Raises:
        UsageError: For a file that is no such table, or has no column `episode_id`, `source_episode` or
            `episode_index`.
        MissingExtraError: For Parquet without pyarrow.
    """
    requested = [*requested, *names]
    if not isinstance(table, str | Path):
        import pandas as pd

        columns: Any = table if isinstance(table, pd.DataFrame) else table.to_frame()
        frame = columns.reset_index() if any(name is not None for name in table.index.names) else columns
        headings = tuple(str(name) for name in frame.columns)
        position_of = _places(headings, requested, "DataFrame")
        cells = {name: frame.iloc[:, number].tolist() for name, number in position_of.items()}
        return _build_table(cells, headings, len(frame), "DataFrame", names)
    path = Path(table)
    if path.suffix.lower() in (".parquet", ".pq"):
        try:
            check_regular(path, MOST_BYTES)
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror}. Give a CSV or Parquet file") from error
        return _read_parquet(path, requested, names)
    opened = open_table(path, (EPISODE, *SOURCES))
    read = list(_places(opened.names, requested, str(path), opened.line))
    return LabelTable.of_lines(opened, opened.rows(read), read)


def _places(names: Sequence[str], requested: Sequence[str], source: str, line: int = 1) -> dict[str, int]:
    """Return the position of every column to read.

    Raises:
        UsageError: For a table without the key, a name used twice, and a control character in a name.
    """
    if EPISODE not in names and not set(SOURCES) & set(names):
        listed = ", ".join(terminal_safe(name) for name in names[:12]) or "no column"
        of_lerobot = "A frame of a data set has the keys 'episode_index' and 'frame_index'. " * bool(
            {"index", *FRAMES} & set(names)
        )
        raise UsageError(
            f"{source}, line {line} lacks the key column {EPISODE!r}; it has {listed}. "
            f"{_other_delimiter(names)}{of_lerobot}`probe-kit labels RUN` writes a table with the keys of a run"
        )
    keys = [EPISODE, INFERENCE] if EPISODE in names else []
    read = [name for name in dict.fromkeys((*keys, *SOURCES, *FRAMES, *requested)) if name in names]
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
        if len(fields) > len(names) and fields & {EPISODE, *SOURCES}:
            return f"Its fields are separated by {name}; save it with commas, semicolons or tabs. "
    return ""


def _read_parquet(path: Path, requested: Sequence[str], names: Sequence[str]) -> LabelTable:
    """Read the cells by arrow, because pandas rounds large integers beside empty cells."""
    require("pyarrow.parquet", "export")
    try:
        with open_parquet(path, "export") as file:
            headings = file.schema_arrow.names
            position_of = _places(headings, requested, str(path))
            read = read_parquet(file, list(position_of))
    except (UsageError, LfsPointerError, MemoryError):
        raise
    except OSError as error:
        reason = str(error.strerror or error).rstrip(".")
        raise UsageError(f"{path} cannot be read: {reason}. Give a CSV or Parquet file") from error
    except Exception as error:  # pyarrow raises many kinds for files that are no Parquet
        reason = str(error).rstrip(".")
        raise UsageError(f"{path} is no Parquet file: {reason}. Write it again, or give a CSV file") from error
    cells = {name: read.column(name).to_pylist() for name in position_of}
    return _build_table(cells, tuple(headings), len(read), str(path), names)


def _build_table(
    cells: dict[str, list[Any]], headings: tuple[str, ...], count: int, source: str, names: Sequence[str]
) -> LabelTable:
    table = LabelTable(source, "row", headings, {}, list(range(1, count + 1)))
    for name, column in cells.items():
        if name in (EPISODE, *names):  # a decimal number keeps its zeros as a text
            column = [str(cell) if isinstance(cell, Decimal) else cell for cell in column]
        table.columns[name] = [_plain(cell, table, row, name) for row, cell in enumerate(column)]
    return table


def _plain(cell: Any, table: LabelTable, row: int, column: str) -> Cell:
    """Return a cell of a frame or Parquet file as a Python type.

    None stands for every kind of missing value. Dates are texts.

    Raises:
        UsageError: For other objects, such as lists.
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


# -- values of a column under a task -------------------------------------------------------------------------

MOST_DOUBTFUL = 20
"""Largest number of different integers, from 3 on, that can be classes or quantities; only the user knows."""
LARGEST = 1e100
"""The largest quantity, because quantities are squared and summed in float64, which ends at 1e308."""


@dataclass(frozen=True)
class LabelValues:
    """A column of labels, coded for its task.

    Attributes:
        classes: Names of the classes in order, empty for a continuous label.
        values: (n,) float64, the number of the class or the quantity; NaN where the cell is empty.
    """

    task: Task
    classes: tuple[str, ...]
    values: NDArray[np.float64]

    def of(self, at: Sequence[int]) -> "LabelValues":
        """Return the values at some positions, with the classes that occur there."""
        return self.of_values(self.values[list(at)])

    def of_values(self, values: NDArray[np.float64]) -> "LabelValues":
        """Return some of the coded values, with the classes that occur among them, coded anew."""
        if not self.classes:
            return LabelValues(self.task, (), values)
        present = np.unique(values[np.isfinite(values)])
        codes = np.where(np.isfinite(values), np.searchsorted(present, values), np.nan)
        return LabelValues(self.task, tuple(self.classes[int(code)] for code in present), codes)


def code_labels(cells: Sequence[Cell], task: Task | None, target: str) -> LabelValues:
    """Code the cells of the column `target`, all of one kind, for `task`, or for the only task that fits.

    Booleans and two values are binary, other texts classes, other numbers continuous.

    Raises:
        UsageError: If the column is empty or constant, cannot have this task, or could have two.
    """
    if task is not None and task not in TASKS:
        raise UsageError(f"task {task!r}; expected one of {', '.join(TASKS)}")
    present = [_integer_if_whole(cell) for cell in cells if cell is not None]
    distinct = sorted(set(present))  # type: ignore[type-var]  # of one kind, so that they can be ordered
    if len(distinct) < 2:
        contents = f"one value, {distinct[0]!r}" if distinct else "no value"
        raise UsageError(f"column {target!r} has {contents}; expected two or more. There is nothing to decode")
    fitting_task = task or _only_task(distinct, target)
    _check_task(fitting_task, distinct, target)
    if fitting_task == "continuous":
        numbers = np.array([np.nan if cell is None else float(cell) for cell in cells], np.float64)
        # Sums of their squares must stay in the range of float64.
        largest, spread = float(np.nanmax(np.abs(numbers))), float(np.nanmax(numbers) - np.nanmin(numbers))
        if largest > LARGEST or spread < 1 / LARGEST:
            raise UsageError(
                f"column {target!r} has values up to {largest:g}, and they differ by {spread:g}; expected at most "
                f"{LARGEST:g}, and differences of at least {1 / LARGEST:g}. Correct the cell, or give another unit"
            )
        return LabelValues(fitting_task, (), numbers)
    code = {value: number for number, value in enumerate(distinct)}
    codes = [np.nan if cell is None else code[_integer_if_whole(cell)] for cell in cells]
    return LabelValues(fitting_task, tuple(map(str, distinct)), np.array(codes, np.float64))


def _integer_if_whole(cell: Cell) -> Cell:
    """Return a number without decimals as an integer: tables with empty cells store integers as decimals."""
    return int(cell) if isinstance(cell, float) and cell.is_integer() else cell


def _only_task(distinct: Sequence[Cell], target: str) -> Task:
    if len(distinct) == 2:
        return "binary"
    if isinstance(distinct[0], str):
        return "classes"
    if all(isinstance(value, int) for value in distinct) and len(distinct) <= MOST_DOUBTFUL:
        raise UsageError(
            f"column {target!r} has {len(distinct)} integers, from {distinct[0]} to {distinct[-1]}, which can be "
            "classes or quantities. Say which with --task classes or --task continuous (task=…)"
        )
    return "continuous"


def _check_task(task: Task, distinct: Sequence[Cell], target: str) -> None:
    if task == "continuous" and isinstance(distinct[0], str | bool):
        kind = "true and false" if isinstance(distinct[0], bool) else f"texts such as {distinct[0]!r}"
        raise UsageError(
            f"column {target!r} has {kind}; a continuous label needs numbers. Use --task "
            f"{'binary' if len(distinct) == 2 else 'classes'}"
        )
    if task == "binary" and len(distinct) != 2:
        listed = ", ".join(repr(value) for value in distinct[:4])
        raise UsageError(
            f"column {target!r} has {len(distinct)} values ({listed}, …); a binary label needs two. "
            "Use --task classes or --task continuous"
        )
    if task == "classes" and not all(isinstance(value, str | int) for value in distinct):
        decimal = next(value for value in distinct if not isinstance(value, str | int))
        raise UsageError(
            f"column {target!r} has decimals such as {cast(float, decimal)!r}; classes need texts or integers. "
            "Use --task continuous, or write the classes as words"
        )
