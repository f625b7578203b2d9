"""Readable, passes, read: by depth, where a probe reads the answer and where changing it turns the action."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoInterventionsError
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.kinds.interchange import BACKBONE, PatchEffect, stored_site_effects
from probe_kit.intervene.places import ALL, PlaceName
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.panels import Panelled, draw_series, in_panels
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure
from probe_kit.retention.displays.base.selection import scores_of
from probe_kit.retention.displays.base.style import layer_axis, series
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.results.probe_results import ProbeResults

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
class SiteEffectDisplay(Panelled):
    """Curves by backbone layer: held-out accuracy of probes, and the episodes that turn when tokens are exchanged.

    readable: accuracy in percent. passes: by role, share of episodes in percent whose action turns to the side of
    the swapped images, minus those that turn from it. read: the same for the keys and values that the acting
    part reads of each block; None where it was not tested. Filled: significant, family-wise.
    """

    measure = "% of episodes"
    category: str
    chance: float
    readable: Points
    passes: dict[str, Points]
    read: Points | None
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_run(cls, run: RunReader, results: ProbeResults, category: str, view: str = "mean") -> Self:
        """Read the stored interchange and probes of a run.

        Raises NoInterventionsError if none is stored of the category, UnknownCategoryError, UnknownSiteError.
        """
        return cls._of(run, results, category, view, shown_passing(run).get(category, []))

    @classmethod
    def _of(
        cls, run: RunReader, results: ProbeResults, category: str, view: str, rows: Sequence[PatchEffect]
    ) -> Self:
        if not rows:
            raise NoInterventionsError(
                f"{run.location} has no stored interchange of {category!r} in a layer of the backbone or of the "
                f"keys and values. Run `probe-kit intervene {run.location} --kind interchange`"
            )
        scores = scores_of(results, category, view)
        scores = scores[scores["stream"] == BACKBONE].sort_values("layer")
        by_role: dict[str, list[PatchEffect]] = {}
        for row in rows:
            if _stream(row) == BACKBONE:
                by_role.setdefault(row.role, []).append(row)
        read = [row for row in rows if _stream(row) == KV_STREAM]
        return cls(
            category=category,
            chance=CHANCE,
            readable=Points(
                scores["layer"].to_numpy(int), 100 * scores["accuracy"].to_numpy(float),
                (scores["p_fwe"] < SIGNIFICANCE).to_numpy(bool),
            ),
            passes={role: _points(of_role) for role, of_role in by_role.items()},
            read=_points(read) if read else None,
            certificate=ProvenanceLine.of_results(results, view),
        )  # fmt: skip

    @property
    def title(self) -> str:
        """The category."""
        return title_of(self.category)

    def draw(self, axes: "Axes") -> None:
        """A line for probes, one for every role, one for `kv`."""
        axes.axhline(100 * self.chance, color="0.45", lw=1, ls=(0, (1, 1)), label="chance of probes")
        lines = {
            "readable (probe)": self.readable,
            **{f"passes: {role}": passing for role, passing in self.passes.items()},
        }
        if self.read is not None:
            lines["read (keys and values)"] = self.read
        for position, (label, points) in enumerate(lines.items()):
            x = points.layers.astype(np.float64) + 0.05 * (position - 2)
            draw_series(axes, series(position), x, points.percent, points.significant, label)
        layer_axis(axes, int(self.readable.layers.max()) + 1)
        axes.set_ylim(-12, 108)


def shown_passing(run: RunReader) -> dict[str, list[PatchEffect]]:
    """Return by category what a figure by layers shows: the backbone at every role, `kv` as a whole.

    Categories of which nothing of the two is stored are not there. Raises RunDamagedError.
    """
    by_category = {
        category: [
            row
            for row in rows
            if PlaceName.parse(row.place).is_whole_layer
            and (_stream(row) == BACKBONE or (_stream(row) == KV_STREAM and row.role == ALL))
        ]
        for category, rows in stored_site_effects(run).items()
    }
    return {category: rows for category, rows in by_category.items() if rows}


def site_effect_curve(run: RunReader, results: ProbeResults, view: str = "mean") -> "Figure":
    """A panel per category of which an interchange is stored. Raises NoInterventionsError if there is none."""
    passing = shown_passing(run)
    names = [name for name in results.settings.categories if name in passing] or ["any"]
    return in_panels([SiteEffectDisplay._of(run, results, name, view, passing.get(name, [])) for name in names])


def _points(rows: Sequence[PatchEffect]) -> Points:
    return Points(
        np.array([_layer(row) for row in rows], np.int64),
        np.array([100 * row.net for row in rows]),
        np.array([row.p_fwe is not None and row.p_fwe < SIGNIFICANCE for row in rows], bool),
    )


def _stream(row: PatchEffect) -> str:
    return PlaceName.parse(row.place).stream


def _layer(row: PatchEffect) -> int:
    return PlaceName.parse(row.place).layer


PLACE = 13
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        if drawn.results is None or not set(shown_passing(drawn.run)) & set(drawn.results.settings.categories):
            continue
        yield ReportFigure(
            f"{drawn.stem}-causes", "Readable and used", "interventions",
            "Where a probe reads the answer, and how many episodes turn to the other side when the tokens of one "
            "layer are taken from the same inference with swapped images. A layer that is readable and "
            "turns nothing is read by nothing behind it.",
            drawn.position, partial(site_effect_curve, drawn.run, drawn.results, drawn.results.settings.views[0]),
        )  # fmt: skip
