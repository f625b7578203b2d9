"""The built-in label columns of a run: `sim.*` of its trajectories, `item.*` of its plan."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.table_cells import Cell
from probe_kit.errors import UsageError
from probe_kit.runs.action_errors import compare_actions, why_not_compared
from probe_kit.runs.reader import RunReader, reached_calls
from probe_kit.train.choices import Task
from probe_kit.train.label_columns import EPISODE, INFERENCE

if TYPE_CHECKING:
    import pandas as pd


SIM, ITEM, RECORDED, PLAYED = "sim.", "item.", "dataset.", "env."
"""The prefixes of built-in columns: of the simulation, of items, of recordings and of environments."""
ACTION_ERROR = "action_error"
"""Column of a shown frame: root mean square of predicted minus recorded first action, in recorded deviations."""
OUTCOME = "env.outcome"
"""Column that says once per episode whether an episode in an environment of one's own succeeded."""
PHASES = ("before grasp", "holding", "after release")


@dataclass(frozen=True)
class BuiltinColumn:
    """A built-in column, with the keys and values of its n labels.

    Attributes:
        task: None where the values decide it.
        episodes: (n,) ids of episodes.
        inferences: (n,) numbers of captured inferences; None for one label per episode.
        cells: (n,) values, None where a label is missing.
    """

    task: Task | None
    episodes: tuple[str, ...]
    inferences: tuple[int, ...] | None
    cells: tuple[Cell, ...]

    @property
    def is_constant(self) -> bool:
        """Whether it holds one value, such as a part of a state that never moves."""
        return len({cell for cell in self.cells if cell is not None}) == 1


@dataclass(frozen=True)
class Instant:
    """A frame of a trajectory, and the side of the correct picture."""

    trajectory: Any
    side: str
    frame: int

    def tool(self, axis: int) -> float:
        """Return a coordinate of the hand, metres in the world frame."""
        return float(self.trajectory.tool[self.frame, axis])

    def cube(self, axis: int) -> float:
        """Return a coordinate of the cube, metres in the world frame."""
        return float(self.trajectory.cube[self.frame, axis])

    @property
    def distance_correct(self) -> float:
        """The distance of the cube from the middle of the correct picture, from above, metres."""
        away = self.trajectory.cube[self.frame, :2] - self.trajectory.tile(self.side)[self.frame, :2]
        return float(np.hypot(*away))

    @property
    def steps_to_grasp(self) -> float | None:
        """The number of control steps to the first grasp, negative behind it; None if there is none."""
        held_frames = self._frames_of_grasp
        return float(held_frames[0] - self.frame) if held_frames.size else None

    @property
    def phase(self) -> str:
        """A phase of `PHASES`; the release is the last one of the episode."""
        held_frames = self._frames_of_grasp
        if not held_frames.size or self.frame < held_frames[0]:
            return PHASES[0]
        return PHASES[1] if self.frame <= held_frames[-1] else PHASES[2]

    @property
    def _frames_of_grasp(self) -> NDArray[np.intp]:
        """The frames in which both fingers touch the cube."""
        return np.flatnonzero(self.trajectory.held)


SIM_COLUMNS: dict[str, tuple[Task, Callable[[Instant], Cell]]] = {
    "tool_x": ("continuous", lambda at: at.tool(0)),
    "tool_y": ("continuous", lambda at: at.tool(1)),
    "tool_z": ("continuous", lambda at: at.tool(2)),
    "cube_x": ("continuous", lambda at: at.cube(0)),
    "cube_y": ("continuous", lambda at: at.cube(1)),
    "cube_z": ("continuous", lambda at: at.cube(2)),
    "distance_correct": ("continuous", lambda at: at.distance_correct),
    "steps_to_grasp": ("continuous", lambda at: at.steps_to_grasp),
    "held": ("binary", lambda at: bool(at.trajectory.held[at.frame])),
    "phase": ("classes", lambda at: at.phase),
}
"""Task and value of every `sim.*` column."""

