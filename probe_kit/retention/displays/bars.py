"""Bars of shares: items by layout, episodes by outcome rule, and items by answer, probe and success."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from probe_kit.env.scoring import DEFAULT_RULE, RULES
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import PairedItems, TableRun, distinct_labels, paired_items, shares_of
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.compare.known_used import KnownUsedTable
from probe_kit.retention.displays.display import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    Display,
    ProvenanceLine,
    footer,
)
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, figure_of, in_report
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


Part = tuple[str, str, str, float, int | None]
"""A part of a bar: its label, colour and hatch, its percent, and the number that is written into it."""
_LEAST = 6.0  # percent of a bar that has room for a number
_NEITHER = "#D9D9D9"


@dataclass(frozen=True)
class Bar:
    """One bar.

    Attributes:
        name: Name on the left.
        parts: The parts of the bar, from the left.
        text: Text on its right; without parts, in its place.
        group: Bars of one group are drawn close together.
    """

    name: str
    parts: Sequence[Part]
    text: str
    is_bold: bool = False
    group: str = ""


@dataclass(kw_only=True)
class BarDisplay(Display):
    """Bars of shares, one below the other.

    Attributes:
        share_of: The name of the level axis.
    """

    share_of: ClassVar[str] = "items (%)"

    @property
    @abstractmethod
    def rows(self) -> Sequence[Bar]:
        """The bars, from above."""

    @property
    def heights(self) -> list[float]:
        """The middle of each bar along the upright axis, from above."""
        groups = list(dict.fromkeys(bar.group for bar in self.rows))
        return [at + 0.5 * groups.index(bar.group) for at, bar in enumerate(self.rows)]

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own that is as high as the bars need."""
        self.figure_size = 6.2, 0.34 * self.heights[-1] + 0.85
        return super().plot(ax)

    def draw(self, axes: "Axes") -> None:
        """Draw the bars with their names."""
        for height, bar in zip(self.heights, self.rows, strict=True):
            start = 0.0
            for label, colour, hatch, width, number in bar.parts:
                axes.barh(height, width, 0.72, start, color=colour, hatch=hatch, ec="white", lw=0.6, label=label)
                if number is not None and width >= _LEAST:
                    ground = {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.85}
                    axes.text(
                        start + width / 2, height, str(number), ha="center", va="center", fontsize=8, bbox=ground
                    )
                start += width
            weight = "bold" if bar.is_bold else "normal"
            # Without a bar the text takes its place.
            axes.text(101 if bar.parts else 1, height, bar.text, va="center", fontsize=7.5, weight=weight)
        axes.set_yticks(self.heights, [bar.name for bar in self.rows])
        axes.set_ylim(self.heights[-1] + 0.6, -0.6)
        axes.set_xlim(0, 100)
        axes.set_xlabel(self.share_of, fontsize=9)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)


# -- layouts -----------------------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class PairedLayoutsDisplay(BarDisplay):
    """Items by outcome of their two layouts, per category.

    Knowledge puts items into "right in both"; a preference for a side puts them into "right in one", whatever its
    strength. The p on the right of a bar is the exact test of right twice against wrong twice.
    """

    items: dict[str, PairedItems]

    @classmethod
    def from_run(cls, run: RunReader) -> Self:
        """Read the episodes of a run; items that ran in one layout are left out."""
        by_category = run.episodes.groupby("category", sort=False)
        items = {str(category): paired_items(episodes) for category, episodes in by_category}
        return cls(items=items, certificates=(ProvenanceLine.of_run(run),))

    @property
    def rows(self) -> Sequence[Bar]:
        """A bar per category."""
        return [_paired_bar(title_of(category), paired) for category, paired in self.items.items()]


def _paired_bar(name: str, paired: PairedItems) -> Bar:
    total = paired.both + paired.exactly_one + paired.none
    # Hatches tell the parts apart without colour.
    counts = (
        ("right in both layouts", GREEN, "", paired.both),
        ("right in one", SKY, "\\\\\\", paired.exactly_one),
        ("wrong picture in both", VERMILION, "///", paired.both_wrong),
        ("none right, otherwise", _NEITHER, "", paired.none - paired.both_wrong),
    )
    parts = [(label, colour, hatch, 100 * count / max(1, total), count) for label, colour, hatch, count in counts]
    p = "< 0.001" if paired.p < 0.001 else f"= {paired.p:.3f}"
    return Bar(name, parts, f"p {p}  n {total}", is_bold=paired.p < SIGNIFICANCE)


