"""Answer, probe, success: what becomes of the items of each category, as one bar of shares."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

from probe_kit.retention.columns.text import title_of
from probe_kit.retention.compare.known_used import KnownUsedTable
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure, figure_of
from probe_kit.retention.displays.base.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    axes_for,
    footer,
    legend_above,
    legend_handles,
    plain,
)
from probe_kit.retention.joins import joins_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LOOKS: Mapping[str, tuple[str, str]] = {
    "111": (GREEN, ""),
    "101": ("#7FCEB9", "\\\\\\"),
    "011": (SKY, ""),
    "001": (BLUE, "\\\\\\"),
    "110": (VERMILION, ""),
    "100": (ORANGE, "///"),
    "010": (PURPLE, "///"),
    "000": ("#D9D9D9", ""),
    "1-1": (GREEN, ""),
    "0-1": (SKY, "\\\\\\"),
    "1-0": (VERMILION, "///"),
    "0-0": ("#D9D9D9", ""),
}
"""Colour and hatch by answer, probe and success: items with success first."""
_LEAST = 6.0  # percent of a bar that has room for a number


@dataclass
class KnownUsedDisplay(Display):
    """A bar per category: shares of its items by what is known, encoded and used, in both layouts each.

    counts: items by category and code, such as `101` for answer right, probe not, success (`1-1` without probes).
    title: who was asked and who acted.
    """

    title: str
    counts: Mapping[str, Mapping[str, int]]
    note: str
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_join(cls, joined: KnownUsedTable) -> Self:
        """Read a table of `probe_kit.retention.compare.known_used.match_runs`."""
        probes = f"probes in view {joined.view}" if joined.view else "no probes"
        return cls(
            title=f"{joined.asked} (by {joined.score}) · {joined.acted}",
            counts={row.category: row.counts for row in joined.rows},
            note=f"{joined.asked} · {joined.acted} · items right in both layouts, a coin: 25 % · {probes}",
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 7.2, 0.36 * len(self.counts) + 2.0)
        for height, counts in enumerate(self.counts.values()):
            _draw_bar(axes, height, counts)
        axes.set_yticks(range(len(self.counts)), [title_of(name) for name in self.counts], fontsize=8)
        axes.set_ylim(len(self.counts) - 0.4, -0.6)
        axes.set_xlim(0, 100)
        axes.set_xlabel("items (%)", fontsize=9)
        axes.set_title(self.title, fontsize=9, loc="left")
        plain(axes)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        if figure is not None:
            legend_above(figure, list(legend_handles(axes).values()))
            footer(figure, self.note)
        self.ax_ = axes
        return self


def words_of(code: str) -> str:
    """Return `101` as "answer right, probe not, success"."""
    names = (("answer right", "answer not"), ("probe right", "probe not"), ("success", "no success"))
    parts = zip(names, code, strict=True)
    return ", ".join(right if mark == "1" else wrong for (right, wrong), mark in parts if mark != "-")


def _draw_bar(axes: "Axes", height: int, counts: Mapping[str, int]) -> None:
    total, start = sum(counts.values()), 0.0
    for code, (colour, hatch) in _LOOKS.items():
        if code not in counts:
            continue
        width = 100 * counts[code] / total if total else 0.0
        axes.barh(height, width, 0.72, start, color=colour, hatch=hatch, ec="white", lw=0.5, label=words_of(code))
        if width >= _LEAST:
            ground = {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.85}
            axes.text(
                start + width / 2, height, str(counts[code]), ha="center", va="center", fontsize=8, bbox=ground
            )
        start += width
    axes.text(101, height, f"n {total}", va="center", fontsize=7.5, color=GREY, clip_on=False)


PLACE = 6
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    yield from known_used_figures(joins_of([drawn.run for drawn in source.runs], source.table).tables)


def known_used_figures(joins: Sequence[KnownUsedTable]) -> Iterator[ReportFigure]:
    """A figure per pair of a VLM run and a policy run."""
    for number, joined in enumerate(joins, 1):
        yield ReportFigure(
            f"known-used-{number}", "Answer, probe, success", "join",
            "Every question once: does the VLM answer right, is the probe of the policy right, and does the cube "
            "end right, each in both layouts. An item with both and without success may be lost on the way.",
            None, partial(_known_used, joined),
        )  # fmt: skip


def _known_used(joined: KnownUsedTable) -> "Figure":
    return figure_of(KnownUsedDisplay.from_join(joined))
