"""Paired layouts: how many items are right in both, one or none of their two layouts."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

from probe_kit.retention.behaviour import PairedItems, capture_only, paired_items
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure, figure_of
from probe_kit.retention.displays.base.style import GREEN, SKY, VERMILION, axes_for, caption, legend_above, plain
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Name, colour, hatch: distinct without colour too.
_PARTS = (
    ("right in both layouts", GREEN, ""),
    ("right in one", SKY, "\\\\\\"),
    ("wrong picture in both", VERMILION, "///"),
    ("none right, otherwise", "#D9D9D9", ""),
)


@dataclass
class PairedLayoutsDisplay(Display):
    """Items by outcome of their two layouts, per category.

    Knowledge puts items into "right in both"; a preference for a side puts them into "right in one", whatever its
    strength. The p beside a bar is the exact test of right twice against wrong twice.
    """

    items: dict[str, PairedItems]
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_run(cls, run: RunReader) -> Self:
        """Read the episodes of a run; items that ran in one layout are left out."""
        by_category = run.episodes.groupby("category", sort=False)
        items = {str(category): paired_items(episodes) for category, episodes in by_category}
        return cls(items, ProvenanceLine.of_run(run))

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 0.33 * len(self.items) + 1.35)
        for row, paired in enumerate(self.items.values()):
            _draw_bar(axes, row, paired)
        axes.set_yticks(range(len(self.items)), [title_of(name) for name in self.items])
        axes.set_ylim(len(self.items) - 0.4, -0.6)
        axes.set_xlim(0, 100)
        axes.set_xlabel("items (%)", fontsize=9)
        plain(axes)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        if figure is not None:
            legend_above(figure, axes.get_legend_handles_labels()[0])
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def _draw_bar(axes: "Axes", row: int, paired: PairedItems) -> None:
    counts = (paired.both, paired.one, paired.both_wrong, paired.none - paired.both_wrong)
    total = sum(counts)
    start = 0.0
    for (label, colour, hatch), count in zip(_PARTS, counts, strict=True):
        width = 100 * count / max(1, total)
        axes.barh(
            row, width, left=start, height=0.72, color=colour, hatch=hatch, edgecolor="white", lw=0.8,
            label=label if row == 0 else None,
        )  # fmt: skip
        if width >= 5:
            box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85} if hatch else None
            ink = "white" if colour == GREEN else "black"
            axes.text(
                start + width / 2, row, str(count), ha="center", va="center", fontsize=8, color=ink, bbox=box
            )
        start += width
    weight = "bold" if paired.p < SIGNIFICANCE else "normal"
    axes.text(101, row, f"p {_p(paired.p)}  n {total}", va="center", fontsize=7.5, weight=weight)


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"= {value:.3f}"


PLACE = 7
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        run = drawn.judged(source.table)
        if run is not None and not capture_only(run.episodes):
            yield ReportFigure(
                f"{drawn.stem}-paired-layouts", "The same question, pictures swapped", "behaviour",
                "Every question is asked twice, with the two images swapped. Knowing the answer means right "
                "both times; always choosing one side means right once. Bold p: more items are right twice than "
                "wrong twice, beyond luck.",
                drawn.position, partial(_drawn, run), is_detail=True,
            )  # fmt: skip


def _drawn(run: RunReader) -> "Figure":
    return figure_of(PairedLayoutsDisplay.from_run(run))
