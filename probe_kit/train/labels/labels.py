"""`Labels`: one column of labels by episode or by captured inference."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probe_kit._terminal.plain_text import terminal_safe
from probe_kit.errors import UsageError
from probe_kit.hashing import sha256_json
from probe_kit.train.choices import Task
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.labels.builtin_columns import builtin_column
from probe_kit.train.labels.label_table import EPISODE, INFERENCE, Cell, LabelTable, read_table
from probe_kit.train.labels.label_values import LabelValues, code_labels

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Labels:
    """One label per episode, or per captured inference of an episode, for `train_probes(run, labels=labels)`.

    Made by `Labels.read` from a table, or by `Labels.of_run` from what a run stores.

    coded: task, classes and values. episodes: (n,) ids. inferences: (n,) captured inference of every label, None
    where a label is of a whole episode. group_by: column whose values folds, intervals and nulls keep together;
    None for the groups of the run. exchange_within: column within which label permutations exchange groups; None
    for everywhere. groups, strata: (n,) those columns, None where the run has them. table: where errors point to.
    """

    target: str
    coded: LabelValues
    episodes: tuple[str, ...]
    inferences: tuple[int, ...] | None
    table: LabelTable
    group_by: str | None = None
    exchange_within: str | None = None
    groups: tuple[str, ...] | None = None
    strata: tuple[str, ...] | None = None

    @classmethod
    def read(
        cls,
        table: "Path | str | pd.DataFrame",
        target: str,
        task: Task | None = None,
        group_by: str | None = None,
        exchange_within: str | None = None,
    ) -> "Labels":
        """The column `target` of a table: a CSV or Parquet file, or a DataFrame.

        Key columns are `episode_id` and, for labels that change within an episode, `inference`, counted from 0.
        Empty cells are left out. task: binary, classes or continuous; None where the values leave no doubt.
        group_by, exchange_within: columns of the table or of the run's episodes.
        Raises UsageError, naming file and line, for a missing or mixed column, a key used twice, an integer beyond
        2^53, an infinite number, a control character, or a task that the values cannot have.
        """
        further = [name for name in (group_by, exchange_within) if name is not None]
        found = read_table(table, [target, *further])
        if target not in found.columns or target in (EPISODE, INFERENCE):
            known = ", ".join(terminal_safe(name) for name in found.names if name not in (EPISODE, INFERENCE))
            raise UsageError(f"{found.source} has no column {target!r} to decode; it has: {known[:500] or 'none'}")
        if not found.lines:
            raise UsageError(f"{found.source} has no {found.unit} below its heading; expected one per label")
        episodes, inferences = tuple(found.texts(EPISODE)), _inferences(found)
        _check_keys(found, episodes, inferences)
        return cls(
            target,
            code_labels(found.cells(target), task, target),
            episodes,
            inferences,
            found,
            group_by,
            exchange_within,
            _names(found, group_by),
            _names(found, exchange_within),
        )

    @classmethod
    def of_run(
        cls,
        run: RunReader,
        target: str,
        task: Task | None = None,
        group_by: str | None = None,
        exchange_within: str | None = None,
    ) -> "Labels":
        """A built-in column of a run, such as `sim.tool_y` or `item.named`; `probe-kit labels RUN` lists them.

        task: the column's own by default. Raises UsageError for another name, and for a run that lacks what the
        column needs; NoTrajectoryError for `sim.*` of a run without trajectories.
        """
        column = builtin_column(run, target)
        keys: dict[str, list[Cell]] = {EPISODE: list(column.episodes), target: list(column.cells)}
        lines = list(range(1, len(column.episodes) + 1))
        table = LabelTable(f"the built-in column {target}", "sample", tuple(keys), keys, lines)
        coded = code_labels(table.cells(target), task or column.task, target)
        return cls(target, coded, column.episodes, column.inferences, table, group_by, exchange_within)

    @property
    def task(self) -> Task:
        """binary, classes or continuous."""
        return self.coded.task

    @property
    def per_step(self) -> bool:
        """Whether labels are of single inferences, not of whole episodes."""
        return self.inferences is not None

    @cached_property
    def sha256(self) -> str:
        """Hash of the column: of every label with its episode and inference, in whatever order they were given."""
        classes, values = self.coded.classes, self.coded.values.tolist()
        inferences: Sequence[int] = self.inferences or (-1,) * len(self.episodes)
        return sha256_json(
            sorted(
                [episode, inference, classes[int(value)] if classes else value]
                for episode, inference, value in zip(self.episodes, inferences, values, strict=True)
                if value == value
            )
        )

    def __repr__(self) -> str:
        present = int(np.isfinite(self.coded.values).sum())
        of = "inferences" if self.per_step else "episodes"
        return f"<Labels {self.target}: {self.task}, {present} {of}, from {self.table.source}>"


def _inferences(table: LabelTable) -> tuple[int, ...] | None:
    if INFERENCE not in table.columns:
        return None
    cells = table.columns[INFERENCE]
    for row, cell in enumerate(cells):
        if isinstance(cell, bool | str | None) or not float(cell).is_integer() or cell < 0:
            raise UsageError(
                f"{table.where(row, INFERENCE)} is {cell!r}; expected the number of a captured inference, from 0"
            )
    return tuple(int(cell) for cell in cells if cell is not None)


def _check_keys(table: LabelTable, episodes: Sequence[str], inferences: Sequence[int] | None) -> None:
    """Raise UsageError for two rows with one key."""
    seen: dict[tuple[str, int], int] = {}
    for row, episode in enumerate(episodes):
        key = episode, -1 if inferences is None else inferences[row]
        if (first := seen.setdefault(key, row)) != row:
            named = f"episode {episode!r}" + ("" if inferences is None else f", inference {key[1]}")
            raise UsageError(
                f"{table.where(row)}: {named} has a label in {table.unit} {table.lines[first]} already. Leave one "
                f"out{'' if inferences is not None else f', or add a column {INFERENCE!r}'}"
            )


def _names(table: LabelTable, column: str | None) -> tuple[str, ...] | None:
    return None if column is None or column not in table.columns else tuple(table.texts(column))
