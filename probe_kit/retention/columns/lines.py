"""The rows of a table of several runs: of every category first its runs, then what they differ by."""

from collections.abc import Sequence

from probe_kit.retention.columns.text import P_DECIDES, model_name
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow

TableRow = RetentionRow | Difference


def compared(rows: Sequence[RetentionRow], differences: Sequence[Difference] = ()) -> list[TableRow]:
    """Rows of one run as they are; those of several by category, each followed by its differences, means last."""
    if len({row.key for row in rows}) < 2:
        return list(rows)
    categories = list(dict.fromkeys(row.category for row in rows))
    ordered = sorted(categories, key=lambda name: name == MEAN)
    lines: list[TableRow] = [*rows, *_among(rows, differences)]
    return [line for name in ordered for line in lines if line.category == name]


def behaviour_lines(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[TableRow]:
    """Lines of success rates. rows: once per category and run."""
    once = {(row.group, row.minus, row.category): row for row in reversed(differences) if row.sr is not None}
    return compared(rows, list(once.values())[::-1])


def probe_lines(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[TableRow]:
    """Lines of probes, view by view."""
    views = dict.fromkeys(row.view for row in rows)
    known = [row for row in differences if row.backbone is not None or row.action is not None]
    return [
        line
        for view in views
        for line in compared([r for r in rows if r.view == view], [d for d in known if d.view == view])
    ]


def _among(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[Difference]:
    """Those between runs, or groups, that both have rows here."""
    names = {model_name(row) for row in rows} | {row.group for row in rows}
    return [row for row in differences if {row.group, row.minus} <= names]


def difference_legend(differences: Sequence[Difference], behaviour: bool = True) -> str:
    """How differences and their intervals are made; empty without any. behaviour: whether SR is among them."""
    if not differences:
        return ""
    drawn = "groups of items as pairs" if any(row.paired for row in differences) else ""
    own = "" if all(row.paired for row in differences) else "of other items: each side's own groups"
    tests = (
        "p of the share right: exact, signs of groups flipped, in means over all items (Holm: all categories and "
        f"pairs); {P_DECIDES}"
    )
    shown = tests if behaviour and any(row.p is not None for row in differences) else ""
    models = "these models, other items" if any(row.sr_models for row in differences) else ""
    return "differences: 95 %, " + "; ".join(filter(None, [drawn, own, shown, models]))
