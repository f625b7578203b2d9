"""The displays' base, a panel alone or with others; and the look that all figures share."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import plural
from probe_kit._tables.numbers import span
from probe_kit.errors import UnknownCategoryError, UnknownSiteError
from probe_kit.retention.choices import Iterations
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.choices import CORRECT, EVERYWHERE
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import ArrayLike

    from probe_kit.retention.displays.shown_figure import DrawnPicture


# -- the look that all figures share --------------------------------------------------------------------------


RANDOM = "RANDOM WEIGHTS"
SHOWN = 12
"""Hex digits of a hash that a caption shows."""


@dataclass(frozen=True)
class ProvenanceLine:
    """The origin of the numbers of a figure.

    Attributes:
        weights: sha256 of the weights that acted, None for a scripted policy.
        suite: `name@version#hash`.
        n: Number of episodes, in words.
        settings: sha256 of the run's settings.
        probes: Key of the probe results.
        call: Captured inference that was probed, None without probes.
    """

    model: str
    random_weights: bool
    weights: str | None
    suite: str
    n: str
    settings: str
    probes: str | None = None
    target: str = CORRECT
    call: int | None = None

    @classmethod
    def of_run(cls, run: RunReader) -> Self:
        """Return the line of a run's behaviour."""
        rule = run.rule
        n = f"n = {plural(len(run.episodes), 'episode')}" + ("" if rule == "disc" else f" by the rule {rule}")
        return cls(run.label, run.random_weights, run.weights_sha256, run.suite, n, run.settings_sha256)

    @classmethod
    def of_results(cls, results: ProbeResults, view: str, category: str | None = None) -> Self:
        """Return the line of probes in one view: of all categories of a side, or of a label in one category."""
        settings = results.settings
        if category is None:
            sizes = [curve.labels.size for (_, name), curve in results.curves.items() if name == view]
            n = f"n = {span(sizes)} episodes per category, view {view}"
        else:
            curve = results.curves[category, view]
            of = "" if category == EVERYWHERE else f", category {category}"
            samples = f"{plural(curve.labels.size, 'sample')} in {plural(curve.n_groups, 'group')}"
            n = f"n = {samples}, view {view}{of}"
        return cls(
            results.label if category is None else settings.model, settings.random_weights, settings.weights,
            settings.suite, n, settings.run_settings, results.key, settings.target,
            settings.call if category is None or settings.window == 1 else None,
        )  # fmt: skip

    @classmethod
    def of_row(cls, row: RetentionRow) -> Self:
        """Return the line of a row of the retention table, usually a mean."""
        n = f"n = {plural(row.success.n_episodes, 'episode')}"
        return cls(
            row.run.label or row.run.model,
            row.run.random_weights,
            row.run.weights_sha256,
            row.run.suite,
            n,
            row.run.settings,
            row.run.probes,
            call=row.run.call,
        )

    @property
    def parts(self) -> tuple[str, str, str, str, str, str, str]:
        """The parts of the line, most important first; random weights are named in capitals.

        Model, suite, n, call, target, probes, weights; empty where there is nothing to name.
        """
        return (
            f"{self.model} {RANDOM}" if self.random_weights else self.model,
            self.suite,
            self.n,
            "" if self.call is None else f"call {self.call}",
            f"target {self.target}" if self.target != CORRECT else "",
            f"probes {self.probes}" if self.probes else "",
            f"weights {self.weights[:SHOWN]}" if self.weights else "",
        )

    @property
    def line(self) -> str:
        """All parts in one line, for a caption."""
        return " · ".join(filter(None, [*self.parts, f"settings {self.settings[:SHOWN]}"]))


# Okabe and Ito's palette: apart for every kind of colour vision.
BLUE, VERMILION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
SKY, PURPLE, BLACK, GREY = "#56B4E9", "#CC79A7", "#000000", "#8C8C8C"

