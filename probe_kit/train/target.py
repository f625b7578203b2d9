"""The labels that probes decode, one for every episode or captured inference: `Target`.

A target is a side of a picture, another built-in column, or a column of a user's table. `label_columns` reads the
cells; `target_samples` decides which samples of a run have one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.escaping import terminal_safe
from probe_kit._system.table_cells import Cell
from probe_kit._tables.label_table import LabelTable
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed, sha256_json
from probe_kit.runs.layout import RECORDED_EPISODES
from probe_kit.runs.reader import RunReader, check_sides
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.builtin_columns import BuiltinColumn, BuiltinColumns
from probe_kit.train.choices import SIDES, Chance, Task
from probe_kit.train.label_columns import (
    EPISODE,
    FRAME,
    FRAMES,
    INFERENCE,
    SOURCE,
    SOURCES,
    LabelValues,
    code_labels,
    read_table,
)

if TYPE_CHECKING:
    import pandas as pd


Null = Literal["flip_groups", "exchange_groups", "exchange_blocks"]
"""The way in which label permutations are drawn.

flip_groups: groups flip all their labels; for the correct side, which a suite draws freely.
exchange_groups: groups exchange their labels layout by layout; for the chosen side.
exchange_blocks: groups exchange their labels as blocks, inference by inference; for every other target.
"""
_MOST_CLASSES = 20
"""Classes that a line about a target lists; probes take any number."""
_CLASSES = "; or say that the texts are classes with --task classes or --task binary (task=…)"
_COUNTED = {
    INFERENCE: "a captured inference",
    **dict.fromkeys(FRAMES, "a frame"),
    **dict.fromkeys(SOURCES, "an episode"),
}


@dataclass(frozen=True)
class Target:
    """The labels of episodes, or of captured inferences, for `train_probes(run, target=target)`.

    Made by `Target.read` from a table, or by `Target.of_run` from what a run stores.

    Attributes:
        name: Name of the column or side.
        coded: Task, classes and values.
        episodes: (n,) ids of the episodes.
        inferences: (n,) captured inference of every label, None where a label is of a whole episode.
        table: Rows of the labels, to which errors point.
        group_by: Column whose values folds, intervals and nulls keep together; None for the groups of the run.
        exchange_within: Column within which label permutations exchange groups; None for everywhere.
        groups: (n,) values of `group_by`; None where they are read from the run.
        strata: (n,) values of `exchange_within`; None where they are read from the run.
        of_source: Whether episodes and inferences are numbers of episodes and frames of a data set; see `on`.
        unseen: Number of labels that name a frame or episode that the run of `on` does not show.
        builtin: Whether probe_kit computed the column.
        null: How label permutations are drawn, see `Null`.
    """

    name: str
    coded: LabelValues
    episodes: tuple[str, ...]
    inferences: tuple[int, ...] | None
    table: LabelTable
    group_by: str | None = None
    exchange_within: str | None = None
    groups: tuple[str, ...] | None = None
    strata: tuple[str, ...] | None = None
    of_source: bool = False
    unseen: int = 0
    builtin: bool = False
    null: Null = "exchange_blocks"

    @classmethod
    def read(
        cls,
        table: "Path | str | pd.DataFrame | pd.Series[Any]",
        name: str,
        task: Task | None = None,
        group_by: str | None = None,
        exchange_within: str | None = None,
    ) -> "Target":
        """Return the column `name` of a table: a CSV or Parquet file, a DataFrame or a Series.

        Key columns are `episode_id` and, for labels that change within an episode, `inference`, counted from 0. Of
        recordings they may be `source_episode` and `frame`, by the numbers of the data set, or `episode_index` and
        `frame_index`, as LeRobot calls them. Empty cells are left out. Names of episodes and groups are texts as
        they are written, never numbers.

        Args:
            table: Path of the file, the DataFrame, or a Series whose index has the keys.
            name: Column to decode.
            task: Binary, classes or continuous; None where the values leave no doubt.
            group_by: Column of the table or of the run's episodes whose values folds, intervals and nulls keep
                together; None for the groups of the run.
            exchange_within: Column of the table or of the run's episodes within which label permutations exchange
                groups; None for everywhere.

        Raises:
            UsageError: For a missing or mixed column, a key used twice, an integer beyond 2^53, an infinite
                number, a control character, or a task that the values cannot have. The message names file and
                line.
        """
        group_columns = [column for column in (group_by, exchange_within) if column is not None]
        label_table = read_table(table, [name], group_columns)
        of_source = EPISODE not in label_table.columns
        keys = (*SOURCES, *FRAMES) if of_source else (EPISODE, INFERENCE)
        if name not in label_table.columns or name in keys:
            columns = (column for column in label_table.names if column not in keys)
            listed = ", ".join(map(terminal_safe, columns))[:500] or "none"
            raise UsageError(f"{label_table.source} has no column {name!r} to decode; it has: {listed}")
        if not label_table.lines:
            raise UsageError(
                f"{label_table.source} has no {label_table.unit} below its heading; expected one per label"
            )
        if of_source:  # numbers as a spreadsheet or a merge may leave them, such as 3.0
            episodes = tuple(map(str, _numbers_of_either(label_table, SOURCES) or ()))
            inferences = _numbers_of_either(label_table, FRAMES)
        else:
            episodes, inferences = tuple(label_table.texts(EPISODE)), _numbers(label_table, INFERENCE)
        cells = label_table.values(name, task in ("classes", "binary"), _CLASSES)
        groups, strata = _names(label_table, group_by), _names(label_table, exchange_within)
        at = _once(label_table, episodes, inferences, [cells, *filter(None, (groups, strata))])
        return cls(
            name,
            code_labels([cells[row] for row in at], task, name),
            tuple(episodes[row] for row in at),
            _rows_of(inferences, at),
            label_table.at(at),
            group_by,
            exchange_within,
            _rows_of(groups, at),
            _rows_of(strata, at),
            of_source,
        )

    def on(self, run: RunReader) -> "Target":
        """Return these labels with the keys of a run, without those of frames or episodes that it does not show.

        Labels that have its keys already are returned as they are.

        Raises:
            UsageError: For a run of scenes, for frames or episodes that were never recorded, if the run shows
                none of the frames, and for a table with keys of both kinds that contradict each other.
        """
        if not self.of_source:
            if run.recorded and not self.builtin:
                _check_source_keys(run, self)
            return self
        if not run.recorded:
            raise UsageError(
                f"{self.table.source} has the key {_present(self.table, SOURCES)!r} of recordings, and "
                f"{run.location} is of scenes; expected {EPISODE!r}. `probe-kit labels RUN` writes the ids"
            )
        run_keys = _source_frames(run, self.inferences is not None)
        frames: Sequence[int] = self.inferences or (-1,) * len(self.episodes)
        _check_recorded(run, self.table, self.episodes, self.inferences)
        keys = [run_keys.get((episode, frame), ()) for episode, frame in zip(self.episodes, frames, strict=True)]
        at = [number for number, matches in enumerate(keys) for _ in matches]
        if not at:
            raise UsageError(f"{self.table.source} has no label of a frame that {run.location} shows")
        flat = [key for matches in keys for key in matches]
        return replace(
            self,
            coded=self.coded.of(at),
            episodes=tuple(episode for episode, _ in flat),
            inferences=None if self.inferences is None else tuple(call for _, call in flat),
            table=self.table.at(at),
            groups=_rows_of(self.groups, at),
            strata=_rows_of(self.strata, at),
            of_source=False,
            unseen=sum(not matches for matches in keys),
        )

    @classmethod
    def of_run(
        cls,
        run: RunReader,
        name: str,
        task: Task | None = None,
        group_by: str | None = None,
        exchange_within: str | None = None,
        seed: int = 0,
    ) -> "Target":
        """Return a side or built-in column of a run, such as `sim.tool_y`; `probe-kit targets RUN` lists them.

        Args:
            run: Run that stores the column.
            name: Name of a side or built-in column.
            task: The column's own by default.
            group_by: Column of the run's episodes that folds, intervals and nulls keep together; None for the
                groups of the run. No side takes it.
            exchange_within: Column of the run's episodes within which label permutations exchange groups; None for
                everywhere. No side takes it.
            seed: Seed of the flips of the target `side.shuffled`.

        Raises:
            UsageError: For another name, and for a run that lacks what the column needs.
            NoTrajectoryError: For `sim.*` of a run without trajectories.
        """
        if name in SIDES:
            return _side(run, name, seed, task, group_by, exchange_within)
        return cls.of_column(name, BuiltinColumns(run).read(name), task, group_by, exchange_within)

    @classmethod
    def of_column(
        cls,
        name: str,
        column: BuiltinColumn,
        task: Task | None = None,
        group_by: str | None = None,
        exchange_within: str | None = None,
    ) -> "Target":
        """Return a built-in column that was read, as `of_run` does.

        Raises:
            UsageError: For a constant column.
        """
        keys: dict[str, list[Cell]] = {EPISODE: list(column.episodes), name: list(column.cells)}
        lines = list(range(1, len(column.episodes) + 1))
        table = LabelTable(f"the built-in column {name}", "sample", tuple(keys), keys, lines)
        coded = code_labels(table.typed(name), task or column.task, name)
        return cls(name, coded, column.episodes, column.inferences, table, group_by, exchange_within, builtin=True)

    def equal_to(self, value: str) -> "Target":
        """Return a binary label: whether this one is the class `value`, such as an event where windows begin.

        Raises:
            UsageError: For a value that is no class.
        """
        classes = self.coded.classes
        if value not in classes:
            listed = ", ".join(classes[:8]) or "quantities, not classes"
            raise UsageError(f"{self.described} has no value {value!r}; it has {listed}")
        codes = self.coded.values
        coded = LabelValues(
            "binary", ("False", "True"), np.where(np.isnan(codes), np.nan, codes == classes.index(value))
        )
        return replace(self, name=f"{self.name}={value}", coded=coded)

    @property
    def task(self) -> Task:
        """The task: `binary`, `classes` or `continuous`."""
        return self.coded.task

    @property
    def balanced(self) -> bool:
        """Whether accuracies are balanced between two sides of a picture, so that `chance` is one half."""
        return self.null != "exchange_blocks"

    @property
    def chance(self) -> Chance:
        """The level that scores are compared with: one half, or the mean score of permuted labels at each site."""
        return "half" if self.balanced else "permuted"

    @property
    def per_step(self) -> bool:
        """Whether labels are of single inferences, not of whole episodes."""
        return self.inferences is not None

    @cached_property
    def sha256(self) -> str:
        """The hash of the column: of every label with its episode and inference, independent of their order."""
        classes, values = self.coded.classes, self.coded.values.tolist()
        inferences: Sequence[int] = self.inferences or (-1,) * len(self.episodes)
        return sha256_json(
            sorted(
                [episode, inference, classes[int(value)] if classes else value]
                for episode, inference, value in zip(self.episodes, inferences, values, strict=True)
                if value == value  # NaN is a missing label
            )
        )

    @property
    def definition(self) -> str:
        """The hash of what the label is, not of its values: column, task, source, and per episode or inference.

        A built-in column is one formula in every run. Of a table only the name is known: one column name must mean
        one thing in both tables.
        """
        return sha256_json([self.name, self.task, self.builtin, self.per_step])

    @property
    def described(self) -> str:
        """The definition in words."""
        kind = "built-in column" if self.builtin else "column of a table"
        return f"the {kind} {self.name!r} ({self.task}, per {'inference' if self.per_step else 'episode'})"

    @property
    def contents(self) -> str:
        """The name, task and values in one line."""
        return f"{terminal_safe(self.name)} ({self.task}), {self.values_in_words}"

    @property
    def value_counts(self) -> dict[str, Any]:
        """The counts by class, or the range of a quantity, with how many labels there are and are missing."""
        values = self.coded.values
        present = values[np.isfinite(values)]
        counts: dict[str, Any] = {"labels": int(present.size), "missing": int(np.isnan(values).sum())}
        if not self.coded.classes:
            return {**counts, "minimum": float(present.min()), "maximum": float(present.max())}
        of_classes = np.bincount(present.astype(np.int64), minlength=len(self.coded.classes)).tolist()
        return {**counts, "classes": dict(zip(map(str, self.coded.classes), of_classes, strict=True))}

    @property
    def values_in_words(self) -> str:
        """The classes with their counts, or the range of a quantity, and how many labels are missing."""
        counts = self.value_counts
        if "classes" in counts:
            counted = [f"{terminal_safe(name)} {n}" for name, n in counts["classes"].items()]
            more = f", and {len(counted) - _MOST_CLASSES} more" if len(counted) > _MOST_CLASSES else ""
            text = f"{len(counted)} classes: {', '.join(counted[:_MOST_CLASSES])}{more}"
        else:
            text = f"{counts['labels']} numbers from {counts['minimum']:g} to {counts['maximum']:g}"
        missing: int = counts["missing"]
        return text + f"; {missing} missing" * (missing > 0)

    def __repr__(self) -> str:
        present = int(np.isfinite(self.coded.values).sum())
        of = "inferences" if self.per_step else "episodes"
        return f"<Target {self.name}: {self.task}, {present} {of}, from {self.table.source}>"


def _side(
    run: RunReader, name: str, seed: int, task: Task | None, group_by: str | None, exchange_within: str | None
) -> Target:
    """Return the side of the correct picture, the chosen one, or the correct one flipped for half of the items.

    Raises:
        UsageError: For a run without sides, for options of other targets, and for `side.chosen` of a run that did
            not act.
    """
    check_sides(run, f"a probe of the side ({name})")
    options = {"task": task, "group_by": group_by, "exchange_within": exchange_within}
    if refused := [option for option, value in options.items() if value not in (None, "binary")]:
        raise UsageError(
            f"{refused[0]}={options[refused[0]]} with the side {name!r}; expected none, because a side is "
            "binary and its groups are the run's. Leave it out, or take another target"
        )
    if name == "side.chosen" and "side_placed" not in run.episodes:
        raise UsageError(
            f"the side {name!r} of {run.location}, whose episodes were captured without acting: none chose a "
            "side. Take another target, or extract without --no-act"
        )
    labels = side_labels(run.episodes, name, seed)
    episodes = tuple(run.episodes[EPISODE].astype(str))
    values = np.where(labels < 0, np.nan, labels.astype(np.float64))
    lines = list(range(1, len(episodes) + 1))
    table = LabelTable(f"the side {name}", "episode", (EPISODE,), {EPISODE: list(episodes)}, lines)
    coded = LabelValues("binary", ("right", "left"), values)
    null: Null = "exchange_groups" if name == "side.chosen" else "flip_groups"
    return Target(name, coded, episodes, None, table, builtin=True, null=null)


def side_labels(episodes: "pd.DataFrame", name: str, seed: int) -> NDArray[np.int8]:
    """Return the side of every episode, (E,): 1 left, 0 right, −1 where it is not defined."""
    sides = episodes["side_placed" if name == "side.chosen" else "side_correct"]
    labels = np.select([sides == "left", sides == "right"], [np.int8(1), np.int8(0)], np.int8(-1))
    if name != "side.shuffled":
        return labels
    flipped = flip_items(labels == 1, episodes["item_id"], 1, derive_seed("shuffled target", seed))
    return flipped[:, 0].astype(np.int8)


def _source_frames(run: RunReader, by_frame: bool) -> dict[tuple[str, int], list[tuple[str, int]]]:
    """Return episode ids and inferences of a run by source episode and frame; a whole episode has frame -1."""
    keys_of: dict[tuple[str, int], list[tuple[str, int]]] = {}
    steps = run.control_steps
    for row, (name, source) in enumerate(zip(run.episodes[EPISODE], run.episodes[SOURCE], strict=True)):
        for call, frame in enumerate(steps[row].tolist() if by_frame else [-1]):
            if frame >= 0 or not by_frame:
                keys_of.setdefault((str(source), frame), []).append((str(name), call))
    return keys_of


def _check_recorded(
    run: RunReader, table: LabelTable, episodes: Sequence[str], frames: Sequence[int] | None
) -> None:
    """Raise UsageError for an episode that the data set lacks, or a frame that its episode lacks."""
    count: int | None = run.settings["recording"][RECORDED_EPISODES]
    if count is None:  # of episodes that arrived: how many there are, and how long, no data set says
        return
    rows = zip(run.episodes[SOURCE].tolist(), run.episodes["recorded_frames"].tolist(), strict=True)
    lengths = {str(source): int(length) for source, length in rows}
    for row, episode in enumerate(episodes):
        if int(episode) >= count:
            raise UsageError(
                f"{table.where(row, _present(table, SOURCES))} is {episode}; the data set of {run.location} has "
                f"{count} episodes, counted from 0. Correct the numbers of the episodes"
            )
        if frames is not None and frames[row] >= lengths.get(episode, frames[row] + 1):
            raise UsageError(
                f"{table.where(row, _present(table, FRAMES))} is {frames[row]}; episode {episode} of the data set "
                f"of {run.location} has {lengths[episode]} frames, counted from 0 in each episode. Correct the "
                "table, which may count from 1, or by the column `index` of the data set"
            )


def _numbers(table: LabelTable, column: str) -> tuple[int, ...] | None:
    """Return a key column of whole numbers; None where the table lacks it.

    Raises:
        UsageError: For a cell that is no whole number from 0.
    """
    if column not in table.columns:
        return None
    cells = table.numbers(column)
    for row, cell in enumerate(cells):
        fraction = isinstance(cell, float) and not cell.is_integer()
        if isinstance(cell, bool | str | None) or fraction or cell < 0:
            text = "empty" if cell is None else repr(cell)
            raise UsageError(
                f"{table.where(row, column)} is {text}; expected the number of {_COUNTED[column]}, from 0"
            )
    return tuple(int(cell) for cell in cells if cell is not None)


def _present(table: LabelTable, names: Sequence[str]) -> str | None:
    """Return the first of two names of a key that a table has as a column; None where it has none."""
    return next((name for name in names if name in table.columns), None)


def _numbers_of_either(table: LabelTable, names: Sequence[str]) -> tuple[int, ...] | None:
    """Return a key column by one of its names; None where the table lacks it.

    Raises:
        UsageError: For two columns that contradict each other, and as `_numbers`.
    """
    read = {name: numbers for name in names if (numbers := _numbers(table, name)) is not None}
    for (first, numbers), (second, other_numbers) in pairwise(read.items()):
        for row, (number, other) in enumerate(zip(numbers, other_numbers, strict=True)):
            if number != other:
                raise UsageError(
                    f"{table.where(row)}: {first!r} is {number} and {second!r} is {other}; expected the same "
                    "number. Leave one of the two columns out"
                )
    return next(iter(read.values()), None)


def _check_source_keys(run: RunReader, target: Target) -> None:
    """Raise UsageError where a table with the ids of a run also has numbers of its data set, and others.

    Numbers of frames are compared where labels are of single inferences; elsewhere a table may have kept any.
    """
    table, steps = target.table, run.control_steps
    row_of = {str(name): row for row, name in enumerate(run.episodes[EPISODE])}
    due_sources = run.episodes[SOURCE].tolist()
    for names, is_frame in ((SOURCES, False), (FRAMES, True)):
        key = _present(table, names)
        if key is None or (is_frame and (target.inferences is None or _present(table, SOURCES) is None)):
            continue
        for number, (episode, cell) in enumerate(zip(target.episodes, table.numbers(key), strict=True)):
            row = row_of.get(episode)
            call = 0 if target.inferences is None else target.inferences[number]
            if row is None or cell is None or call >= steps.shape[1]:
                continue  # an episode that the run lacks is refused where labels find their samples
            due = int(steps[row, call]) if is_frame else int(due_sources[row])
            if cell != due and due >= 0:
                due_key = f"{'frame' if is_frame else 'episode'} {due} of the data set"
                label = f"{EPISODE} {episode!r}" + (f", {INFERENCE} {call}," if is_frame else "")
                raise UsageError(
                    f"{table.where(number, key)} is {cell!r}, and {label} is {due_key}; expected keys of the same "
                    "label. Leave one of the two columns out"
                )


def _once(
    table: LabelTable, episodes: Sequence[str], inferences: Sequence[int] | None, columns: Sequence[Sequence[Cell]]
) -> list[int]:
    """Return the rows of a table, one per key: rows that are equal in all `columns` count once.

    Raises:
        UsageError: For two rows with one key and other values.
    """
    first: dict[tuple[str, int], int] = {}
    for row, episode in enumerate(episodes):
        key = episode, -1 if inferences is None else inferences[row]
        if (before := first.setdefault(key, row)) == row or all(cells[before] == cells[row] for cells in columns):
            continue
        step = INFERENCE if EPISODE in table.columns else _present(table, FRAMES) or FRAME
        described = f"episode {episode!r}" + ("" if inferences is None else f", {step} {key[1]}")
        raise UsageError(
            f"{table.where(row)}: {described} has a label in {table.unit} {table.lines[before]} already. Leave "
            f"one out{'' if inferences is not None else f', or add a column {step!r}'}"
        )
    return list(first.values())


def _rows_of[T](column: Sequence[T] | None, rows: Sequence[int]) -> tuple[T, ...] | None:
    return None if column is None else tuple(column[row] for row in rows)


def _names(table: LabelTable, column: str | None) -> tuple[str, ...] | None:
    return None if column is None or column not in table.columns else tuple(table.group_names(column))
