"""The tables of runs, as every format shows them: groups of columns, rows and captions."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from probe_kit.retention.choices import Section
from probe_kit.retention.columns.columns import TABLES, Column, ColumnGroup, radius_columns
from probe_kit.retention.columns.conditions import rule_sentences
from probe_kit.retention.columns.lines import (
    TableRow,
    behaviour_lines,
    compared,
    difference_legend,
    probe_lines,
)
from probe_kit.retention.columns.modes import modes_of
from probe_kit.retention.columns.sentences import chance_only
from probe_kit.retention.columns.text import controlled, is_vlm, once_per_category, probed
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.statistics.significance import detectable

_ROLES = {
    "Success rate": "behaviour",
    "Accuracy of answers": "behaviour",
    "Retention": "retention",
    "Controls": "controls",
}


@dataclass(frozen=True)
class Table:
    """A table of runs. parts: only columns in which some row has something to show.

    subject: `behaviour`, `retention` or `controls`. by_view: whether its rows have a view of the tokens and a
    call, which formats without a column for them say in a title. captions: sentences below it.
    """

    title: str
    subject: str
    parts: tuple[ColumnGroup, ...]
    rows: tuple[TableRow, ...]
    captions: tuple[str, ...]

    @property
    def by_view(self) -> bool:
        """Whether its rows are of probes in a view."""
        return self.subject != "behaviour"

    @property
    def columns(self) -> tuple[Column, ...]:
        """Of all parts, in order."""
        return tuple(column for part in self.parts for column in part.columns)

    @property
    def run_rows(self) -> list[RetentionRow]:
        """Rows of runs, without differences."""
        return [row for row in self.rows if isinstance(row, RetentionRow)]

    def only(self, sections: Collection[Section]) -> "Table | None":
        """The same with the parts of some sections; None without any."""
        parts = tuple(part for part in self.parts if part.section in sections)
        return replace(self, parts=parts) if parts else None

    def without_details(self) -> "Table":
        """The same without columns that need room."""
        return replace(self, parts=tuple(part for part in self.parts if not part.detail))

    def details(self) -> "Table | None":
        """Only those columns, without captions; None if there are none."""
        parts = tuple(part for part in self.parts if part.detail)
        return replace(self, title=f"{self.title}: details", parts=parts, captions=()) if parts else None


def cell_text(column: Column, row: TableRow) -> str:
    """What stands in a column; nothing where differences have no such number."""
    if isinstance(row, RetentionRow):
        return column.text(row)
    return "" if column.difference is None else column.difference(row)


def tables_of(
    rows: Sequence[RetentionRow], differences: Sequence[Difference] = (), unpaired: Sequence[str] = ()
) -> list[Table]:
    """Answers of VLM runs, success rates of policy runs, retention and controls, as far as there are any.

    unpaired: why runs have no differences; captions of the tables of success rates.
    """
    once = once_per_category(rows)
    tables = []
    for title, own in (
        ("Accuracy of answers", [row for row in once if is_vlm(row)]),
        ("Success rate", [row for row in once if not is_vlm(row)]),
    ):
        if own:
            extra = [ColumnGroup("By zone radius", radius_columns(own), True)]
            tables.append(_table(title, behaviour_lines(own, differences), _legend(title, own), extra))
    if tables:
        tables[-1] = replace(tables[-1], captions=(*tables[-1].captions, *unpaired))
    if probed(rows):
        lines = probe_lines(probed(rows), differences)
        tables.append(_table("Retention", lines, _legend("Retention", probed(rows))))
    if controlled(rows):
        lines = [line for view in _views(rows) for line in compared([r for r in probed(rows) if r.view == view])]
        tables.append(_table("Controls", lines, _legend("Controls", probed(rows))))
    return tables


def views_of(table: Table) -> list[Table]:
    """A table per view, for formats that name the view in the title; the table itself if it has none."""
    if not table.by_view:
        return [table]
    return [
        _table(table.title, lines, _legend(table.title, [row for row in lines if isinstance(row, RetentionRow)]))
        for view in _views(table.run_rows)
        if (lines := [line for line in table.rows if line.view == view])
    ]


def _views(rows: Sequence[RetentionRow]) -> list[str | None]:
    return list(dict.fromkeys(row.view for row in probed(rows)))


def _table(
    title: str, lines: Sequence[TableRow], legend: Sequence[str], extra: Sequence[ColumnGroup] = ()
) -> Table:
    modes = modes_of(line for line in lines if isinstance(line, RetentionRow))
    parts = [
        replace(part, columns=shown)
        for part in (*TABLES[title], *extra)
        if (shown := tuple(column.worded(modes) for column in part.columns if _is_shown(column, lines)))
    ]
    tested = any(column.key == "difference.p" for part in parts for column in part.columns)
    differences = difference_legend([line for line in lines if isinstance(line, Difference)], tested)
    captions = tuple(_sentence(text) for text in (*legend, differences) if text)
    return Table(title, _ROLES[title], tuple(parts), tuple(lines), captions)


def _is_shown(column: Column, lines: Sequence[TableRow]) -> bool:
    return any(cell_text(column, line) not in ("–", "") for line in lines)


def _sentence(text: str) -> str:
    start = text if text.startswith("n/a") else f"{text[:1].upper()}{text[1:]}"
    return start if start.endswith(".") else f"{start}."


# -- captions ------------------------------------------------------------------------------------------------


def _legend(title: str, rows: Sequence[RetentionRow]) -> list[str]:
    if title == "Accuracy of answers":
        scores = ", ".join(dict.fromkeys(str(row.answers.score) for row in rows))
        return [f"accuracy is by {scores}; a constant answer is right in one half; {_ANSWERS}"]
    if title == "Success rate":
        return [_OUTCOMES, *rule_sentences(rows)]
    if title == "Retention":
        sites = _ANSWER_SITES if modes_of(rows) == "answers" else _SITES
        return [*filter(None, (sites, *_undefined(rows), chance_only(rows)))]
    return [_controls(rows)]


_ANSWERS = "wrong and unread (no answer, or several) in % of all"
_OUTCOMES = (
    "Δ decides the regime, over as many items as count; wrong, outside, never moved (part of outside): each in % "
    "of all episodes"
)
_SITES = (
    "layer: the first of the best, + as many others that tie; after @ the iteration (flow step or action token), "
    "of which the first sees no action yet; p family-wise"
)


_ANSWER_SITES = "layer: the first of the best, + as many others that tie; p family-wise"


def _undefined(rows: Sequence[RetentionRow]) -> list[str]:
    """Why categories have no retention, each reason once with its categories."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if not row.retention.defined and row.category != MEAN:
            reasons.setdefault(row.retention.note, []).append(row.category)
    means = {row.retention.note for row in rows if row.retention.defined and row.retention.note}
    found = [f"{reason}: {', '.join(dict.fromkeys(names))}" for reason, names in reasons.items()]
    return [*found, *(f"mean {note}" for note in sorted(means))]


def _controls(rows: Sequence[RetentionRow]) -> str:
    name = rows[0].controls.untrained
    untrained = f"; untrained: {name}" if name else ""
    fewest = min(row.success.n_items for row in rows if row.category != MEAN)
    share = f"{100 * detectable(fewest):.1f}"
    seen = f"with {fewest} items a leak of {share} % is found in 4 of 5 suites"
    return f"held-out accuracy % without the model, {seen}; selectivity: accuracy above random labels{untrained}"