DPI = 150
"""Resolution on a screen; files are saved at `PRINT_DPI`."""
ACCURACY = (20.0, 109.0)
"""Range in percent of the axis of held-out accuracies, the same in every figure of every run.

Held-out accuracies below 50 % occur by chance, rarely below 20 %. Carets of the best sites are drawn above 100 %.
"""
ABOVE_CHANCE = (-30.0, 51.0)
"""Range in points of the axis of accuracies above chance, the same in every figure."""
_CAPTION_SIZE = 6.5
_LEGEND_SIZE = 8.0
"""Both in points."""
_LETTERS_PER_INCH = 16
"""Letters of a legend's label per inch, a low estimate."""
_MARK = 8
"""Letters that the mark and the gaps of a legend's entry take."""
_LEGEND_ROWS, _ROW_HEIGHT = 2, 0.17
"""Rows of a legend that figures have room for, and inches that each further one adds to their height."""


@dataclass(frozen=True)
class LineLook:
    """The look of one series; colour is never the only difference."""

    colour: str
    marker: str
    dash: str = "-"


PARTS = MappingProxyType(
    {
        "backbone": LineLook(BLUE, "o"),
        "action": LineLook(VERMILION, "s"),
        "vision": LineLook(GREEN, "^"),
        "bridge": LineLook(PURPLE, "D"),
    }
)
"""The look of the streams of one part of a model."""

SERIES = (
    LineLook(BLUE, "o"),
    LineLook(VERMILION, "s", "--"),
    LineLook(GREEN, "^", "-."),
    LineLook(PURPLE, "D", ":"),
    LineLook(ORANGE, "v", (0, (5, 1))),  # type: ignore[arg-type]  # matplotlib also takes (offset, dashes)
    LineLook(BLACK, "P", (0, (3, 1, 1, 1))),  # type: ignore[arg-type]
    LineLook(SKY, "X", "-"),
)
"""The looks of models or roles, in order; an eighth one begins again."""


def series(position: int) -> LineLook:
    """Return the look of the series at `position`."""
    return SERIES[position % len(SERIES)]


def darker(colour: str) -> str:
    """Return a shade of `#RRGGBB` that text can be read in."""
    return "#" + "".join(f"{int(colour[at : at + 2], 16) * 6 // 10:02X}" for at in (1, 3, 5))


def panels(
    count: int,
    width: float = 3.1,
    height: float = 2.5,
    columns: int | None = None,
    *,
    share: bool = True,
    in_pyplot: bool = False,
) -> "tuple[Figure, list[Axes]]":
    """Return a figure of `count` panels of `width` × `height` inches.

    Args:
        count: Number of panels.
        width: Width of a panel in inches.
        height: Height of a panel in inches.
        columns: Panels in a row; None for at most three.
        share: Whether panels share both axes.
        in_pyplot: Whether pyplot knows the figure, so that notebooks show it.
    """
    from matplotlib import pyplot as plt

    from probe_kit.retention.displays.shown_figure import ShownFigure

    across = columns or (2 if count == 4 else min(3, count))
    rows = ceil(count / across)
    # 1.1 inches for legend and caption; 6.2 is the narrowest that a caption reads well in.
    size = (max(width * across, 6.2), height * rows + 1.1)
    figure: Figure
    if in_pyplot:
        figure = plt.figure(figsize=size, layout="constrained", dpi=DPI, FigureClass=ShownFigure)
    else:
        figure = ShownFigure(figsize=size, layout="constrained", dpi=DPI)
    grid = list(figure.subplots(rows, across, sharex=share, sharey=share, squeeze=False).flat)
    for position in range(count, len(grid)):
        grid[position].set_visible(False)
        # Of shared axes only the lowest row has numbers; above a hidden panel they would be missing.
        grid[position - across].tick_params(labelbottom=True)
    return figure, grid[:count]


def layer_axis(axes: "Axes", layers: int, label: bool = True) -> None:
    """Write whole layer numbers below the axes."""
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(-0.06 * layers - 0.2, 1.06 * (layers - 1) + 0.2)
    if layers == 1:  # a locator of whole numbers falls back on fractions where there is only one
        axes.set_xticks([0])
    else:
        axes.xaxis.set_major_locator(MaxNLocator(nbins=7, integer=True, min_n_ticks=2))
    if label:
        axes.set_xlabel("layer", fontsize=8.5)