ITEM_COLUMNS = {
    "named": "concept of the correct picture, which the instruction names",
    "other": "concept of the wrong picture",
    "left": "concept of the left picture",
    "category": "category of the item",
    "pair": "both concepts, in alphabetical order",
}


class BuiltinColumns:
    """The built-in columns of a run; data that several of them need are read once."""

    def __init__(self, run: RunReader) -> None:
        self._run = run

    @property
    def names(self) -> list[str]:
        """The names of the columns of a run of this kind; this run may still lack some."""
        if self._run.inputs is None:
            return builtin_names()
        recorded = [prefix_of(self._run) + name for name in self._recorded]
        return [*recorded, *outcome_column(self._run), *fact_columns(self._run)]

    def read(self, name: str) -> BuiltinColumn:
        """Return a column by its name, for every episode or captured inference that the run has.

        Raises:
            UsageError: For another name, and for a run that does not store the data of the column.
            NoTrajectoryError: For a `sim.*` column of a run without trajectories.
        """
        run = self._run
        if name.startswith(SIM) and name.removeprefix(SIM) in SIM_COLUMNS:
            name = name.removeprefix(SIM)
            episodes, inferences = tuple(zip(*_inferences(run), strict=True)) or ((), ())
            return BuiltinColumn(SIM_COLUMNS[name][0], episodes, inferences, self._sim[name])
        if name.startswith(ITEM) and name.removeprefix(ITEM) in ITEM_COLUMNS:
            ids = tuple(run.episodes[EPISODE].astype(str))
            return BuiltinColumn("classes", ids, None, tuple(_item_cells(run, name.removeprefix(ITEM))))
        if name == OUTCOME and OUTCOME in outcome_column(run):
            outcomes = tuple(run.episodes["outcome"].astype(str))
            return BuiltinColumn("binary", tuple(run.episodes[EPISODE].astype(str)), None, outcomes)
        if (cells := fact_columns(run).get(name)) is not None:
            return BuiltinColumn(None, tuple(run.episodes[EPISODE].astype(str)), None, tuple(cells))
        if name.startswith((RECORDED, PLAYED)):
            return self._of_source(name)
        raise UsageError(f"there is no built-in column {name!r}; there are: {', '.join(builtin_names())}")

    @cached_property
    def _recorded(self) -> dict[str, Callable[[], NDArray[np.float64]]]:
        return recorded_columns(self._run)

    @cached_property
    def _sim(self) -> dict[str, tuple[Cell, ...]]:
        return _sim_columns(self._run)

    def _of_source(self, name: str) -> BuiltinColumn:
        """Return a column of data set or environment for every shown frame, such as `dataset.state.x`.

        An environment's column is called `env.held`, for example.

        Raises:
            UsageError: For a column that the run lacks, and for facts of an environment of which no value was
                captured.
        """
        run, columns = self._run, self._recorded
        prefix = prefix_of(run)
        column = name.removeprefix(prefix)
        if not name.startswith(prefix) or column not in columns:
            source = "recordings" if name.startswith(RECORDED) else "an environment of your own"
            available = (
                ", ".join([*(prefix + known_column for known_column in columns), *fact_columns(run)])
                or f"none, because the run is not of {source}"
            )
            raise UsageError(f"{run.location} has no column {name}; there are: {available}")
        pairs = list(_inferences(run))
        rows = _rows(run, [episode for episode, _ in pairs])
        calls = [call for _, call in pairs]
        cells = _cells(run, column, columns[column]()[rows, calls])
        if run.in_own_environment and not any(calls) and all(cell is None for cell in cells):
            raise UsageError(
                f"{name} has no value, because facts come with a step and only first inferences were captured. "
                "Return a `Step` with facts from `reset`, or extract with --captured-calls all, and with a "
                "smaller --execute where an episode ends within one chunk"
            )
        episodes, inferences = zip(*pairs, strict=True)
        return BuiltinColumn(None, episodes, inferences, cells)


