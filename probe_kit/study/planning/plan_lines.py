"""The plan of a study in a terminal: a line per run, then what all of them take."""

from typing import TYPE_CHECKING

from probe_kit._system.counting import counted
from probe_kit._terminal.console import marked, out

if TYPE_CHECKING:
    from probe_kit.study.planning.plan import StudyPlan


def print_plan(plan: "StudyPlan") -> None:
    """Print runs with their state, totals, hours and bytes with their source, and what is skipped."""
    from rich.table import Table

    name = plan.study.study.name
    table = Table("model", "run", "blocks", "episodes", "inferences", "state", title=f"study {name}", box=None)
    for column in table.columns[3:5]:
        column.justify = "right"
    for one in plan.cells:
        cell = one.cell
        way = cell.way + (f", seed {cell.seed}" if cell.seed else "")
        inferences = "–" if cell.asks else f"{cell.inferences:,}"
        cells = (cell.model, way, ", ".join(cell.selections), f"{cell.episodes:,}", inferences)
        table.add_row(*(marked("{}", text) for text in (*cells, one.words)))
    out.print(table)
    for line in (*_totals(plan), *_cost(plan), *_skipped(plan)):
        out.print(line, highlight=False, markup=False, soft_wrap=True)


def _totals(plan: "StudyPlan") -> list[str]:
    totals, suite = plan.totals(), plan.study.suite
    unprobed = f"; probes of {counted(totals['unprobed'], 'run')}" if totals["unprobed"] else ""
    return [
        f"suite: {suite.identity}; items from {suite.source}",
        f"{counted(totals['runs'], 'run')}, {counted(totals['episodes'], 'episode')} ({totals['acted']:,} acted, "
        f"{totals['captured']:,} captured without acting, {totals['asked']:,} asked), at most "
        f"{counted(totals['inferences'], 'inference')} of policies (given by shape: no model was loaded)",
        f"missing: {counted(totals['missing'], 'episode')}{unprobed}",
    ]


def _cost(plan: "StudyPlan") -> list[str]:
    """Hours, each with the source of its rate, and bytes, of what is missing."""
    from probe_kit.runs.disk import in_units

    cost, lines = plan.cost, list[str]()
    for source in dict.fromkeys(cost.sources.values()):
        hours = {model: own for model, own in cost.hours.items() if cost.sources[model] == source}
        each = ", ".join(f"{model} {value:.2g}" for model, value in hours.items())
        where = "calibrated here" if source == "calibrated" else "measured in stored episodes"
        lines.append(f"hours, {where}: {sum(hours.values()):.2g} ({each})")
    if cost.unmeasured:
        lines.append(f"hours unknown (--calibrate measures them): {', '.join(cost.unmeasured)}")
    if cost.bytes:
        lines.append(f"bytes: up to {in_units(sum(cost.bytes.values()))} before compression")
    if cost.unsized:
        lines.append(f"bytes unknown before the model is loaded: {', '.join(cost.unsized)}")
    return lines


def _skipped(plan: "StudyPlan") -> list[str]:
    return [f"skipped: {model}: {reason}" for model, reason in plan.skipped().items()]