def accuracy_axis(axes: "Axes") -> None:
    """Set the fixed scale of accuracies; lower values are marked at the lower edge by `mark_below`."""
    axes.set_ylim(*ACCURACY)


def mark_below(axes: "Axes", places: "ArrayLike", accuracy: "ArrayLike", colour: str) -> None:
    """Mark every accuracy (percent) below the scale at the lower edge, with its number."""
    for at, value in zip(np.asarray(places), np.asarray(accuracy), strict=True):
        if value < ACCURACY[0]:
            axes.plot([at], [ACCURACY[0] + 1.5], ls="none", marker="v", ms=5, color=colour, gid="below")
            axes.annotate(
                f"{value:.0f}", (at, ACCURACY[0] + 1.5), (0, 5), textcoords="offset points", fontsize=6.5,
                ha="center", color=colour,
            )  # fmt: skip


def plain(axes: "Axes") -> None:
    """Remove the frame above and to the right, and make tick labels small."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def caption(figure: "Figure", *certificates: ProvenanceLine) -> None:
    """Write the origin of a figure below it: every model once, then the parts that all have in common.

    `figure.caption` has each certificate in full, with its settings.
    """
    certificates = tuple(dict.fromkeys(certificates))
    groups = zip(*(certificate.parts for certificate in certificates), strict=True)
    parts = dict.fromkeys(", ".join(filter(None, dict.fromkeys(group))) for group in groups)
    footer(figure, " · ".join(filter(None, parts)))
    figure.caption = "; ".join(certificate.line for certificate in certificates)  # type: ignore[attr-defined]


def footer(figure: "Figure", text: str) -> None:
    """Write a caption under a figure, on as many lines as its width needs."""
    figure.caption = text  # type: ignore[attr-defined]
    figure.supxlabel(text, fontsize=_CAPTION_SIZE, color="0.25", wrap=True)


def legend_above(figure: "Figure", handles: "Sequence[Artist]", title: str = "") -> None:
    """Draw a legend along the upper side, in as many columns as the figure has room for.

    Many rows make the figure higher. matplotlib fills a legend column by column, and leaves their number to its
    caller.

    Args:
        figure: The figure of all panels.
        handles: Entries in order.
        title: Lines above the entries; empty for none.
    """
    lengths = [len(str(handle.get_label())) + _MARK for handle in handles]
    room = _LETTERS_PER_INCH * figure.get_figwidth()
    fitting = [
        columns
        for columns in range(1, len(lengths) + 1)
        if sum(int(column.max()) for column in np.array_split(lengths, columns)) <= room
    ]
    columns = max(fitting, default=1)
    rows = ceil(len(lengths) / columns) + len(title.splitlines())
    figure.set_figheight(figure.get_figheight() + _ROW_HEIGHT * max(0, rows - _LEGEND_ROWS))
    figure.legend(
        handles=handles, loc="outside upper left", ncols=columns, fontsize=_LEGEND_SIZE, frameon=False,
        title=title or None, title_fontsize=_LEGEND_SIZE, alignment="left",
    )  # fmt: skip


def legend_handles(*grid: "Axes") -> "dict[str, Artist]":
    """Return the handles of a legend by their label, each label once, in the order in which they are drawn.

    Intervals come last, in grey, as they have the colour of their line.
    """
    from matplotlib.lines import Line2D

    handles: dict[str, Artist] = {}
    for axes in grid:
        handles |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if handles.pop(INTERVAL, None) is not None:
        handles[INTERVAL] = Line2D([], [], color="0.3", ls="none", marker="|", ms=11, mew=0.8, label=INTERVAL)
    return handles


INTERVAL = "bar: 95 % interval"


def draw_intervals(
    axes: "Axes",
    x: "ArrayLike",
    y: "ArrayLike",
    colour: str,
    upright: "ArrayLike | None" = None,
    level: "ArrayLike | None" = None,
    *,
    is_faint: bool = False,
) -> None:
    """Draw the 95 % intervals of points as thin bars, which the legend explains.

    Args:
        axes: Axes to draw on.
        x: (N,) places along the lower side.
        y: (N,) values.
        colour: Colour of the line of points.
        upright: (2, N) lower and upper ends of the intervals of `y`, NaN where there is none; None for no bars.
        level: The same for `x`.
        is_faint: Whether other points lie on the bars, which are then drawn lightly.
    """

    def arms(values: "ArrayLike", ends: "ArrayLike | None") -> "NDArray[np.float64] | None":
        if ends is None:
            return None
        low, high = np.asarray(ends, dtype=float)
        # Rounding makes arms of less than nothing, where groups agree.
        return np.array([values - low, high - values]).clip(min=0)

    up, across = arms(y, upright), arms(x, level)
    if any(part is not None and np.isfinite(part).any() for part in (up, across)):
        axes.errorbar(
            x, y, yerr=up, xerr=across, fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.28 if is_faint else 0.7,
            label=INTERVAL,
        )  # fmt: skip


def significance_handles(filled: str | None = None) -> "list[Line2D]":
    """Return the legend's entries for filled and open markers.

    Args:
        filled: The meaning of filled markers; None for that of probes.
    """
    from matplotlib.lines import Line2D

    label = FILLED if filled is None else f"filled: {filled}"
    return [
        Line2D([], [], color="0.3", ls="none", marker="o", ms=4.5, label=label),
        Line2D([], [], color="0.3", ls="none", marker="o", ms=4.5, mfc="white", label=OPEN),
    ]


SIGNAL = f"above chance and every control run, p < {SIGNIFICANCE}"
"""The meaning of every filled marker and every dot of a probe; the same words in legends and captions."""
FILLED = f"filled: shown ({SIGNAL})"
OPEN = "open: not shown"


# -- a panel of numbers ---------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class Display(ABC):
    """One panel of numbers: on axes of its own, or one of several in a figure.

    A display that has been plotted shows its figure.

    Attributes:
        title: Text above the panel.
        measure: Name of the upright axis.
        certificates: Origin of its numbers.
        figure_size: Inches of a panel by itself.
        is_level: Whether panels side by side have one range of the upright axis.
        ax_: The axes that `plot` drew on.
        panel_size: Inches of a panel among several.
        is_framed: Whether all spines are drawn.
    """

    title: str = ""
    measure: str = ""
    certificates: tuple[ProvenanceLine, ...] = ()
    figure_size: tuple[float, float] = (6.2, 2.8)
    is_level: bool = False
    ax_: "Axes | None" = field(default=None, init=False, repr=False)
    panel_size: ClassVar[tuple[float, float]] = (3.1, 2.5)
    is_framed: ClassVar[bool] = False
    title_size: ClassVar[float] = 9

    @abstractmethod
    def draw(self, axes: "Axes") -> None:
        """Draw marks with labels for the legend, and the axes' scales."""

    def further_handles(self) -> "Sequence[Artist]":
        """Return handles of the legend that follow those of the drawn marks."""
        return []

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add the parts that all panels of a figure share: a legend with every name once."""
        if every := [*legend_handles(*grid).values(), *self.further_handles()]:
            legend_above(figure, every)

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        if ax is None:
            in_panels([self], self.figure_size, in_pyplot=True)
        else:
            self.draw_panel(ax)
            self.annotate()
        return self

    def draw_panel(self, axes: "Axes") -> None:
        """Draw on `axes`, with the title above."""
        self.draw(axes)
        if not self.is_framed:
            plain(axes)
        axes.set_title(self.title, fontsize=self.title_size, loc="left")
        self.ax_ = axes

    def annotate(self) -> None:  # noqa: B027 - most displays have nothing to write
        """Write texts that need the marks' final places: after the layout of a figure of its own, else at once."""

    def _repr_png_(self) -> "DrawnPicture | None":
        """Return the figure, whatever pyplot's backend is."""
        if self.ax_ is None:
            return None
        from matplotlib import pyplot as plt
        from matplotlib.figure import Figure

        from probe_kit.retention.displays.shown_figure import picture_of

        figure = self.ax_.figure
        assert isinstance(figure, Figure)
        plt.close(figure)  # or the inline backend shows it once more below the cell
        return picture_of(figure)