def _cells(run: RunReader, name: str, values: NDArray[np.float64]) -> tuple[Cell, ...]:
    """Return the values (n,) of a column of a run's own source.

    They are numbers, or truth values or texts where the source says so.
    """
    assert run.inputs is not None, "a run with such columns stores inputs"
    return tuple(run.inputs.cell(name, float(value)) for value in values)


def prefix_of(run: RunReader) -> str:
    """Return the prefix of the columns of a run's own source."""
    return PLAYED if run.in_own_environment else RECORDED


def outcome_column(run: RunReader) -> dict[str, list[str]]:
    """Return the column `env.outcome`, a text per episode; empty for a run in which all episodes end alike."""
    if not (run.in_own_environment or fact_columns(run)) or run.episodes["outcome"].nunique() < 2:
        return {}
    return {OUTCOME: run.episodes["outcome"].astype(str).tolist()}


def fact_columns(run: RunReader) -> dict[str, list[Cell]]:
    """Return what clients of a policy server said at the end of episodes, by name; None where one said nothing."""
    if run.in_own_environment:  # its facts come with every step
        return {}
    names = [str(name) for name in run.episodes.columns if str(name).startswith(PLAYED)]
    return {name: [None if cell != cell else cell for cell in run.episodes[name].tolist()] for name in names}


def recorded_columns(run: RunReader) -> dict[str, Callable[[], NDArray[np.float64]]]:
    """Return the functions that read the columns of data set or environment, by name; none for a run of scenes.

    Each returns (E, C) values, of every shown frame; columns of one kind of input read it once.
    """
    inputs = run.inputs
    if inputs is None:
        return {}
    read = cache(inputs.read)

    def now(kind: str, number: int) -> NDArray[np.float64]:
        values = read(kind) if kind == "state" else read(kind)[:, :, 0]
        return values[..., number].astype(np.float64)

    columns: dict[str, Callable[[], NDArray[np.float64]]] = {
        name: partial(inputs.column, name) for name in inputs.columns
    }
    for kind, names in inputs.names.items():
        if kind in inputs.kinds:
            columns |= {f"{kind}.{name}": partial(now, kind, number) for number, name in enumerate(names)}
    if run.recorded and why_not_compared(run) is None:
        columns[ACTION_ERROR] = lambda: compare_actions(run).of_frames[0]
    return columns


def is_builtin(name: str) -> bool:
    """Whether a name is that of a built-in column by its prefix; a run may still lack the column."""
    return name.startswith((SIM, ITEM, RECORDED, PLAYED))


def builtin_names() -> list[str]:
    """Return the names of all `sim.*` and `item.*` columns."""
    return [*(SIM + name for name in SIM_COLUMNS), *(ITEM + name for name in ITEM_COLUMNS)]


def label_frame(run: RunReader) -> "pd.DataFrame":
    """Return the keys and built-in columns of a run, to which columns can be added.

    There is a row per episode and captured inference. Besides the keys `episode_id` and `inference` there are
    `control_step`, `group_id`, `category` and the built-in columns that the run has. A run without trajectories or
    control steps has no `sim.*`, see `why_no_sim`. Recordings have `source_episode`, `frame`, `instruction` and
    the columns `dataset.*` instead. Pictures have the file as `picture` too, and an environment of one's own has
    `instruction` and `env.*`.
    """
    import pandas as pd

    ids, inferences = zip(*_inferences(run), strict=True)
    rows = _rows(run, ids)
    table: dict[str, Sequence[Any]] = {EPISODE: ids, INFERENCE: inferences}
    sim: dict[str, Any] = {}
    if why_no_sim(run) is None:
        sim = {SIM + name: cells for name, cells in _sim_columns(run).items()}
        table["control_step"] = run.control_steps[rows, list(inferences)].astype(int).tolist()
    if run.recorded:
        steps = run.control_steps
        table["source_episode"] = run.episodes["source_episode"].iloc[rows].tolist()
        table["frame"] = steps[rows, list(inferences)].tolist()
    if run.in_own_environment:
        table["control_step"] = run.control_steps[rows, list(inferences)].tolist()
    if run.inputs is not None:
        for name in ("picture", "instruction"):
            if name in run.episodes:
                table[name] = run.episodes[name].iloc[rows].tolist()
        sim = {
            prefix_of(run) + name: list(_cells(run, name, read()[rows, list(inferences)]))
            for name, read in recorded_columns(run).items()
        }
        of_episodes: dict[str, Sequence[Cell]] = {**outcome_column(run), **fact_columns(run)}
        sim |= {name: [cells[row] for row in rows] for name, cells in of_episodes.items()}
    for name in ("group_id", "category"):
        table[name] = run.episodes[name].iloc[rows].tolist()
    table |= sim
    for name in ITEM_COLUMNS if run.inputs is None else ():
        if set(_needed_columns(name)) <= set(run.episodes):
            cells = list(_item_cells(run, name))
            table[ITEM + name] = [cells[row] for row in rows]
    return pd.DataFrame(table)


