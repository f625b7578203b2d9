"""Bars of shares: items by layout, episodes by outcome rule, and items by answer, probe and success."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Self

import numpy as np

from probe_kit.env.scoring import DEFAULT_RULE, RULES
from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.retention.behaviour import PairedItems, ask_of, capture_only, full_names, paired_items, shares_of
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.compare.known_used import KnownUsedTable, correct_joins, match_runs
from probe_kit.retention.displays.display import Display
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, figure_of, in_report
from probe_kit.retention.displays.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    ProvenanceLine,
    axes_for,
    caption,
    footer,
    legend_above,
    legend_handles,
    plain,
)
from probe_kit.retention.rows.outcome_rules import RunUnderRule, can_be_judged, under_rule
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


def _finish(
    axes: "Axes", figure: "Figure | None", names: Sequence[str], places: Sequence[float], label: str
) -> None:
    """Name the bars and the level axis, up to 100 percent, and draw the legend on a figure of their own."""
    axes.set_yticks(places, names, fontsize=8)
    axes.set_ylim(places[-1] + 0.6, -0.6)
    axes.set_xlim(0, 100)
    axes.set_xlabel(label, fontsize=9)
    plain(axes)
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    if figure is not None:
        legend_above(figure, list(legend_handles(axes).values()))


# -- layouts -----------------------------------------------------------------------------------------------------

# Name, colour, hatch: distinct without colour too.
_LAYOUTS = (
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
            _draw_layouts(axes, row, paired)
        _finish(axes, figure, list(map(title_of, self.items)), range(len(self.items)), "items (%)")
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def _draw_layouts(axes: "Axes", row: int, paired: PairedItems) -> None:
    counts = (paired.both, paired.one, paired.both_wrong, paired.none - paired.both_wrong)
    total, start = sum(counts), 0.0
    for (label, colour, hatch), count in zip(_LAYOUTS, counts, strict=True):
        width = 100 * count / max(1, total)
        axes.barh(row, width, 0.72, start, color=colour, hatch=hatch, ec="white", lw=0.8, label=label)
        if width >= 5:
            box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85} if hatch else None
            ink = "white" if colour == GREEN else "black"
            axes.text(
                start + width / 2, row, str(count), ha="center", va="center", fontsize=8, color=ink, bbox=box
            )
        start += width
    weight = "bold" if paired.p < SIGNIFICANCE else "normal"
    p = "< 0.001" if paired.p < 0.001 else f"= {paired.p:.3f}"
    axes.text(101, row, f"p {p}  n {total}", va="center", fontsize=7.5, weight=weight)


@in_report(7)
def layout_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield one per run that acted."""
    for drawn in source.runs:
        run = drawn.judged(source.table)
        if run is not None and not capture_only(run.episodes):
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

    @classmethod
    def from_runs(cls, runs: Sequence[RunReader]) -> Self:
        """One that keeps no trajectories has a bar by `disc` alone. Raises UsageError without episodes."""
        if not runs or any(run.episodes.empty for run in runs):
            raise UsageError("there are no episodes to judge; give runs that have some")
        bars = [bar for run, name in zip(runs, full_names(runs), strict=True) for bar in _bars(run, name)]
        return cls(tuple(bars), tuple(map(ProvenanceLine.of_run, runs)))

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        runs = list(dict.fromkeys(bar.run for bar in self.bars))
        axes, figure = axes_for(ax, 6.2, 0.3 * len(self.bars) + 0.15 * len(runs) + 1.35)
        places = [at + 0.5 * runs.index(bar.run) for at, bar in enumerate(self.bars)]
        for height, bar in zip(places, self.bars, strict=True):
            _draw_rule(axes, height, bar)
        names = [f"{bar.run}  {bar.rule}" if len(runs) > 1 else bar.rule for bar in self.bars]
        _finish(axes, figure, names, places, "episodes (%), mean over categories")
        axes.set_xlim(0, 112)
        axes.set_xticks(range(0, 101, 25))
        caption(figure, *self.certificates)
        self.ax_ = axes
        return self