def in_panels(
    displays: Sequence[Display | None],
    size: tuple[float, float] | None = None,
    columns: int | None = None,
    *,
    in_pyplot: bool = False,
) -> "Figure":
    """Return displays of one kind in one figure, under one legend.

    Args:
        displays: One or more; None leaves a place empty.
        size: Size of a panel in inches, by default that of its kind.
        columns: Panels in a row; None for at most three.
        in_pyplot: Whether pyplot knows the figure, so that notebooks show it.
    """
    present = [display for display in displays if display is not None]
    first = present[0]
    figure, places = panels(len(displays), *(size or first.panel_size), columns, share=False, in_pyplot=in_pyplot)
    for display, axes in zip(displays, places, strict=True):
        if display is None:
            axes.set_visible(False)
        else:
            display.draw_panel(axes)
    grid = [axes for axes in places if axes.get_visible()]
    if first.is_level:
        ranges = [axes.get_ylim() for axes in grid]
        for axes in grid:
            axes.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))
    figure.supylabel(first.measure, fontsize=9)
    caption(figure, *(line for display in present for line in display.certificates))
    first.finish(figure, grid)
    for display in present:
        display.annotate()
    return figure


def draw_series(
    axes: "Axes",
    line: LineLook,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    filled: NDArray[np.bool_],
    label: str,
    zorder: float = 2.0,
) -> None:
    """Draw a line, with filled markers where it is significant and open ones elsewhere.

    Args:
        axes: Axes to draw on.
        line: The look of the series.
        x: (K,) places.
        y: (K,) heights.
        filled: (K,) whether a point is significant.
        label: Entry in the legend.
        zorder: Drawing order; larger is drawn on top.
    """
    axes.plot(x, y, color=line.colour, ls=line.dash, lw=1.6, label=label, zorder=zorder)
    for is_filled in (True, False):
        axes.plot(
            x[filled == is_filled], y[filled == is_filled], ls="none", marker=line.marker, ms=5, mec=line.colour,
            mfc=line.colour if is_filled else "white", zorder=zorder,
        )  # fmt: skip