@in_report(7)
def layout_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield one figure per run that acted."""
    for drawn in source.runs:
        if (run := drawn.judged) is not None:
            yield ReportFigure(
                f"{drawn.stem}-paired-layouts", "The same question, pictures swapped", "behaviour",
                "Every question is asked twice, with the two images swapped. Knowing the answer means right "
                "both times; always choosing one side means right once. Bold p: more items are right twice than "
                "wrong twice, beyond luck.",
                drawn.position, partial(figure_of, PairedLayoutsDisplay.from_run, run), is_detail=True,
            )  # fmt: skip


# -- outcome rules -----------------------------------------------------------------------------------------------

_VERDICTS = (
    ("correct", "right", GREEN, ""),
    ("wrong", "wrong", VERMILION, "///"),
    ("oob", "neither", _NEITHER, ""),
)


@dataclass(frozen=True)
class RuleBar:
    """One run by one rule: shares of episodes, and the score of doing nothing; None where it is n/a.

    Both are means over the categories, as in the tables.
    """

    run: str
    rule: str
    shares: Mapping[str, float] | None
    idle: float | None


@dataclass(kw_only=True)
class OutcomeRulesDisplay(BarDisplay):
    """A bar per run and outcome rule: how often the same episodes are called right, wrong or neither."""

    share_of: ClassVar[str] = "episodes (%), mean over categories"
    bars: tuple[RuleBar, ...]

    @classmethod
    def from_runs(cls, runs: Sequence[RunReader]) -> Self:
        """Judge the episodes of runs by every rule; a run without trajectories has a bar by `disc` alone.

        Raises:
            UsageError: Without episodes.
        """
        if not runs or any(run.episodes.empty for run in runs):
            raise UsageError("there are no episodes to judge; give runs that have some")
        labels = distinct_labels(runs)
        bars = [bar for run in runs for bar in _bars(TableRun.of(run, label=labels[str(run.location)]))]
        return cls(bars=tuple(bars), certificates=tuple(map(ProvenanceLine.of_run, runs)))

    @property
    def rows(self) -> Sequence[Bar]:
        """The bars with their names: the rule, and the run before it where there are several."""
        several = len({bar.run for bar in self.bars}) > 1
        return [_rule_bar(f"{bar.run}  {bar.rule}" if several else bar.rule, bar) for bar in self.bars]

    def draw(self, axes: "Axes") -> None:
        """Draw the bars, and a mark at the score of doing nothing."""
        super().draw(axes)
        for height, bar in zip(self.heights, self.bars, strict=True):
            if bar.idle:
                x, y = [100 * bar.idle] * 2, [height - 0.44, height + 0.44]
                axes.plot(x, y, color="black", lw=2, label="doing nothing scores")
        axes.set_xlim(0, 112)
        axes.set_xticks(range(0, 101, 25))


def _rule_bar(name: str, bar: RuleBar) -> Bar:
    if bar.shares is None:
        return Bar(name, (), "n/a: the run keeps no trajectories", group=bar.run)
    parts = [(label, colour, hatch, 100 * bar.shares[part], None) for part, label, colour, hatch in _VERDICTS]
    return Bar(name, parts, f"{100 * bar.shares['correct']:.1f}", group=bar.run)


def _bars(table_run: TableRun) -> list[RuleBar]:
    run, name = table_run.run, table_run.name
    if table_run.verdicts is None:
        stored = {part: _over_categories(run, shares_of(run.episodes, part)) for part, *_ in _VERDICTS}
        return [RuleBar(name, rule, stored if rule == DEFAULT_RULE else None, None) for rule in RULES]
    return [
        RuleBar(
            name,
            rule,
            {part: _over_categories(run, verdicts[part]) for part, *_ in _VERDICTS},
            _over_categories(run, verdicts["idle"] == "correct"),
        )
        for rule, verdicts in table_run.verdicts.items()
    ]


def _over_categories(run: RunReader, shares: "ArrayLike") -> float:
    """Return the mean over categories of a share (E,) per episode, in the order of the run's episodes."""
    values, categories = np.asarray(shares, dtype=float), run.episodes["category"].to_numpy()
    return float(np.mean([values[categories == name].mean() for name in np.unique(categories)]))


