"""Retention, success and drift of several checkpoints of one training, against the training step."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit._system.counting import plural
from probe_kit._system.table_cells import is_count
from probe_kit._tables.numbers import number, percent, points
from probe_kit._tables.table import Cell, Heading, Table, absent
from probe_kit.errors import UsageError
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.compare.models import checkpoint_of, split_checkpoint
from probe_kit.retention.displays.display import (
    ProvenanceLine,
    caption,
    draw_intervals,
    legend_above,
    legend_handles,
    panels,
    plain,
    series,
)
from probe_kit.retention.displays.report_figure import ReportFigure
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.crossfit import CHANCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_COLUMNS = {
    "category": "",
    "step": "step: of the training",
    "success %": "success: the cube ends on the correct picture",
    "backbone %": "backbone: accuracy of probes in the backbone",
    "action %": "action: the same for the layers that produce the action",
    "retention": "retention: share of the backbone's accuracy above chance that is left in the action",
    "drift of the backbone, points": "drift: the backbone's accuracy minus that of the first step, paired by "
    "items where both ran the same",
}
"""The entry of each column in the legend."""


def training_step(run: RunReader) -> int:
    """Return the training step of the run's checkpoint, from the last folder of its path.

    Args:
        run: A run of a policy from a checkpoint.

    Raises:
        UsageError: For a run whose checkpoint is unknown or names no step.
    """
    checkpoint = checkpoint_of(run)
    if (training := split_checkpoint(checkpoint)) is not None:
        return training[1]
    raise UsageError(
        f"the training step of {run.location} is unknown: its checkpoint is {checkpoint or 'not stored'!r}; "
        "expected a folder such as checkpoints/020000 or checkpoint-500. Give the steps in the order of the runs, "
        "such as --steps 1000,2000"
    )


def read_steps(texts: Sequence[str] | None, runs: Sequence[RunReader]) -> dict[str, int]:
    """Return the training step of every run by its location.

    Args:
        texts: Steps in the order of the runs; None reads them from the folders.
        runs: Runs of policies.

    Raises:
        UsageError: For a text that is no count, a number of steps that is not that of the runs, runs of one step,
            or VLM runs, which have no retention.
    """
    if vlms := [str(run.location) for run in runs if run.ask is not None]:
        raise UsageError(f"--kind steps is for policy runs; {vlms[0]} is a VLM run. Leave it out")
    if texts is None:
        steps = [training_step(run) for run in runs]
    else:
        if not all(map(is_count, texts)):
            raise UsageError(
                f"--steps {','.join(texts)}; expected a training step per run, such as --steps 1000,2000"
            )
        steps = list(map(int, texts))
    if len(steps) != len(runs):
        raise UsageError(
            f"--steps has {plural(len(steps), 'step')} for {plural(len(runs), 'run')}; give one per run, in order"
        )
    if len(runs) < 2 or len(set(steps)) < len(steps):
        raise UsageError(
            "--kind steps needs several runs of different training steps; these are of "
            f"{', '.join(map(str, steps))}"
        )
    return {str(run.location): step for run, step in zip(runs, steps, strict=True)}


def step_table(table: RetentionTable, steps: Mapping[str, int]) -> Table:
    """Return success, backbone, action, retention and drift by category and training step.

    Keys of a row's numbers are `category`, `step`, `run`, `view`, `sr`, `backbone`, `action`, `retention`, `drift`
    (of the backbone) and, for each of them, its limits under the name with `_ci`.

    Args:
        table: A table of runs in the order of their steps, the first of which all others are compared with.
        steps: Steps by the location of a run.
    """
    first: dict[str, str | None] = {}  # the first view of each run, which its rows are of
    rows = [row for row in table.all_rows if first.setdefault(row.run.location, row.view) == row.view]
    drifts = {(gap.run, gap.category): gap for gap in table.differences if gap.view in (*first.values(), None)}
    names = sorted(dict.fromkeys(row.category for row in rows), key=lambda name: name == MEAN)
    ordered = sorted(rows, key=lambda row: (names.index(row.category), steps[row.run.location]))
    numbers = [_numbers(row, steps, drifts) for row in ordered]
    means = [row for row in ordered if row.category == MEAN]
    views = {steps[row.run.location]: row.view for row in means if row.view is not None}
    headings = [Heading(name, term=term) for name, term in _COLUMNS.items()]
    cells = [_cells(row) for row in numbers]
    steps_table = Table.of(
        "Training steps", headings, cells, names=2, numbers=tuple(numbers), mean=title_of(MEAN)
    ).filled("n/a")
    remarks = [
        "each with its 95 % interval",
        _by_step("view", {step: str(view) for step, view in views.items()}),
        _by_step(
            "mean over", {steps[row.run.location]: ", ".join(map(title_of, row.categories)) for row in means}
        ),
    ]
    return steps_table.with_remarks(remarks)


def _by_step(name: str, values: Mapping[int, str]) -> str:
    """Return `name` with the value that all steps share, or with the value of each step."""
    if len(set(values.values())) > 1:
        each = ", ".join(f"{value} (step {step})" for step, value in values.items())
        return f"{name} {each}"
    return f"{name} {next(iter(values.values()))}" if values else ""


def _numbers(
    row: RetentionRow, steps: Mapping[str, int], drifts: Mapping[tuple[str | None, str], Any]
) -> dict[str, Any]:
    drift = drifts.get((row.run.location, row.category))
    defined = row.retention.defined
    return {
        "category": row.category,
        "step": steps[row.run.location],
        "run": row.run.location,
        "view": row.view,
        "sr": row.success.sr,
        "sr_ci": row.success.ci,
        "backbone": row.backbone.score,
        "backbone_ci": row.backbone.ci,
        "action": row.action.score,
        "action_ci": row.action.ci,
        "retention": row.retention.value if defined else None,
        "retention_ci": row.retention.ci if defined else None,
        "drift": None if drift is None else drift.backbone,
        "drift_ci": None if drift is None else drift.backbone_ci,
    }


def _cells(row: Mapping[str, Any]) -> tuple[Cell | str, ...]:
    shares = (Cell(row[name], percent, row[f"{name}_ci"]) for name in ("sr", "backbone", "action"))
    ratio = Cell(row["retention"], number, row["retention_ci"])
    lacks = row["retention"] is None and row["backbone"] is not None and row["action"] is not None
    drift = Cell(row["drift"], points, row["drift_ci"])
    return (title_of(row["category"]), str(row["step"]), *shares, absent("n/a") if lacks else ratio, drift)


_PANELS = (
    ("sr", "success (%)", 100.0, 100 * CHANCE),
    ("backbone", "backbone (%)", 100.0, 100 * CHANCE),
    ("retention", "retention", 1.0, None),
    ("drift", "drift of the backbone (points)", 100.0, 0.0),
)
"""The number of each panel, its label, its factor, and the height of its dashed line."""
_SIDESTEP = 0.02
"""Share of the range of steps by which categories are drawn apart."""


def training_step_figure(table: Table, lines: Sequence[ProvenanceLine]) -> ReportFigure:
    """Return the figure of a table of training steps. Nothing is drawn yet.

    Args:
        table: Result of `step_table`.
        lines: Origin of the runs, written below the figure.
    """
    return ReportFigure(
        "training-steps", "Training steps", "retention",
        "What a training does to success, to the answer in the backbone, and to the share of it that reaches the "
        "action. A point per checkpoint and category, with its 95 % interval. Drift is against the first step.",
        None, partial(draw_training_steps, table, lines),
    )  # fmt: skip


def draw_training_steps(table: Table, lines: Sequence[ProvenanceLine]) -> "Figure":
    """Return a figure with a panel per number and a line per category; a number without a value has a gap."""
    names = [name for name in dict.fromkeys(numbers["category"] for numbers in table.numbers) if name != MEAN]
    with_numbers = [panel for panel in _PANELS if any(numbers[panel[0]] is not None for numbers in table.numbers)]
    figure, grid = panels(len(with_numbers), width=3.6, height=2.5, columns=2, share=False)
    steps = {numbers["step"] for numbers in table.numbers}
    # Categories stand side by side, so that their intervals do not hide each other.
    apart = _SIDESTEP * (max(steps) - min(steps))
    shifts = [apart * (at - (len(names) - 1) / 2) for at in range(len(names))]
    for (key, label, factor, line), axes in zip(with_numbers, grid, strict=True):
        if axes is not grid[0]:
            axes.sharex(grid[0])
        if line is not None:
            axes.axhline(line, color="0.45", lw=0.8, ls="--", zorder=0)
        for at, (name, shift) in enumerate(zip(names, shifts, strict=True)):
            _draw_line(
                axes, [numbers for numbers in table.numbers if numbers["category"] == name], key, factor, at, shift
            )
        plain(axes)
        axes.set_xlabel("training step", fontsize=8.5)
        axes.set_ylabel(label, fontsize=8.5)
    legend_above(figure, list(legend_handles(*grid).values()))
    caption(figure, *lines)
    return figure


def _draw_line(
    axes: "Axes", rows: Sequence[Mapping[str, Any]], key: str, factor: float, at: int, shift: float
) -> None:
    look = series(at)
    values = [float("nan") if row[key] is None else factor * row[key] for row in rows]
    steps = [row["step"] + shift for row in rows]
    limits = [row[f"{key}_ci"] or (None, None) for row in rows]
    ends = factor * np.array(limits, dtype=float).T
    draw_intervals(axes, steps, values, look.colour, ends)
    axes.plot(
        steps, values, color=look.colour, ls=look.dash, marker=look.marker, ms=4.5, lw=1.3,
        label=title_of(rows[0]["category"]),
    )  # fmt: skip
