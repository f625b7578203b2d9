"""The figures that a display contributes to reports and `--figures`, each with how to read it."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from probe_kit.retention.displays.base.style import SIGNAL
from probe_kit.retention.rows.outcome_rules import can_be_judged, under_rule
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader
from probe_kit.train.choices import EVERYWHERE
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ONLY_FILLED = f"Only filled markers are evidence: {SIGNAL}"
DOTS = f"Dots mark evidence: {SIGNAL}"


@dataclass(frozen=True)
class DrawnRun:
    """A run of a table, of labels each with one. stem: beginning of its files' names. name: in legends.

    position: among the runs. results: its probes, None without any.
    """

    run: RunReader
    stem: str
    name: str
    position: int
    results: ProbeResults | None

    def judged(self, table: RetentionTable) -> RunReader | None:
        """The run with its outcomes by the table's rule; None where it cannot be judged by that."""
        if not can_be_judged(self.run, table.rule, table.last_steps):
            return None
        return under_rule(self.run, table.rule, table.last_steps)


@dataclass(frozen=True)
class FigureSource:
    """The table and the runs that figures of a report are made of."""

    table: RetentionTable
    runs: tuple[DrawnRun, ...]

    @property
    def probed(self) -> tuple[DrawnRun, ...]:
        """Runs with probes."""
        return tuple(run for run in self.runs if run.results is not None)


@dataclass(frozen=True)
class ReportFigure:
    """A figure that can be drawn.

    name: file stem. subject: which numbers it shows, such as `behaviour` or `probes`. run: its position among the
    runs, None if it shows all of them. reading: how to read it, in plain language. is_table: its numbers are a
    table that is printed as such elsewhere. is_detail: the main figures can be read without it.
    """

    name: str
    title: str
    subject: str
    reading: str
    run: int | None
    draw: "Callable[[], Figure]"
    is_table: bool = False
    is_detail: bool = False

    @contextmanager
    def drawn(self) -> "Iterator[Figure]":
        """The figure, closed again afterwards, so that pyplot keeps none of many."""
        from matplotlib import pyplot as plt

        figure = self.draw()
        try:
            yield figure
        finally:
            plt.close(figure)


def figure_of(display: Any) -> "Figure":
    """The figure of a display that draws on axes of its own."""
    from matplotlib.figure import Figure

    figure = display.plot().ax_.figure
    assert isinstance(figure, Figure)
    return figure


def in_view(title: str, view: str, views: Sequence[str]) -> str:
    """The title, which names the view where there are several."""
    return f"{title}, view {view}" if len(views) > 1 else title


def view_suffix(view: str, views: Sequence[str]) -> str:
    """Return the end of a file's name; the first view needs none."""
    return "" if view == views[0] else f"-{view.replace(':', '-')}"


# -- labels ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LabelView:
    """One label of one run in one category and view, for a figure. name: of the view. stem: of its files."""

    results: ProbeResults
    category: str
    name: str
    stem: str
    position: int

    @property
    def curve(self) -> ProbeCurve:
        """Its probes."""
        return self.results.curves[self.category, self.name]

    def figure(self, name: str, title: str, reading: str, draw: "Callable[[], Figure]") -> ReportFigure:
        """Return a figure of it for a report; those of other views than the first are details.

        name: of the figure in file names. title: without the view. reading: how to read it, in plain language.
        """
        views = self.results.settings.views
        of_category = "" if self.category == EVERYWHERE else f"-{file_names([self.category])[0]}"
        return ReportFigure(
            f"{self.stem}{of_category}-{name}{view_suffix(self.name, views)}",
            in_view(title, self.name, views), self.results.settings.target, reading, self.position, draw,
            is_detail=self.name != views[0],
        )  # fmt: skip


def label_views(source: FigureSource) -> Iterator[LabelView]:
    """Yield the categories and views of the rows of a table of labels, label by label and run by run."""
    for drawn in source.probed:
        assert drawn.results is not None
        for row in source.table.rows:
            if (row.target, row.run.location) == (drawn.results.settings.target, str(drawn.run.location)):
                yield LabelView(drawn.results, row.category, row.view or "", drawn.stem, drawn.position)


def file_names(targets: Sequence[str]) -> list[str]:
    """Return label columns as parts of file names, no two alike."""
    names: list[str] = []
    for target in targets:
        name = re.sub(r"[^\w.-]+", "-", target).strip(".-") or "label"
        tries = (name, *(f"{name}-{number}" for number in range(2, len(targets) + 1)))
        used = {other.casefold() for other in names}
        names.append(next(free for free in tries if free.casefold() not in used))
    return names
