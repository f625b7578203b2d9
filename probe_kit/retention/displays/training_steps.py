"""Success, retention and drift against the training step, a line per category."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from probe_kit._tables.table import Table
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.displays.base.style import caption, legend_above, panels, plain, series
from probe_kit.retention.rows.row import MEAN
from probe_kit.statistics.crossfit import CHANCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = (
    ("sr", "success (%)", 100.0, 100 * CHANCE),
    ("backbone", "backbone (%)", 100.0, 100 * CHANCE),
    ("retention", "retention", 1.0, None),
    ("drift", "drift of the backbone (points)", 100.0, 0.0),
)
"""Number, label, its factor, and where a dashed line stands."""
_SIDESTEP = 0.02
"""Of the range of steps: how far categories stand apart."""


def training_step_figure(table: Table, lines: Sequence[ProvenanceLine]) -> ReportFigure:
    """Return the figure of a table of training steps. Nothing is drawn yet. lines: of the runs, below it."""
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
    legend_above(figure, grid[0].get_legend_handles_labels()[0])
    caption(figure, *lines)
    return figure


def _draw_line(
    axes: "Axes", rows: Sequence[Mapping[str, Any]], key: str, factor: float, at: int, shift: float
) -> None:
    look = series(at)
    values = [float("nan") if row[key] is None else factor * row[key] for row in rows]
    steps = [row["step"] + shift for row in rows]
    for step, row, value in zip(steps, rows, values, strict=True):
        low, high = row[f"{key}_ci"] or (None, None)
        if low is not None and high is not None and value == value:
            axes.plot([step, step], [factor * low, factor * high], color=look.colour, lw=0.8, alpha=0.6)
    axes.plot(
        steps, values, color=look.colour, ls=look.dash, marker=look.marker, ms=4.5, lw=1.3,
        label=title_of(rows[0]["category"]),
    )  # fmt: skip
