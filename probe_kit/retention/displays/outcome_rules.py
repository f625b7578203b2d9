"""The same episodes by every outcome rule, side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np

from probe_kit.env.scoring import DEFAULT_RULE, RULES
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import full_names, shares_of
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure, figure_of
from probe_kit.retention.displays.base.style import (
    GREEN,
    VERMILION,
    axes_for,
    caption,
    legend_above,
    legend_handles,
    plain,
)
from probe_kit.retention.rows.outcome_rules import RunUnderRule
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

_PARTS = (
    ("correct", "right", GREEN, ""),
    ("wrong", "wrong", VERMILION, "///"),
    ("oob", "neither", "#D9D9D9", ""),
)


@dataclass(frozen=True)
class RuleBar:
    """One run by one rule: shares of episodes, and what doing nothing would score; None where it is n/a.

    Both are means over the categories, as in the tables.
    """

    run: str
    rule: str
    shares: Mapping[str, float] | None
    idle: float | None


@dataclass
class OutcomeRulesDisplay(Display):
    """A bar per run and outcome rule: how often the same episodes are called right, wrong or neither."""

    bars: tuple[RuleBar, ...]
    certificates: tuple[ProvenanceLine, ...]
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_runs(cls, runs: Sequence[RunReader]) -> Self:
        """One that keeps no trajectories has a bar by `disc` alone. Raises UsageError without episodes."""
        if not runs or any(run.episodes.empty for run in runs):
            raise UsageError("there are no episodes to judge; give runs that have some")
        bars = [bar for run, name in zip(runs, full_names(runs), strict=True) for bar in _bars(run, name)]
        return cls(tuple(bars), tuple(ProvenanceLine.of_run(run) for run in runs))

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        runs = list(dict.fromkeys(bar.run for bar in self.bars))
        axes, figure = axes_for(ax, 6.2, 0.3 * len(self.bars) + 0.15 * len(runs) + 1.35)
        places = [at + 0.5 * runs.index(bar.run) for at, bar in enumerate(self.bars)]
        for height, bar in zip(places, self.bars, strict=True):
            _draw_bar(axes, height, bar)
        names = [f"{bar.run}  {bar.rule}" if len(runs) > 1 else bar.rule for bar in self.bars]
        axes.set_yticks(places, names, fontsize=8)
        axes.set_ylim(places[-1] + 0.6, -0.6)
        axes.set_xlim(0, 112)
        axes.set_xticks(range(0, 101, 25))
        axes.set_xlabel("episodes (%), mean over categories", fontsize=9)
        plain(axes)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        if figure is not None:
            legend_above(figure, list(legend_handles(axes).values()))
        caption(figure, *self.certificates)
        self.ax_ = axes
        return self


def _bars(run: RunReader, name: str) -> list[RuleBar]:
    judged = RunUnderRule.of(run, DEFAULT_RULE)
    if judged.verdicts is None:
        stored = {part: _over_categories(run, shares_of(run.episodes, part)) for part, *_ in _PARTS}
        return [RuleBar(name, rule, stored if rule == DEFAULT_RULE else None, None) for rule in RULES]
    return [
        RuleBar(
            name,
            rule,
            {part: _over_categories(run, verdicts[part]) for part, *_ in _PARTS},
            _over_categories(run, verdicts["idle"] == "correct"),
        )
        for rule, verdicts in judged.verdicts.items()
    ]


def _over_categories(run: RunReader, shares: "ArrayLike") -> float:
    """Return the mean over categories of a share (E,) per episode, in the order of the run's episodes."""
    values, categories = np.asarray(shares, dtype=float), run.episodes["category"].to_numpy()
    return float(np.mean([values[categories == name].mean() for name in np.unique(categories)]))


def _draw_bar(axes: "Axes", height: float, bar: RuleBar) -> None:
    if bar.shares is None:
        axes.text(1, height, "n/a: the run keeps no trajectories", va="center", fontsize=7.5, color="0.35")
        return
    start = 0.0
    for name, label, colour, hatch in _PARTS:
        width = 100 * bar.shares[name]
        axes.barh(height, width, 0.72, start, color=colour, hatch=hatch, ec="white", lw=0.5, label=label)
        start += width
    axes.text(101, height, f"{100 * bar.shares['correct']:.1f}", va="center", fontsize=8)
    if bar.idle:
        axes.plot(
            [100 * bar.idle] * 2, [height - 0.44, height + 0.44], color="black", lw=2, label="doing nothing scores"
        )


PLACE = 4
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    with_trajectories = [drawn.run for drawn in source.runs if drawn.run.has_trajectories]
    runs = [run for run in with_trajectories if not run.episodes.empty]
    if runs:
        yield ReportFigure(
            "outcome-rules", "The same episodes by every outcome rule", "behaviour",
            "What counts as an answer decides the success rate. An upright mark is what a policy that does "
            "nothing would score by that rule: where there is one, the untouched cube already counts as put on a "
            "picture.",
            None, lambda: figure_of(OutcomeRulesDisplay.from_runs(runs)), is_detail=True,
        )  # fmt: skip