def _bars(run: RunReader, name: str) -> list[RuleBar]:
    judged = RunUnderRule.of(run, DEFAULT_RULE)
    if judged.verdicts is None:
        stored = {part: _over_categories(run, shares_of(run.episodes, part)) for part, *_ in _VERDICTS}
        return [RuleBar(name, rule, stored if rule == DEFAULT_RULE else None, None) for rule in RULES]
    return [
        RuleBar(
            name,
            rule,
            {part: _over_categories(run, verdicts[part]) for part, *_ in _VERDICTS},
            _over_categories(run, verdicts["idle"] == "correct"),
        )
        for rule, verdicts in judged.verdicts.items()
    ]


def _over_categories(run: RunReader, shares: "ArrayLike") -> float:
    """Return the mean over categories of a share (E,) per episode, in the order of the run's episodes."""
    values, categories = np.asarray(shares, dtype=float), run.episodes["category"].to_numpy()
    return float(np.mean([values[categories == name].mean() for name in np.unique(categories)]))


def _draw_rule(axes: "Axes", height: float, bar: RuleBar) -> None:
    if bar.shares is None:
        axes.text(1, height, "n/a: the run keeps no trajectories", va="center", fontsize=7.5, color="0.35")
        return
    start = 0.0
    for name, label, colour, hatch in _VERDICTS:
        width = 100 * bar.shares[name]
        axes.barh(height, width, 0.72, start, color=colour, hatch=hatch, ec="white", lw=0.5, label=label)
        start += width
    axes.text(101, height, f"{100 * bar.shares['correct']:.1f}", va="center", fontsize=8)
    if bar.idle:
        axes.plot(
            [100 * bar.idle] * 2, [height - 0.44, height + 0.44], color="black", lw=2, label="doing nothing scores"
        )


@in_report(4)
def rule_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield one of all runs that keep trajectories."""
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


def joins_of(runs: Sequence[RunReader], table: RetentionTable) -> tuple[list[KnownUsedTable], list[str]]:
    """Return answer, probe and success of every pair of a VLM run and a policy run, and why others are not joined.

    runs: those that the table is made of, as it reads them; probes, outcome rule and names are the table's. Tests
    are corrected over all pairs.
    """
    names = {row.run.location: row.run.label for row in table.rows}
    vlms = [run for run in runs if ask_of(run) is not None]
    policies = [
        run
        for run in runs
        if ask_of(run) is None
        and not capture_only(run.episodes)
        and can_be_judged(run, table.rule, table.last_steps)
    ]
    joins, refused = [], []
    for vlm, policy in product(vlms, policies):
        judged = under_rule(policy, table.rule, table.last_steps)
        try:
            joined = match_runs(vlm, judged, table.results_of(policy.location))
        except (UsageError, OtherFramesError) as error:
            refused.append(f"Not joined: {error}.")
            continue
        vlm_name, policy_name = (names.get(str(run.location), run.label) for run in (vlm, policy))
        joins.append(replace(joined, asked=vlm_name, acted=policy_name))
    return correct_joins(joins), refused


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
            _draw_items(axes, height, counts)
        axes.set_title(self.title, fontsize=9, loc="left")
        _finish(axes, figure, list(map(title_of, self.counts)), range(len(self.counts)), "items (%)")
        if figure is not None:
            footer(figure, self.note)
        self.ax_ = axes
        return self


def words_of(code: str) -> str:
    """Return `101` as "answer right, probe not, success"."""
    names = (("answer right", "answer not"), ("probe right", "probe not"), ("success", "no success"))
    parts = zip(names, code, strict=True)
    return ", ".join(right if mark == "1" else wrong for (right, wrong), mark in parts if mark != "-")


def _draw_items(axes: "Axes", height: int, counts: Mapping[str, int]) -> None:
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


@in_report(6)
def known_used_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield one per pair of a VLM run and a policy run."""
    joins, _ = joins_of([drawn.run for drawn in source.runs], source.table)
    for number, joined in enumerate(joins, 1):
        yield known_used_figure(joined, number)


def known_used_figure(joined: KnownUsedTable, number: int = 1) -> ReportFigure:
    """Return the figure of a join."""
    return ReportFigure(
        f"known-used-{number}", "Answer, probe, success", "join",
        "Every question once: does the VLM answer right, is the probe of the policy right, and does the cube "
        "end right, each in both layouts. An item with both and without success may be lost on the way.",
        None, partial(figure_of, KnownUsedDisplay.from_join, joined),
    )  # fmt: skip
