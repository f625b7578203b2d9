"""The lines of a table of several runs: of every category first its runs, then what they differ by."""

from collections.abc import Callable, Mapping, Sequence

from probe_kit.retention.columns.text import (
    action_share,
    action_value,
    area_value,
    backbone_share,
    backbone_value,
    bounded_value,
    call_value,
    category_name,
    debiased_value,
    difference_test,
    model_name,
    number,
    retention_value,
    success_interval,
    success_value,
    view_name,
)
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.estimators.bootstrap_draws import Limits
from probe_kit.retention.rows.row import MEAN, RetentionRow

TableRow = RetentionRow | Difference
Cell = Callable[[RetentionRow], str]


def compared(rows: Sequence[RetentionRow], differences: Sequence[Difference] = ()) -> list[TableRow]:
    """Rows of one run as they are; those of several by category, each followed by its differences, means last."""
    if len({(row.group, row.run) for row in rows}) < 2:
        return list(rows)
    categories = list(dict.fromkeys(row.category for row in rows))
    ordered = sorted(categories, key=lambda name: name == MEAN)
    shown = _among(rows, differences)
    lines: list[TableRow] = [*rows, *shown]
    return [line for name in ordered for line in lines if line.category == name]


def behaviour_lines(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[TableRow]:
    """Lines of success rates. rows: once per category and run."""
    once = {(row.group, row.minus, row.category): row for row in reversed(differences) if row.sr is not None}
    return compared(rows, list(once.values())[::-1])


def probe_lines(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[TableRow]:
    """Lines of probes, view by view."""
    views = dict.fromkeys(row.view for row in rows)
    known = [row for row in differences if row.backbone_accuracy is not None or row.action_accuracy is not None]
    return [
        line
        for view in views
        for line in compared([r for r in rows if r.view == view], [d for d in known if d.view == view])
    ]


def _among(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[Difference]:
    """Those between runs, or groups, that both have rows here."""
    names = {model_name(row) for row in rows} | {row.group for row in rows}
    return [row for row in differences if {row.group, row.minus} <= names]


def cell_of(cell: Cell, line: TableRow) -> str:
    """What stands in a column in any line; nothing where differences have no such number."""
    if isinstance(line, RetentionRow):
        return cell(line)
    own = _OF_DIFFERENCES.get(cell)
    return "" if own is None else own(line)


def difference_name(row: Difference) -> str:
    """Who less whom, and whether they ran other items."""
    return f"{row.group} − {row.minus}" + ("" if row.paired else " (other items)")


def difference_legend(differences: Sequence[Difference], behaviour: bool = True) -> str:
    """How differences and their intervals are made; empty without any. behaviour: whether SR is among them."""
    if not differences:
        return ""
    drawn = (
        "whole groups of items drawn, the same for both sides" if any(row.paired for row in differences) else ""
    )
    own = "" if all(row.paired for row in differences) else "of other items: each side's own groups drawn"
    tests = "p of SR: exact, signs of groups flipped, in means over all items (Holm: all categories and pairs)"
    shown = tests if behaviour and any(row.p is not None for row in differences) else ""
    probes = "best sites held fixed" if any(row.backbone_accuracy is not None for row in differences) else ""
    return "differences: 95 %, " + "; ".join(filter(None, [drawn, own, probes, shown]))


def _points(value: float | None, limits: Limits | None, scale: float = 100.0, digits: int = 1) -> str:
    """A signed value with its interval."""
    if value is None:
        return "–"
    if limits is None:
        return f"{scale * value:+.{digits}f}"
    low, high = limits
    if low is None or high is None:
        return f"{scale * value:+.{digits}f} [unbounded]"
    return f"{scale * value:+.{digits}f} [{scale * low:+.{digits}f}, {scale * high:+.{digits}f}]"


def _ratio(value: float | None, limits: Limits | None) -> str:
    return _points(value, limits, 1.0, 2)


def _test(row: Difference) -> str:
    return "" if row.p is None else f"{_p(row.p)} ({_p(row.p_holm)})"


def _p(value: float | None) -> str:
    return "<0.001" if value is not None and value < 0.001 else number(value, 3)


def _success(row: Difference) -> str:
    return _points(row.sr, row.sr_ci)


def _prefix(row: Difference) -> str:
    return _points(row.backbone_accuracy, row.backbone_ci)


def _action(row: Difference) -> str:
    return _points(row.action_accuracy, row.action_ci)


def _bounded(row: Difference) -> str:
    return _ratio(row.retention_bounded, row.retention_bounded_ci)


_OF_DIFFERENCES: Mapping[Cell, Callable[[Difference], str]] = {
    model_name: difference_name,
    category_name: lambda row: row.category,
    view_name: lambda row: row.view or "–",
    call_value: lambda row: "–" if row.call is None else str(row.call),
    success_interval: _success,
    success_value: _success,
    backbone_value: _prefix,
    backbone_share: _prefix,
    action_value: _action,
    action_share: _action,
    retention_value: _bounded,
    bounded_value: _bounded,
    area_value: lambda row: _ratio(row.retention_area, row.retention_area_ci),
    debiased_value: lambda row: _ratio(row.retention, row.retention_ci),
    difference_test: _test,
}
"""What differences say in the columns that they share with runs."""
