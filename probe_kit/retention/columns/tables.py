"""The tables of a retention table: groups of columns over the rows of runs, and below them their differences."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import span
from probe_kit._tables.table import Cell, Heading, Row, Table
from probe_kit.retention.choices import Section
from probe_kit.retention.columns.columns import TABLES, Column, ColumnGroup, radius_columns
from probe_kit.retention.columns.sentences import chance_only
from probe_kit.retention.columns.text import (
    ABOVE_CHANCE,
    P_DECIDES,
    TERMS,
    by_run,
    call_words,
    difference_name,
    is_vlm,
    model_name,
    modes_of,
    name_of,
    once_per_category,
    title_of,
)
from probe_kit.retention.compare.compare import Difference, behaviour_once
from probe_kit.retention.rows.outcome_rules import rule_sentence
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.statistics.significance import detectable

TableRow = RetentionRow | Difference
SUBJECTS = {
    "Accuracy of answers": "behaviour",
    "Success rate": "behaviour",
    "Retention": "retention",
    "Controls": "controls",
}
"""By title, what a table is about."""
BEHAVIOUR = tuple(title for title, subject in SUBJECTS.items() if subject == "behaviour")
"""Tables that depend on no view of the probes."""


def retention_tables(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    unpaired: Sequence[str] = (),
    sections: Collection[Section] | None = None,
) -> dict[str, Table]:
    """Return by title the answers of VLM runs, success rates of policy runs, retention and controls.

    A table without rows is left out, and a column in which no row has anything to show. unpaired: why runs have no
    differences; notes of the last table of behaviour. sections: groups of columns that are shown, all by default.
    """
    once, probed = once_per_category(rows), [row for row in rows if row.view is not None]
    is_controlled = any(row.controls.baselines or row.controls.untrained for row in probed)
    rows_of = {
        "Accuracy of answers": [row for row in once if row.is_side and is_vlm(row)],
        "Success rate": [row for row in once if row.is_side and not is_vlm(row)],
        "Retention": probed,
        "Controls": probed if is_controlled else [],
    }
    # Said once, below the last table that it is about.
    last = next((title for title in reversed(BEHAVIOUR) if rows_of[title]), None)
    tables = {}
    for title, of_table in rows_of.items():
        groups = [group for group in _groups(title, of_table) if sections is None or group.section in sections]
        if of_table and groups:
            gaps = [] if title == "Controls" else _differences(of_table, differences, title in BEHAVIOUR)
            why_unpaired = unpaired if title == last else ()
            table = _table(title, groups, of_table, gaps, why_unpaired)
            if len(table.headings) > table.names:
                tables[title] = table
    return tables


def _groups(title: str, rows: Sequence[RetentionRow]) -> list[ColumnGroup]:
    radii = radius_columns(rows) if title in BEHAVIOUR else ()
    return [*TABLES[title], *[ColumnGroup("By zone radius", radii, True)] * bool(radii)]


def _differences(
    rows: Sequence[RetentionRow], differences: Sequence[Difference], behaviour: bool
) -> list[Difference]:
    """Return those between runs, or groups, that both have rows; of behaviour once, whatever number of views."""
    names = {model_name(row) for row in rows} | {row.group for row in rows}
    among = [row for row in differences if {row.group, row.minus} <= names]
    if not behaviour:
        views = {row.view for row in rows}
        return [row for row in among if row.view in views and not (row.backbone is None and row.action is None)]
    return behaviour_once(among)


def _table(
    title: str,
    groups: Sequence[ColumnGroup],
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference],
    why_unpaired: Sequence[str],
) -> Table:
    modes = modes_of(rows)
    lines = _ordered(rows, differences)
    columns = [
        (column.worded(modes), group)
        for group in groups
        for column in group.columns
        if any(cell_text(column, line) not in ("–", "") for line in lines)
    ]
    names = _name_columns(title, rows, differences)
    tested = any(column.key == "difference.p" for column, _ in columns)
    notes = [*_legend(title, rows), _difference_legend(differences, tested), *why_unpaired, *_sizes(rows)]
    return Table(
        title=_title(title, rows),
        headings=(
            *(heading for heading, _ in names),
            *(Heading(column.heading, column.help, group.title, group.detail) for column, group in columns),
        ),
        rows=tuple(
            Row(
                (*(Cell(text(line)) for _, text in names), *(_cell(column, line) for column, _ in columns)),
                is_mean=line.category == MEAN,
                is_difference=isinstance(line, Difference),
            )
            for line in lines
        ),
        names=len(names),
        notes=tuple(filter(None, notes)),
    )


def _ordered(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[TableRow]:
    """Return the lines by category, means last; in each the runs of a view, and behind them their differences."""
    categories = list(dict.fromkeys(row.category for row in rows))
    views = list(dict.fromkeys(row.view for row in rows))
    by_view = {view: at for at, view in enumerate(views)}
    several = len({row.key for row in rows}) > 1
    lines: list[TableRow] = [*rows, *differences]
    if not several and len(views) < 2:
        return lines
    return sorted(
        lines,
        key=lambda line: (
            line.category == MEAN, categories.index(line.category), by_view.get(line.view, 0),
            isinstance(line, Difference),
        ),
    )  # fmt: skip


def _name_columns(
    title: str, rows: Sequence[RetentionRow], differences: Sequence[Difference]
) -> list[tuple[Heading, Callable[[TableRow], str]]]:
    """Return the columns that tell rows apart: the category, and of several runs, views or calls which one."""

    def name(line: TableRow) -> str:
        return title_of(line.category) if isinstance(line, Difference) else name_of(line)

    def run(line: TableRow) -> str:
        return difference_name(line) if isinstance(line, Difference) else model_name(line)

    def call(line: TableRow) -> str:
        number = line.call if isinstance(line, Difference) else line.run.call
        return "–" if number is None else str(number)

    names: list[tuple[Heading, Callable[[TableRow], str]]] = [
        (Heading("category", "Kind of question."), name)
        if all(row.is_side for row in rows)
        else (Heading("label", "What the probes decode, and in which category."), name)
    ]
    if differences or len({row.key for row in rows}) > 1:
        names.append((Heading("run", "A run, or two of which the second is subtracted."), run))
    if title in BEHAVIOUR:
        return names
    if len({row.view for row in rows}) > 1:
        help_ = "How the tokens of an episode became one vector."
        names.append((Heading("view", help_), lambda line: line.view or "–"))
    if len({row.run.call for row in rows}) > 1:
        names.append((Heading("call", TERMS["call"]), call))
    return names


def _title(title: str, rows: Sequence[RetentionRow]) -> str:
    """Return what the table shows, of one view and one run by their names, and the suites."""
    views, runs = ({row.view for row in rows}, {model_name(row): None for row in rows})
    view = f", view {rows[0].view}" if title not in BEHAVIOUR and len(views) == 1 else ""
    model = f"{next(iter(runs))} on " if len(runs) == 1 else ""
    targets = list(dict.fromkeys(row.target for row in rows if not row.is_side))
    of_label = f" of {targets[0]}" if len(targets) == 1 else " of labels" * bool(targets)
    return f"{title}{of_label}{view}: {model}{', '.join(dict.fromkeys(row.run.suite for row in rows))}"


def cell_text(column: Column, line: TableRow) -> str:
    """Return what stands in a column; nothing where differences have no such number."""
    if isinstance(line, RetentionRow):
        return column.text(line)
    return "" if column.difference is None else column.difference(line)


def _cell(column: Column, line: TableRow) -> Cell:
    text = cell_text(column, line)
    if isinstance(line, Difference):
        return Cell(text)
    value = column.sort_value(line)
    return Cell(
        text,
        sort=value,
        heat=value if column.heat and isinstance(value, float) else None,
        strong=column.strong is not None and column.strong(line),
        alarm=text.endswith(ABOVE_CHANCE),
        note=column.note(line) if column.note else "",
    )


# -- notes -------------------------------------------------------------------------------------------------------

_ANSWERS = "wrong and unread (no answer, or several) in % of all"
_OUTCOMES = (
    "Δ decides the regime, over as many items as count; wrong, outside, never moved (part of outside): each in % "
    "of all episodes"
)
_SITES = (
    "layer: the first of the best, + as many others that tie; after @ the iteration (flow step or action token), "
    "of which the first sees no action yet; p family-wise"
)
_ABOVE = (
    "above chance: score of the sites that the inner folds choose, on the outer folds, minus its mean score with "
    "permuted labels; 95 % intervals over groups; layer: that of the largest score above its own chance; p "
    "family-wise"
)
_ANSWER_SITES = "layer: the first of the best, + as many others that tie; p family-wise"


def _legend(title: str, rows: Sequence[RetentionRow]) -> list[str]:
    if title == "Accuracy of answers":
        scores = ", ".join(dict.fromkeys(str(row.answers.score) for row in rows))
        return [f"accuracy is by {scores}; a constant answer is right in one half; {_ANSWERS}"]
    if title == "Success rate":
        return [_OUTCOMES, *dict.fromkeys(rule_sentence(row.rules) for row in rows if row.category == MEAN)]
    calls = sorted({row.run.call for row in rows if row.run.call is not None})
    of_call = [call_words(calls[0])] if len(calls) == 1 else []
    if not all(row.is_side for row in rows):
        return [_ABOVE, *_undefined(rows)]
    if title == "Retention":
        sites = _ANSWER_SITES if modes_of(rows) == "answers" else _SITES
        return [sites, *_undefined(rows), chance_only(rows), *of_call]
    return [_controls(rows), *of_call]


def _undefined(rows: Sequence[RetentionRow]) -> list[str]:
    """Return why categories have no retention, each reason once with its categories."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if not row.retention.defined and row.category != MEAN:
            reasons.setdefault(row.retention.note, []).append(name_of(row))
    means = {row.retention.note for row in rows if row.retention.defined and row.retention.note}
    sentences = [f"{reason}: {', '.join(dict.fromkeys(names))}" for reason, names in reasons.items()]
    return [*sentences, *(f"mean {note}" for note in sorted(means))]