@in_report(4)
def rule_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield one figure of all runs that keep trajectories."""
    runs = [drawn.run for drawn in source.runs if drawn.run.has_trajectories and not drawn.run.episodes.empty]
    if runs:
        yield ReportFigure(
            "outcome-rules", "The same episodes by every outcome rule", "behaviour",
            "What counts as an answer decides the success rate. An upright mark is what a policy that does "
            "nothing would score by that rule: where there is one, the untouched cube already counts as put on a "
            "picture.",
            None, partial(figure_of, OutcomeRulesDisplay.from_runs, runs), is_detail=True,
        )  # fmt: skip


# -- answer, probe, success --------------------------------------------------------------------------------------

_LOOKS: Mapping[str, tuple[str, str]] = {
    "111": (GREEN, ""),
    "101": ("#7FCEB9", "\\\\\\"),
    "011": (SKY, ""),
    "001": (BLUE, "\\\\\\"),
    "110": (VERMILION, ""),
    "100": (ORANGE, "///"),
    "010": (PURPLE, "///"),
    "000": (_NEITHER, ""),
    "1-1": (GREEN, ""),
    "0-1": (SKY, "\\\\\\"),
    "1-0": (VERMILION, "///"),
    "0-0": (_NEITHER, ""),
}
"""Colour and hatch by answer, probe and success: items with success first."""


@dataclass(kw_only=True)
class KnownUsedDisplay(BarDisplay):
    """A bar per category: shares of items that the VLM answers, probes read, and the policy acts on.

    Each counts only if it is right in both layouts.

    Attributes:
        joined: The result of `probe_kit.retention.compare.known_used.match_runs`.
    """

    joined: KnownUsedTable

    @classmethod
    def from_join(cls, joined: KnownUsedTable) -> Self:
        """Read a table of `probe_kit.retention.compare.known_used.match_runs`."""
        return cls(joined=joined, title=f"{joined.vlm} (by {joined.score}) · {joined.policy}")

    @property
    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """Items by category and code, such as `101`: answer right, probe not, success (`1-1` without probes)."""
        return {row.category: row.counts for row in self.joined.rows}

    @property
    def rows(self) -> Sequence[Bar]:
        """A bar per category."""
        return [_counted_bar(title_of(category), counts) for category, counts in self.counts.items()]

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add the legend, and the names of both models in place of one run's line."""
        super().finish(figure, grid)
        probes = f"probes in view {self.joined.view}" if self.joined.view else "no probes"
        names = f"{self.joined.vlm} · {self.joined.policy}"
        footer(figure, f"{names} · items right in both layouts, a coin: 25 % · {probes}")


def _counted_bar(name: str, counts: Mapping[str, int]) -> Bar:
    total = sum(counts.values())
    parts = [
        (words_of(code), *look, 100 * counts[code] / max(1, total), counts[code])
        for code, look in _LOOKS.items()
        if code in counts
    ]
    return Bar(name, parts, f"n {total}")


def words_of(code: str) -> str:
    """Return `101` as "answer right, probe not, success"."""
    names = (("answer right", "answer not"), ("probe right", "probe not"), ("success", "no success"))
    parts = zip(names, code, strict=True)
    return ", ".join(right if mark == "1" else wrong for (right, wrong), mark in parts if mark != "-")


@in_report(6)
def known_used_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield one figure per pair of a VLM run and a policy run."""
    for number, joined in enumerate(source.joins.tables, 1):
        yield known_used_figure(joined, number)


def known_used_figure(joined: KnownUsedTable, number: int = 1) -> ReportFigure:
    """Return the figure of a join."""
    return ReportFigure(
        f"known-used-{number}", "Answer, probe, success", "join",
        "Every question once: does the VLM answer right, is the probe of the policy right, and does the cube "
        "end right, each in both layouts. An item with both and without success may be lost on the way.",
        None, partial(figure_of, KnownUsedDisplay.from_join, joined),
    )  # fmt: skip
