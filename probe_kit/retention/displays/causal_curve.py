"""Readable, passes, read: by depth, where a probe reads the answer and where changing it turns the action."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.passing import Passing, stored_passing
from probe_kit.retention.displays.certificate import Certificate
from probe_kit.retention.displays.selection import curve_of, scores_of
from probe_kit.retention.displays.showing import Shown
from probe_kit.retention.displays.style import (
    axes_for,
    caption,
    layer_axis,
    legend_above,
    panels,
    plain,
    series,
    spell,
)
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Points:
    """One line: percent by layer, and which points are significant, family-wise."""

    layers: NDArray[np.int64]
    percent: NDArray[np.float64]
    significant: NDArray[np.bool_]


@dataclass
class CausalCurveDisplay(Shown):
    """By backbone layer: held-out accuracy of probes, and how many episodes turn when its tokens are exchanged.

    readable: accuracy in percent. passes: by role, share of episodes in percent whose action turns to the side of
    the exchanged pictures, minus those that turn from it. read: the same for the keys and values that the acting
    part reads of each block; None where nobody looked. Filled: significant, family-wise.
    """

    category: str
    chance: float
    readable: Points
    passes: dict[str, Points]
    read: Points | None
    certificate: Certificate
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_run(cls, run: RunReader, results: ProbeResults, category: str, view: str = "mean") -> Self:
        """From the stored interchange and probes of a run.

        Raises NoInterventionsError if none is stored of the category, UnknownCategoryError, UnknownSiteError.
        """
        rows = [row for row in stored_passing(run).get(category, []) if not row.direction]
        if not rows:
            raise NoInterventionsError(
                f"{run.location} has no stored interchange of {category!r}. Run `probe-kit intervene "
                f"{run.location} --kind interchange`"
            )
        scores = scores_of(results, category, view)
        scores = scores[scores["stream"] == "backbone"].sort_values("layer")
        streams = {row.place.partition(".")[0] for row in rows}
        roles = dict.fromkeys(row.role for row in rows if row.place.startswith("backbone."))
        return cls(
            category=category,
            chance=curve_of(results, category, view).chance,
            readable=Points(
                scores["layer"].to_numpy(int), 100 * scores["accuracy"].to_numpy(float),
                (scores["p_fwe"] < SIGNIFICANCE).to_numpy(bool),
            ),
            passes={role: _points([row for row in rows if row.role == role], "backbone") for role in roles},
            read=_points([row for row in rows if row.role == "all"], "memory") if "memory" in streams else None,
            certificate=Certificate.of_results(results, view),
        )  # fmt: skip

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(100 * self.chance, color="0.45", lw=1, ls=(0, (1, 1)), label="chance of probes")
        lines = {
            "readable (probe)": self.readable,
            **{f"passes: {role}": own for role, own in self.passes.items()},
        }
        if self.read is not None:
            lines["read (keys and values)"] = self.read
        for position, (label, points) in enumerate(lines.items()):
            _draw(axes, points, label, position)
        plain(axes)
        layer_axis(axes, int(self.readable.layers.max()) + 1)
        axes.set_ylim(-12, 108)
        axes.set_title(spell(self.category), fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel("% of episodes", fontsize=9)
            legend_above(figure, axes.get_legend_handles_labels()[0])
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def causal_curve(run: RunReader, results: ProbeResults, view: str = "mean") -> "Figure":
    """A panel per category of which an interchange is stored. Raises NoInterventionsError if there is none."""
    categories = [name for name in results.settings.categories if name in stored_passing(run)]
    displays = [CausalCurveDisplay.from_run(run, results, name, view) for name in categories or ["any"]]
    figure, grid = panels(len(displays))
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    figure.supylabel("% of episodes", fontsize=9)
    caption(figure, displays[0].certificate)
    legend_above(figure, grid[0].get_legend_handles_labels()[0])
    return figure


def _points(rows: Sequence[Passing], stream: str) -> Points:
    own = [row for row in rows if row.place.startswith(f"{stream}.") and "@" not in row.place]
    own = sorted(own, key=lambda row: _layer(row))
    return Points(
        np.array([_layer(row) for row in own], np.int64),
        np.array([100 * row.net for row in own]),
        np.array([row.p_fwe is not None and row.p_fwe < SIGNIFICANCE for row in own], bool),
    )


def _layer(row: Passing) -> int:
    return int(row.place.partition(".")[2])


def _draw(axes: "Axes", points: Points, label: str, position: int) -> None:
    line, sidestep = series(position), 0.05 * (position - 2)
    x = points.layers + sidestep
    axes.plot(x, points.percent, color=line.colour, ls=line.dash, lw=1.6, label=label)
    for filled in (True, False):
        chosen = points.significant == filled
        axes.plot(
            x[chosen], points.percent[chosen], ls="none", marker=line.marker, ms=5, mec=line.colour,
            mfc=line.colour if filled else "white",
        )  # fmt: skip
