"""Predicted actions compared with the recorded ones, at every shown frame of a run on recordings."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit._tables.numbers import number
from probe_kit._tables.table import Cell, Table
from probe_kit.errors import UsageError
from probe_kit.runs.layout import DATASET, OTHER_ACTIONS
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ActionErrors:
    """Predicted minus recorded actions, in the units of the data set.

    Attributes:
        run: A run on recordings.
        names: (D,) names of the numbers of an action.
        errors: (E, C, S, D) by row, inference and step of the chunk, NaN where nothing was recorded.
        deviations: (D,) standard deviations of the recorded actions at the shown frames. In these deviations, the
            mean recorded action has an error of 1.
    """

    run: RunReader
    names: tuple[str, ...]
    errors: Matrix
    deviations: Matrix

    @property
    def by_number(self) -> "pd.DataFrame":
        """A line per number of an action: `number`, `deviation`, `bias`, `first` and `chunk`.

        The column `bias` is the mean error of the first action. The columns `first` and `chunk` are the root mean
        square errors of the first action and of the whole chunk. All three are in recorded deviations, NaN for a
        number that never changes.
        """
        import pandas as pd

        scaled = self._scaled
        return pd.DataFrame(
            {
                "number": self.names,
                "deviation": self.deviations,
                "bias": _mean(scaled[:, :, 0], (0, 1)),
                "first": np.sqrt(_mean(scaled[:, :, 0] ** 2, (0, 1))),
                "chunk": np.sqrt(_mean(scaled**2, (0, 1, 2))),
            }
        )

    @property
    def by_frame(self) -> "pd.DataFrame":
        """A line per shown frame: keys, and root mean squares `first` and `chunk` over the numbers that change."""
        import pandas as pd

        rows, calls = np.nonzero(self._has_recorded_action)
        steps = self.run.control_steps
        first, chunk = self.of_frames
        return pd.DataFrame(
            {
                "episode_id": self.run.episodes["episode_id"].to_numpy()[rows],
                "source_episode": self.run.episodes["source_episode"].to_numpy()[rows],
                "frame": steps[rows, calls],
                "first": first[rows, calls],
                "chunk": chunk[rows, calls],
            }
        )

    @property
    def by_episode(self) -> "pd.DataFrame":
        """A line per recorded episode: `source_episode`, `frames`, and root mean squares `first` and `chunk`."""
        import pandas as pd

        frames = self.by_frame
        squares = frames.assign(first=frames["first"] ** 2, chunk=frames["chunk"] ** 2)
        groups = squares.groupby("source_episode")
        means = groups[["first", "chunk"]].mean() ** 0.5
        table: pd.DataFrame = means.assign(frames=groups.size()).reset_index()
        return table[["source_episode", "frames", "first", "chunk"]]

    @property
    def of_frames(self) -> tuple[Matrix, Matrix]:
        """The root mean square errors (E, C) of the first action and the whole chunk, in recorded deviations."""
        squares = self._scaled**2
        return np.sqrt(_mean(squares[:, :, 0], 2)), np.sqrt(_mean(squares, (2, 3)))

    @property
    def _scaled(self) -> Matrix:
        """The errors in recorded deviations; numbers that never change are NaN."""
        return np.asarray(self.errors / np.where(self.deviations > 0, self.deviations, np.nan))

    @property
    def _has_recorded_action(self) -> NDArray[np.bool_]:
        """A mask (E, C) of the inferences that have a recorded action."""
        return np.asarray(np.isfinite(self.errors[:, :, 0]).any(axis=2))


def compare_actions(run: RunReader) -> ActionErrors:
    """Compare the predicted actions of a run on recordings with the recorded ones.

    Raises:
        UsageError: For a run of another kind, or where the two are not the same numbers. They differ in count, one
            has changes and the other positions, or values are outside the statistics of the checkpoint.
    """
    if not run.recorded:
        raise UsageError(f"{run.location} has no recorded actions: it is not of recordings")
    inputs, reason = run.inputs, why_not_compared(run)
    if reason is not None:
        raise UsageError(
            f"{run.location}: predicted and recorded actions are not compared: {reason}. `run.inputs.read` gives "
            "both as they are"
        )
    assert inputs is not None, "runs on recordings have inputs"
    recorded, predicted = (inputs.read(kind).astype(np.float64) for kind in ("action", "prediction"))
    first = recorded[:, :, 0]
    constant = np.nanmax(first, axis=(0, 1)) == np.nanmin(first, axis=(0, 1))  # its deviation may not round to 0
    # Zero marks a number that never changes: nothing can be said in units of its spread.
    deviations = np.where(constant, 0.0, np.nanstd(first, axis=(0, 1)))
    return ActionErrors(run, inputs.names["action"], predicted - recorded, deviations)


def action_error_table(errors: ActionErrors) -> Table:
    """Return a line per number of an action; its note says how the episodes differ."""
    episodes, numbers = errors.by_episode, errors.by_number.to_dict("records")
    ordered = episodes.sort_values("first").dropna().to_dict("records")
    span = [f"{row['first']:.2f} in episode {row['source_episode']}" for row in (*ordered[:1], *ordered[-1:])]
    return Table.of(
        f"Predicted against recorded actions, {int(episodes['frames'].sum())} frames",
        ("number", "recorded deviation", "bias", "error, first action", "error, whole chunk"),
        [
            (
                str(row["number"]),
                Cell(row["deviation"], "{:.3g}".format),
                *(
                    Cell("constant") if np.isnan(row[name]) else Cell(row[name], number)
                    for name in ("bias", "first", "chunk")
                ),
            )
            for row in numbers
        ],
        notes=[
            "bias and errors are in recorded deviations; the mean recorded action has 1. First action: "
            f"{' to '.join(span) or 'nothing recorded'}"
        ],
    )


def why_not_compared(run: RunReader) -> str | None:
    """Return why predicted and recorded actions are not the same numbers; None if they are."""
    inputs = run.inputs
    if inputs is None or "action" not in inputs.kinds:
        return "the data set has no actions"
    recorded, predicted = (run.settings[DATASET]["inputs"][kind][-1] for kind in ("action", "prediction"))
    if recorded != predicted:
        return f"the policy predicts {predicted} numbers, the data set has {recorded}"
    reason: str | None = run.settings["recording"].get(OTHER_ACTIONS)
    return reason


def _mean(values: Matrix, axes: int | tuple[int, ...]) -> Matrix:
    """Return the mean of the finite numbers among `values`; NaN, without a warning, where there are none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axes)
    total = np.where(finite, values, 0.0).sum(axis=axes)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))