def _controls(rows: Sequence[RetentionRow]) -> str:
    name = rows[0].controls.untrained
    untrained = f"; untrained: {name}" if name else ""
    fewest = min(row.success.n_items for row in rows if row.category != MEAN)
    share = f"{100 * detectable(fewest):.1f}"
    findable = f"with {counted(fewest, 'item')} a leak of {share} % is found in 4 of 5 suites"
    return (
        f"held-out accuracy % without the model, {findable}; selectivity: accuracy above random labels{untrained}"
    )


def _difference_legend(differences: Sequence[Difference], has_tests: bool) -> str:
    """Return how differences and their intervals are made; empty without any."""
    if not differences:
        return ""
    parts = [
        "groups of items as pairs" * any(row.paired for row in differences),
        "of other items: each side's own groups" * (not all(row.paired for row in differences)),
    ]
    if has_tests and any(row.p is not None for row in differences):
        parts.append(
            "p of the share right: exact, signs of groups flipped, in means over all items (Holm: all categories "
            f"and pairs); {P_DECIDES}"
        )
    parts.append("these models, other items" * any(row.sr_models for row in differences))
    return "differences: 95 %, " + "; ".join(filter(None, parts))


def _sizes(rows: Sequence[RetentionRow]) -> list[str]:
    """Return per run its folder and the range of its sizes; one sentence where runs have the same."""
    sizes: dict[str, list[str]] = {}
    for of_run in by_run([row for row in rows if row.category != MEAN]):
        sizes.setdefault(_size(of_run), []).append(Path(of_run[0].run.location).name)
    return [f"run{'s' * (len(names) > 1)} {', '.join(names)}: {size}" for size, names in sizes.items()]


def _size(rows: Sequence[RetentionRow]) -> str:
    is_of_sides = all(row.is_side for row in rows)
    samples = [row.success.n_episodes if is_of_sides else row.controls.n_samples or 0 for row in rows]
    parts = [f"{span(samples)} {'episodes' if is_of_sides else 'samples'}"]
    parts += [f"{span([row.success.n_items for row in rows])} items"] * is_of_sides
    if groups := [row.controls.n_groups for row in rows if row.controls.n_groups is not None]:
        parts.append(f"{span(groups)} groups")
    return f"per {'category' if is_of_sides else 'label'} {', '.join(parts)}"
