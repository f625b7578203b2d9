"""Probes of a label for a terminal: a table of the best sites, and a sentence per view."""

from typing import TYPE_CHECKING

from probe_kit._system.counting import counted
from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable
from probe_kit.hooks.contract.sites import label_of
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.labels.label_results import METRICS, LabelControl, LabelResults

if TYPE_CHECKING:
    import pandas as pd

_LEGEND = "The score of a chosen site is too high. Chance: mean score of this site with exchanged labels"


def label_table(results: LabelResults, splits: bool = True) -> ResponsiveTable:
    """A row per stream and view for its best site, and a row per control."""
    own, several = results.settings, len(results.settings.views) > 1
    names: list[str] = []
    cells: list[tuple[str, ...]] = []
    for row in _best(results):
        names.append(" · ".join([label_of(row["stream"]), *[row["view"]] * several]))
        score = f"{row['score']:.3f} [{row['ci_low']:.3f}, {row['ci_high']:.3f}]"
        shown, missed = _exceeded(results, row)
        exceeds = "; ".join([", ".join(shown)] * bool(shown) + [f"not shown: {', '.join(missed)}"] * bool(missed))
        cells.append((str(row["site"]), score, _number(row["chance"]), _number(row["p_fwe"]), exceeds or "–"))
    for control in results.controls.scores:
        of = [label_of(control.stream)] * bool(control.stream) + [control.view] * (several and bool(control.view))
        names.append(" · ".join([f"control {control.name}", *of]))
        cells.append(_control(control))
    metric = METRICS[own.task]
    said = [f"{own.target}: {metric}", own.task, *[f"view {own.views[0]}"] * (not several)]
    said += [f"from {own.align_to.partition('#')[0]} on"] * bool(own.align_to)
    said += ["RANDOM WEIGHTS"] * own.random_weights
    return ResponsiveTable(
        title=", ".join(said),
        caption=_LEGEND,
        name="stream",
        names=tuple(names),
        styles=("",) * len(names),
        parts=(
            Part(
                "Best sites",
                ("best site", f"{metric} [95 %]", "chance", "family-wise p", "exceeds"),
                tuple(tuple(map(Cell, row)) for row in cells),
            ),
        ),
        splits=splits,
    )


def label_sentences(results: LabelResults) -> list[str]:
    """What was left out, then one per view: in which streams the label can be decoded."""
    own = results.settings
    found = [f"left out: {count} {reason}" for reason, count in results.left_out.items()]
    found += [f"control {name} was not run: {reason}" for name, reason in results.controls.left_out.items()]
    groups = int(results.scores["groups"].iloc[0])
    for view in own.views:
        parts = "; ".join(_in_stream(results, row) for row in _best(results) if row["view"] == view)
        of = f"{counted(groups, 'group')}, {counted(results.labels.size, 'sample')}" + (
            f", view {view}" if len(own.views) > 1 else ""
        )
        found.append(f"{own.target} ({of}) is {parts}.")
    return found


def _best(results: LabelResults) -> "list[pd.Series]":
    """The row of `scores` of the best site of every view and stream: the largest excess over chance."""
    scores = results.scores
    excess = scores["score"] - scores["chance"].fillna(0.0)
    found = excess.groupby([scores["view"], scores["stream"]], sort=False).idxmax()
    return [scores.loc[number] for number in found]


def _exceeded(results: LabelResults, row: "pd.Series") -> tuple[list[str], list[str]]:
    """What a site is shown to exceed, and what it is not shown to exceed."""
    verdicts = {name: bool(row[f"exceeds_{name}"]) for name in results.controls.names}
    if row["p_fwe"] == row["p_fwe"]:
        verdicts = {"chance": bool(row["p_fwe"] < SIGNIFICANCE), **verdicts}
    return [name for name in verdicts if verdicts[name]], [name for name in verdicts if not verdicts[name]]


def _in_stream(results: LabelResults, row: "pd.Series") -> str:
    where = f"in the {label_of(row['stream'])}"
    numbers = f"({row['metric']} {row['score']:.2f}, {row['ci_low']:.2f} to {row['ci_high']:.2f}"
    if row["p_fwe"] != row["p_fwe"]:
        return f"not tested {where} {numbers})"
    numbers += f"; chance {row['chance']:.2f})"
    missed = _exceeded(results, row)[1]
    if missed:
        beyond = " and ".join(filter(None, [", ".join(missed[:-1]), missed[-1]]))
        return f"not shown {where} beyond {beyond} {numbers}"
    return f"decodable {where} at {row['site']} {numbers}"


def _control(control: LabelControl) -> tuple[str, ...]:
    low, high = control.ci
    p = "–" if control.p is None else f"{control.p:.3f} (this control alone)"
    return "", f"{control.score:.3f} [{low:.3f}, {high:.3f}]", _number(control.chance), p, ""


def _number(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.3f}"