def why_no_sim(run: RunReader) -> str | None:
    """Return why a run has no `sim.*` columns; None if it has them."""
    try:
        next(frames_of_inferences(run), None)
    except UsageError as error:
        return str(error)
    return None


def _rows(run: RunReader, ids: Sequence[str]) -> NDArray[np.intp]:
    row_of = {name: row for row, name in enumerate(run.episodes[EPISODE].astype(str))}
    return np.array([row_of[name] for name in ids], np.intp)


def _inferences(run: RunReader) -> Iterator[tuple[str, int]]:
    """Yield episode and number of every captured inference, in the order of the episodes."""
    counts = reached_calls(run).sum(axis=1).tolist()
    for name, count in zip(run.episodes[EPISODE].astype(str), counts, strict=True):
        yield from ((name, call) for call in range(count))


def frames_of_inferences(run: RunReader) -> Iterator[tuple[Any, int, list[int]]]:
    """Yield trajectory, row and frames of the captured inferences of every episode.

    The frame of an inference is its control step: the state after so many actions.

    Raises:
        UsageError: For a run that stores no control steps.
        NoTrajectoryError: For a run without trajectories.
    """
    if not hasattr(run, "trajectories") or not hasattr(run, "control_steps"):
        raise UsageError(f"{run.location} has no trajectories; `sim.*` and the state need them")
    trajectories, steps, reached = run.trajectories, run.control_steps, reached_calls(run)
    for row, trajectory in enumerate(trajectories):
        yield trajectory, row, steps[row, np.flatnonzero(reached[row])].astype(int).tolist()


def _sim_columns(run: RunReader) -> dict[str, tuple[Cell, ...]]:
    """Return the cells of all `sim.*` columns for every captured inference; the names have no prefix."""
    rows: list[list[Cell]] = []
    for trajectory, row, frames in frames_of_inferences(run):
        side = str(run.episodes["side_correct"].iloc[row])
        instants = [Instant(trajectory, side, frame) for frame in frames]
        rows += [[_finite(value(at)) for _, value in SIM_COLUMNS.values()] for at in instants]
    return {name: tuple(cells[number] for cells in rows) for number, name in enumerate(SIM_COLUMNS)}


def _finite(value: Cell) -> Cell:
    """Return a cell that is a number or nothing: a broken simulation leaves NaN."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _needed_columns(name: str) -> tuple[str, ...]:
    """Return the columns of the episodes that an `item.*` column is made of."""
    if name == "category":
        return ("category",)
    return "target_concept", "distractor_concept", "side_correct"


def _item_cells(run: RunReader, name: str) -> Iterator[Cell]:
    if lacking := [column for column in _needed_columns(name) if column not in run.episodes]:
        raise UsageError(f"the episodes of {run.location} lack the column {lacking[0]!r} of {ITEM}{name}")
    for row in run.episodes[list(_needed_columns(name))].astype(str).to_dict("records"):
        if name == "category":
            yield row["category"]
            continue
        correct, wrong, side = (row[column] for column in _needed_columns(name))
        left_concept = correct if side == "left" else wrong
        pair = " / ".join(sorted((correct, wrong)))
        yield {"named": correct, "other": wrong, "left": left_concept, "pair": pair}[name]
