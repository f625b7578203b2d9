"""Tables with a row per system and a column per category: success rates, sides, scores and probes."""

from collections.abc import Callable, Sequence

from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.columns.text import percent
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.table import RetentionTable
from probe_kit.study.tables.named_table import NamedTable, Number, ordered, titles

MARKS = {Regime.KNOWLEDGE: " ↑", Regime.FAILURE: " ↓"}
_MARKED = "↑ above what guessing reaches, ↓ below it, at 95 % with items as the unit"
_MEAN = "the mean is over the categories that a system has"
Cell = Callable[[RetentionRow], str]


def success_table(table: RetentionTable) -> NamedTable:
    """Success rates of policies, and shares right of VLMs, by system and category; the mean last."""
    return _pivot(table, "Success rate %", f"{_MARKED}; {_MEAN}", success_cell)


def success_cell(row: RetentionRow) -> str:
    """The rate in percent with the mark of its regime; a mean has none."""
    own = row.success
    if own.sr is None:
        return "–"
    return percent(own.sr) + ("" if own.regime is None else MARKS.get(own.regime, ""))


def sides_table(table: RetentionTable) -> NamedTable:
    """Success rates where the correct picture lay on the left and on the right."""
    note = f"left / right: side of the correct picture; {_MEAN}"
    return _pivot(
        table, "Success rate % by side", note, lambda row: _two(row.success.sr_left, row.success.sr_right)
    )


def _two(left: float | None, right: float | None) -> str:
    return "–" if left is None and right is None else f"{percent(left)} / {percent(right)}"


def score_table(table: RetentionTable) -> NamedTable:
    """The normalised score of every system: 0 for guessing, 100 for perfection."""
    means = [row for row in once_per_run(table.means) if row.success.sr is not None]
    cells = tuple(
        (
            row.run.label,
            "–" if row.success.normalised_score is None else f"{row.success.normalised_score:.2f}",
            percent(row.success.sr),
            str(len(row.categories)),
        )
        for row in means
    )
    numbers = [
        {
            "system": row.run.label,
            "score": row.success.normalised_score,
            "sr": row.success.sr,
            "ci": row.success.ci,
        }
        for row in means
    ]
    note = "score = (mean % − 50) / 50 × 100 over the categories of a system"
    columns = ("system", "score", "mean %", "categories")
    return NamedTable(TextTable("Normalised score", note, columns, cells), tuple(numbers))


def probing_table(table: RetentionTable) -> NamedTable:
    """Best accuracy in the backbone and where the action is made, and retention, as means over the categories."""
    cells = tuple(
        (
            row.run.label,
            row.view or "–",
            percent(row.backbone.score),
            percent(row.action.score),
            _ratio(row.retention.value if row.retention.defined else None),
            _ratio(row.retention.published),
            str(len(row.categories)),
        )
        for row in table.means
    )
    numbers = [
        {
            "system": row.run.label,
            "category": row.category,
            "view": row.view,
            "backbone": row.backbone.score,
            "backbone_ci": row.backbone.ci,
            "action": row.action.score,
            "action_ci": row.action.ci,
            "retention": row.retention.value,
            "retention_ci": row.retention.ci,
            "retention_defined": row.retention.defined,
            "published": row.retention.published,
        }
        for row in table.all_rows
    ]
    note = "cross-fitted scores of the best sites; published: the paper's mean of ratios per category"
    columns = ("system", "view", "backbone %", "action %", "retention", "published", "categories")
    return NamedTable(TextTable("Probes", note, columns, cells), tuple(numbers))


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def once_per_run(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """Rows of the first view of each run and category; rates do not depend on views."""
    return list({(row.run.location, row.category): row for row in reversed(rows)}.values())[::-1]


def _pivot(table: RetentionTable, title: str, note: str, cell: Cell) -> NamedTable:
    rows = once_per_run([*table.rows, *table.means])
    categories = ordered([row.category for row in rows if row.category != MEAN])
    by_place = {(row.run.label, row.category): row for row in rows}
    systems = list(dict.fromkeys(row.run.label for row in rows))
    columns = ("system", *titles(categories), MEAN)
    cells = tuple(
        (name, *(cell(by_place[name, one]) if (name, one) in by_place else "–" for one in (*categories, MEAN)))
        for name in systems
    )
    return NamedTable(TextTable(title, note, columns, cells), tuple(_number(row) for row in rows))


def _number(row: RetentionRow) -> Number:
    own = row.success
    return {
        "system": row.run.label,
        "run": row.run.location,
        "category": row.category,
        "sr": own.sr,
        "ci": own.ci,
        "left": own.sr_left,
        "right": own.sr_right,
        "episodes": own.n_episodes,
        "items": own.n_items,
        "margin": own.chance_margin,
        "regime": None if own.regime is None else str(own.regime),
        "normalised_score": own.normalised_score,
    }
