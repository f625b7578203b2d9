"""Values of a label column under a task: codes of classes, or numbers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.table_cells import Cell
from probe_kit.errors import UsageError
from probe_kit.train.choices import TASKS, Task

MOST_DOUBTFUL = 20
"""Integers of 3 to so many values can be classes or quantities; only the user knows."""
LARGEST = 1e100
"""Quantities are squared and summed in float64, which ends at 1e308."""


@dataclass(frozen=True)
class LabelValues:
    """A column of labels, coded for its task.

    classes: names of the classes in order, empty for a continuous label. values: (n,) float64, the number of the
    class or the quantity; NaN where the cell is empty.
    """

    task: Task
    classes: tuple[str, ...]
    values: NDArray[np.float64]

    def of(self, at: Sequence[int]) -> "LabelValues":
        """Return the values at some places, with the classes that occur there."""
        return self.of_values(self.values[list(at)])

    def of_values(self, values: NDArray[np.float64]) -> "LabelValues":
        """Return some of the coded values, with the classes that occur among them, coded anew."""
        if not self.classes:
            return LabelValues(self.task, (), values)
        present = np.unique(values[np.isfinite(values)])
        codes = np.where(np.isfinite(values), np.searchsorted(present, values), np.nan)
        return LabelValues(self.task, tuple(self.classes[int(code)] for code in present), codes)


def code_labels(cells: Sequence[Cell], task: Task | None, target: str) -> LabelValues:
    """Code the cells of one kind of the column `target` for `task`, or for the only task that fits.

    Booleans and two values are binary, other texts classes, other numbers continuous. Raises UsageError if the
    column is empty or constant, cannot have this task, or could have two.
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
        _check_squares(numbers, target)
        return LabelValues(fitting_task, (), numbers)
    code = {value: number for number, value in enumerate(distinct)}
    codes = [np.nan if cell is None else code[_integer_if_whole(cell)] for cell in cells]
    return LabelValues(fitting_task, tuple(map(str, distinct)), np.array(codes, np.float64))


def _integer_if_whole(cell: Cell) -> Cell:
    """A number without decimals as an integer: tables with empty cells store integers as decimals."""
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


def _check_squares(numbers: NDArray[np.float64], target: str) -> None:
    """Raise UsageError for quantities whose sums of squares leave the range of float64."""
    largest, spread = float(np.nanmax(np.abs(numbers))), float(np.nanmax(numbers) - np.nanmin(numbers))
    if largest > LARGEST or spread < 1 / LARGEST:
        raise UsageError(
            f"column {target!r} has values up to {largest:g}, and they differ by {spread:g}; expected at most "
            f"{LARGEST:g}, and differences of at least {1 / LARGEST:g}. Correct the cell, or give another unit"
        )


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
