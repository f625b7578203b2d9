"""The opening of a report beside its summary: one question, and where its answer can be read."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from probe_kit.retention.columns.modes import modes_of
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.report_figure import ONLY_FILLED, ReportFigure
from probe_kit.retention.displays.base.style import axes_for, legend_above
from probe_kit.retention.displays.layer_curves import LayerCurveDisplay
from probe_kit.retention.report.episodes import EpisodeGrid
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import RetentionTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Question:
    """An episode of the grid. source: its picture as a data URI."""

    card: Mapping[str, Any]
    source: str

    @property
    def caption(self) -> str:
        """Return how it ended, in words."""
        outcome = (_ANSWERS if self.card["asked"] else _OUTCOMES).get(self.card["outcome"], "it was captured only")
        answer = f": {self.card['answer']}" if self.card["answer"] else ""
        frames = "First frame" if self.card["frames"] == 1 else "First and last frame"
        return f"{frames}. The correct picture lies {_SIDES[self.card['side']]}{answer}; {outcome}."


_SIDES = {"left": "on the left", "right": "on the right"}
_OUTCOMES = {
    "correct": "the cube ended on it",
    "wrong": "the cube ended on the other picture",
    "oob": "the cube ended on neither picture",
}
_ANSWERS = {
    "correct": "the model answers right",
    "wrong": "the model answers wrong",
    "oob": "no answer could be read",
}


def opening_row(table: RetentionTable) -> RetentionRow | None:
    """The category to open with: one that the backbone holds and the action does not, if there is one.

    Of runs with probes the first category with signal is next, and then the first at all; None without rows.
    """
    rows = [category.row for run in table.summary for category in run.categories]
    probed = [row for row in rows if row.backbone.score is not None]
    lost = [row for row in probed if row.backbone.has_signal and not row.action.has_signal]
    encoded = [row for row in probed if row.backbone.has_signal]
    return next(iter((*lost, *encoded, *probed, *rows)), None)


def opening_question(row: RetentionRow, name: str, grid: EpisodeGrid) -> Question | None:
    """The first episode of the row's category with a picture, of this run by its name; None without one."""
    cards = [card for card in grid.cards if card["run"] == name and card["category"] == row.category]
    for card in cards:
        if card["picture"] is not None:
            return Question(card, f"data:image/webp;base64,{grid.picture(card)}")
    return None


def opening_curve(row: RetentionRow, table: RetentionTable, position: int) -> ReportFigure | None:
    """Accuracy by layer of the row's category; None where it was not probed. position: of the run."""
    results = table.results_of(row.run.location)
    if results is None or row.backbone.score is None:
        return None
    output = "answer" if modes_of([row]) == "answers" else "action"
    iterations = "best" if table.iterations == "all" else table.iterations
    display = LayerCurveDisplay.from_results(results, row.category, row.view, iterations)
    return ReportFigure(
        "opening", f"Where the answer can be read: {title_of(row.category)}", "summary",
        "How often a linear probe names the side of the correct picture, by layer: in the backbone, and where the "
        f"{output} is made. {ONLY_FILLED}.",
        position, partial(_together, display),
    )  # fmt: skip


def _together(display: LayerCurveDisplay) -> "Figure":
    """All streams on the same axes, with a legend and no more."""
    axes, figure = axes_for(None, 4.7, 3.1)
    assert figure is not None
    display.plot(axes)
    axes.set_title("", loc="left")
    axes.set_ylabel("held-out accuracy (%)", fontsize=8.5)
    legend_above(figure, axes.get_legend_handles_labels()[0])
    figure.caption = display.certificate.line  # type: ignore[attr-defined]
    return figure
