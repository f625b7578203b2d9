"""Dose and response: how many episodes turn as more of a direction is added, by side, beside controls."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.kinds.interchange import PatchEffect, stored_steering
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.panels import Panelled, draw_series, in_panels
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure
from probe_kit.retention.displays.base.style import GREY, series
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Percent = NDArray[np.float64]


@dataclass
class DoseResponseDisplay(Panelled):
    """A curve by coefficient: the share of episodes that turn to the target side, minus those that turn from it.

    coefficients: (K,) in half class-mean differences, ascending, 0 among them. net, net_left, net_right: (K,)
    percent, of all episodes and of those that are pushed to either side, one of which may be saturated.
    controls: (C, K) percent of random directions of the same norm, NaN at a coefficient at which none was played.
    relative_change: (K,) how far tokens were moved, in their own norms; beyond two, an effect is little evidence.
    significant: (K,) beyond the controls, family-wise.
    """

    measure = "% of episodes that turn"
    category: str
    position: str
    coefficients: NDArray[np.float64]
    net: Percent
    net_left: Percent
    net_right: Percent
    controls: Percent
    relative_change: NDArray[np.float64]
    significant: NDArray[np.bool_]
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_run(cls, run: RunReader, category: str, position: str | None = None) -> Self:
        """Read the steering that is stored of a category. position: one of several, as `backbone.02 image`.

        Raises NoInterventionsError if there is none.
        """
        by_position = stored_steering(run).get(category, {})
        if not by_position or (position is not None and position not in by_position):
            alternatives = f"; it has it at {', '.join(by_position)}" if by_position else ""
            raise NoInterventionsError(
                f"{run.location} has no stored steering of {category!r}"
                f"{f' at {position}' if position else ''}{alternatives}. "
                f"Run `probe-kit intervene {run.location} --kind steer --sites backbone.NN --roles image`"
            )
        steered_at = position or next(iter(by_position))
        return cls._of(by_position[steered_at], category, steered_at, ProvenanceLine.of_run(run))

    @classmethod
    def _of(cls, rows: Sequence[PatchEffect], category: str, position: str, certificate: ProvenanceLine) -> Self:
        steered = sorted((row for row in rows if not row.is_control), key=lambda row: float(row.coefficient))
        coefficients = np.array([float(row.coefficient) for row in steered])
        names = dict.fromkeys(row.direction for row in rows if row.is_control)
        nets = {(row.direction, float(row.coefficient)): 100 * row.net for row in rows}
        return cls(
            category=category,
            position=position,
            coefficients=coefficients,
            net=np.array([100 * row.net for row in steered]),
            net_left=np.array([100 * row.net_left for row in steered]),
            net_right=np.array([100 * row.net_right for row in steered]),
            controls=np.array(
                [[nets.get((name, coefficient), np.nan) for coefficient in coefficients] for name in names]
            ).reshape(len(names), len(coefficients)),
            relative_change=np.array([row.relative_change for row in steered]),
            significant=np.array([row.p_fwe is not None and row.p_fwe < SIGNIFICANCE for row in steered]),
            certificate=certificate,
        )

    @property
    def title(self) -> str:
        """The category, and where."""
        return "\n".join([title_of(self.category), *self.position.split(", ")])

    def draw(self, axes: "Axes") -> None:
        """A line for all episodes and one for either side, over the band of the controls."""
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        if self.controls.size:
            # Nothing was added at coefficient 0, by a control either.
            played = np.where(self.coefficients == 0, 0.0, self.controls)
            axes.fill_between(
                self.coefficients, played.min(axis=0), played.max(axis=0), color=GREY, alpha=0.35, lw=0,
                label="random directions of the same norm",
            )  # fmt: skip
        lines = {
            "all episodes": self.net,
            "pushed to the left": self.net_left,
            "pushed to the right": self.net_right,
        }
        for position, (label, percent) in enumerate(lines.items()):
            filled = self.significant if position == 0 else np.zeros(self.coefficients.size, bool)
            draw_series(axes, series(position), self.coefficients, percent, filled, label, 3.0 - 0.1 * position)
        ticks = zip(self.coefficients, self.relative_change, strict=True)
        axes.set_xticks(self.coefficients, [f"{coefficient:g}\n{_share(ratio)}" for coefficient, ratio in ticks])
        axes.set_ylim(-108, 108)
        axes.set_xlabel("half class-mean differences\n%: of the tokens' own norm", fontsize=7.5)


def _share(ratio: float) -> str:
    """Return a ratio in percent with one or two digits that count, however small it is."""
    if 0 < ratio < 0.001:
        return "<0.1 %"
    return f"{100 * ratio:.2g} %" if ratio < 1 else f"{100 * ratio:.0f} %"


def dose_response(run: RunReader) -> "Figure":
    """A panel per category and place that was steered. Raises NoInterventionsError if none is stored."""
    displays = [
        DoseResponseDisplay._of(rows, category, position, ProvenanceLine.of_run(run))
        for category, every in stored_steering(run).items()
        for position, rows in every.items()
    ]
    if not displays:
        DoseResponseDisplay.from_run(run, "any")
    return in_panels(displays, height=2.7, share=False)


PLACE = 14
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        if stored_steering(drawn.run):
            yield ReportFigure(
                f"{drawn.stem}-doses", "How much of a direction turns the action", "interventions",
                "Episodes that turn to the side they are pushed to, minus those that turn from it, by how much of "
                "the direction is added; filled: beyond random directions of the same norm (the band). One side "
                "may be saturated, and beyond about two norms of the tokens any direction breaks the hand.",
                drawn.position, partial(dose_response, drawn.run),
            )  # fmt: skip