# -- what a figure shows of probe results ------------------------------------------------------------------------


def known_view(results: ProbeResults, view: str | None) -> str:
    """Return `view`, or the first probed one.

    Raises:
        UnknownSiteError: If it was not probed.
    """
    probed = results.settings.views
    view = view or probed[0]
    if view not in probed:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(probed)}")
    return view


def curve_of(results: ProbeResults, category: str, view: str) -> ProbeCurve:
    """Return the probes of a category.

    Raises:
        UnknownCategoryError: If it was not probed.
    """
    if (category, view) not in results.curves:
        probed = ", ".join(results.settings.categories)
        raise UnknownCategoryError(f"category {category!r} was not probed; probed: {probed}")
    return results.curves[category, view]


def probed_curve(results: ProbeResults, view: str | None, category: str | None) -> tuple[str, str, ProbeCurve]:
    """Return category, view and curve, by default the first; raises as `known_view` and `curve_of`."""
    view, category = known_view(results, view), category or results.settings.categories[0]
    return category, view, curve_of(results, category, view)


def scores_of(results: ProbeResults, category: str, view: str, stream: str | None = None) -> "pd.DataFrame":
    """Return the rows of `results.scores` of one category in one view, and of one stream where it is named."""
    scores = results.scores
    selected = (scores["category"] == category) & (scores["view"] == view)
    return scores[selected if stream is None else selected & (scores["stream"] == stream)]


def best_of(iterations: Iterations) -> Iterations:
    """Return the choice of iterations for a single line or number: the best iteration in place of all."""
    return "best" if iterations == "all" else iterations


def best_row(curve: ProbeCurve, stream: str) -> int:
    """Return the position of the site of a stream that has the largest score above its own chance.

    Raises:
        UnknownSiteError: If no site of the stream was probed.
    """
    rows = curve.stream(stream)
    if not rows.size:
        raise UnknownSiteError(
            f"stream {stream!r} was not probed in this view; probed: {', '.join(curve.streams)}"
        )
    return curve.largest_excess(rows)
