"""The tables of a retention table, of rows and of comparisons."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, count, groupby
from pathlib import Path

from probe_kit._system.counting import plural
from probe_kit._tables.numbers import NONE, number, percent, plain, points, span
from probe_kit._tables.table import Cell, Cells, Heading, Legend, Table, TableRow, absent
from probe_kit.retention.behaviour import rule_sentence
from probe_kit.retention.choices import Section
from probe_kit.retention.columns.columns import TABLES, Column, ColumnGroup, Labels, radius_columns
from probe_kit.retention.columns.text import (
    P_DECIDES,
    TERMS,
    by_run,
    call_words,
    chance_only,
    difference_name,
    difference_test,
    is_vlm,
    model_name,
    modes_of,
    name_of,
    success_interval,
    title_of,
)
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.compare.known_used import OVERALL, PAIRS, CategoryCounts, KnownUsedTable
from probe_kit.retention.compare.models import Relation
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.runs.reader import full_name
from probe_kit.statistics.significance import detectable

RowOrDifference = RetentionRow | Difference
SUBJECTS = {
    "Accuracy of answers": "behaviour",
    "Success rate": "behaviour",
    "Retention": "retention",
    "Controls": "controls",
}
"""The subject of a table, by its title."""
BEHAVIOUR = tuple(title for title, subject in SUBJECTS.items() if subject == "behaviour")
"""Tables that depend on no view of the probes."""


def retention_tables(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    unpaired: Sequence[str] = (),
    sections: Collection[Section] | None = None,
) -> dict[str, Table]:
    """Return by title the answers of VLM runs, success rates of policy runs, retention and controls.

    A table without rows is left out, and a column in which no row has anything to show.

    Args:
        rows: Rows of all runs, with their means.
        differences: Differences of runs or groups, shown below the rows of both.
        unpaired: Reasons why runs have no differences; notes of the last table of behaviour.
        sections: Groups of columns that are shown, all by default.
    """
    once, probed = once_per_category(rows), [row for row in rows if row.view is not None]
    is_controlled = any(row.controls.baselines or row.controls.untrained for row in probed)
    rows_of = {
        "Accuracy of answers": [row for row in once if not row.label and is_vlm(row)],
        "Success rate": [row for row in once if not (row.label or is_vlm(row))],
        "Retention": probed,
        "Controls": probed if is_controlled else [],
    }
    # Said once, below the last table that it is about.
    last = next((title for title in reversed(BEHAVIOUR) if rows_of[title]), None)
    tables = {}
    for title, of_table in rows_of.items():
        groups = [group for group in _groups(title, of_table) if sections is None or group.section in sections]
        if of_table and groups:
            among = [] if title == "Controls" else _differences(of_table, differences, title in BEHAVIOUR)
            why_unpaired = unpaired if title == last else ()
            table = _table(title, groups, of_table, among, why_unpaired)
            if len(table.headings) > table.names:
                tables[title] = table
    return tables


def labels_of(rows: Sequence[RetentionRow]) -> Labels:
    """Return whether none, some or all of the rows are of labels."""
    labelled = [bool(row.label) for row in rows]
    return "all" if all(labelled) else "some" if any(labelled) else "none"


def _groups(title: str, rows: Sequence[RetentionRow]) -> list[ColumnGroup]:
    radii = radius_columns(rows) if title in BEHAVIOUR else ()
    return [*TABLES[title], ColumnGroup("By zone radius", radii, True)] if radii else list(TABLES[title])


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


def once_per_category(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """Return the first row of each run and category, as success rates do not depend on the view."""
    # Twice reversed: of a key named twice a dict keeps the first place and the last value.
    return list({(row.run.location, row.category): row for row in reversed(rows)}.values())[::-1]


def behaviour_once(differences: Sequence[Difference]) -> list[Difference]:
    """Return each difference of success rates once, whatever number of views there are."""
    once = {(row.group, row.minus, row.category): row for row in reversed(differences) if row.sr is not None}
    return list(once.values())[::-1]


def _table(
    title: str,
    groups: Sequence[ColumnGroup],
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference],
    why_unpaired: Sequence[str],
) -> Table:
    modes, labels = modes_of(rows), labels_of(rows)
    lines = _order_lines(rows, differences)
    columns = [
        (column.worded(modes, labels), group)
        for group in groups
        for column in group.columns
        if any(_cell(column, line).text not in (NONE, "") for line in lines)
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
            TableRow(
                (*(Cell(text(line)) for _, text in names), *(_cell(column, line) for column, _ in columns)),
                is_mean=line.category == MEAN,
                is_difference=isinstance(line, Difference),
            )
            for line in lines
        ),
        names=len(names),
        notes=tuple(filter(None, notes)),
    )


def _order_lines(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[RowOrDifference]:
    """Return the lines by category, means last; in each the runs of a view, followed by their differences."""
    categories = list(dict.fromkeys(row.category for row in rows))
    views = list(dict.fromkeys(row.view for row in rows))
    by_view = {view: at for at, view in enumerate(views)}
    several = len({row.key for row in rows}) > 1
    lines: list[RowOrDifference] = [*rows, *differences]
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
) -> list[tuple[Heading, Callable[[RowOrDifference], str]]]:
    """Return the columns that distinguish rows: the category, and run, view or call where there are several."""

    def name(line: RowOrDifference) -> str:
        return title_of(line.category) if isinstance(line, Difference) else name_of(line)

    def run(line: RowOrDifference) -> str:
        return difference_name(line) if isinstance(line, Difference) else model_name(line)

    def call(line: RowOrDifference) -> str:
        return plain(line.call if isinstance(line, Difference) else line.run.call)

    names: list[tuple[Heading, Callable[[RowOrDifference], str]]] = [
        (Heading("label", "What the probes decode, and in which category."), name)
        if any(row.label for row in rows)
        else (Heading("category", "Kind of question."), name)
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
    """Return the title of the table with the view and the run, if there is one of each, and the suites."""
    views, runs = ({row.view for row in rows}, {model_name(row): None for row in rows})
    view = f", view {rows[0].view}" if title not in BEHAVIOUR and len(views) == 1 else ""
    model = f"{next(iter(runs))} on " if len(runs) == 1 else ""
    labels = list(dict.fromkeys(row.label for row in rows if row.label))
    of_label = f" of {'labels' if len(labels) > 1 else labels[0]}" if labels else ""
    return f"{title}{of_label}{view}: {model}{', '.join(dict.fromkeys(row.run.suite for row in rows))}"


def _cell(column: Column, line: RowOrDifference) -> Cell:
    """Return the cell of a column; an empty one where differences have no such number."""
    if isinstance(line, Difference):
        return absent("") if column.difference is None else column.difference(line)
    value = column.sort_value(line)
    return replace(
        column.cell(line),
        sort=value,
        heat=value if column.heat and isinstance(value, float) else None,
        strong=column.strong is not None and column.strong(line),
        note=column.note(line) if column.note else "",
    )


# -- notes -------------------------------------------------------------------------------------------------------

_ANSWERS = "wrong and unread (no answer, or several) are shares of all questions"
_OUTCOMES = (
    "regime: SR compared with 50 % ± Δ, which counts independent items; wrong and outside are shares of all "
    "episodes, and never moved is a part of outside"
)
_SITES = (
    "layer: the first of the best layers, + how many others are as good; after @ the flow step or action token, "
    "counted from 0; p: family-wise over all layers"
)
_ABOVE = (
    "above chance: held-out score of the sites that the inner folds choose, minus the mean score with permuted "
    "labels; 95 % intervals over groups; layer: that of the largest score above its own chance; p: family-wise "
    "over all layers"
)
_ANSWER_SITES = (
    "layer: the first of the best layers, + how many others are as good; p: family-wise over all layers"
)


def _legend(title: str, rows: Sequence[RetentionRow]) -> list[str]:
    if title == "Accuracy of answers":
        scores = ", ".join(dict.fromkeys(str(row.answers.score) for row in rows))
        return [f"accuracy is by {scores}; a model that always names one side is right in 50 %; {_ANSWERS}"]
    if title == "Success rate":
        return [_OUTCOMES, *dict.fromkeys(rule_sentence(row.rules) for row in rows if row.category == MEAN)]
    calls = sorted({row.run.call for row in rows if row.run.call is not None})
    of_call = [call_words(calls[0])] if len(calls) == 1 else []
    if any(row.label for row in rows):
        return [_ABOVE, *_list_undefined(rows)]
    if title == "Retention":
        sites = _ANSWER_SITES if modes_of(rows) == "answers" else _SITES
        return [sites, *_list_undefined(rows), chance_only(rows), *of_call]
    return [_controls(rows), *of_call]


def _list_undefined(rows: Sequence[RetentionRow]) -> list[str]:
    """Return the reasons why categories have no retention, each once with its categories."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if not row.retention.defined and row.category != MEAN:
            reasons.setdefault(row.retention.note, []).append(name_of(row))
    means = {row.retention.note for row in rows if row.retention.defined and row.retention.note}
    sentences = [f"{reason}: {', '.join(dict.fromkeys(names))}" for reason, names in reasons.items()]
    return [*sentences, *(f"in the mean: {note}" for note in sorted(means))]


def _controls(rows: Sequence[RetentionRow]) -> str:
    name = rows[0].controls.untrained
    untrained = f"; untrained: {name}" if name else ""
    fewest = min(row.success.n_items for row in rows if row.category != MEAN)
    share = f"{100 * detectable(fewest):.1f}"
    findable = f"with {plural(fewest, 'item')} a leak that gives a control {share} % is found in 4 of 5 suites"
    return (
        f"held-out accuracy of probes without the model, in %; {findable}; selectivity: accuracy minus that with "
        f"random labels{untrained}"
    )


def _difference_legend(differences: Sequence[Difference], has_tests: bool) -> str:
    """Return how differences and their intervals are made; empty without any."""
    if not differences:
        return ""
    parts = []
    if any(row.paired for row in differences):
        parts.append("groups of items are pairs")
    if not all(row.paired for row in differences):
        parts.append("where items differ, each side has its own groups")
    if has_tests and any(row.p is not None for row in differences):
        parts.append(
            "p of the share right: exact, by sign flips of groups, in means over all items; in brackets corrected "
            f"for all categories and pairs (Holm); {P_DECIDES}"
        )
    if any(row.sr_models for row in differences):
        parts.append("intervals hold for these models on other items")
    return f"differences: with 95 % intervals; {'; '.join(parts)}"


def _sizes(rows: Sequence[RetentionRow]) -> list[str]:
    """Return per run its folder and the range of its sizes; one sentence where runs have the same."""
    sizes: dict[str, list[str]] = {}
    for of_run in by_run([row for row in rows if row.category != MEAN]):
        sizes.setdefault(_size(of_run), []).append(Path(of_run[0].run.location).name)
    return [f"size of {', '.join(names)}: {size}" for size, names in sizes.items()]


def _size(rows: Sequence[RetentionRow]) -> str:
    of_labels = any(row.label for row in rows)
    samples = [row.controls.n_samples or 0 if of_labels else row.success.n_episodes for row in rows]
    parts = [f"{span(samples)} {'samples' if of_labels else 'episodes'}"]
    if not of_labels:
        parts.append(f"{span([row.success.n_items for row in rows])} items")
    if groups := [row.controls.n_groups for row in rows if row.controls.n_groups is not None]:
        parts.append(f"{span(groups)} groups")
    return f"per {'label' if of_labels else 'category'} {', '.join(parts)}"


# -- what was compared ----------------------------------------------------------------------------------------


_LADDER = (
    "same items, same seeds; only one: episodes right in the first wording alone, and in the second alone; p: "
    "exact, signs of whole groups of items flipped; (Holm): over all categories, pairs and runs shown, means apart"
)


def wording_tables(wordings: Sequence[Difference], names: Mapping[str, str]) -> list[Table]:
    """Return a table per run that compares its wordings.

    Args:
        wordings: Differences of two wordings of one run each.
        names: Names of runs, by location.
    """
    return [
        Table.of(
            f"Wordings, {names[str(run)]}",
            ("category", "wordings", "items", "SR %", "difference, points [95 %]", "only one", "p (Holm)"),
            [
                (
                    row.category,
                    f"{row.group} / {row.minus}",
                    _items(row),
                    Cell(row.sr_group, percent, after=f" / {percent(row.sr_minus)}"),
                    Cell(row.sr, points, row.sr_ci),
                    Cell(row.only, after="" if row.only is None else f" / {row.only_minus}"),
                    difference_test(row),
                )
                for row in rows
            ],
            mean=MEAN,
            notes=[_LADDER],
        )
        for run, rows in groupby(wordings, key=lambda row: row.run)
    ]


def _items(row: Difference) -> Cell:
    """Return how many items are compared, and of how many where some are left out."""
    if row.n_items is None:
        return Cell("other items")
    return Cell(row.n_items, after="" if row.of_items in (None, row.n_items) else f" of {row.of_items}")


def size_table(means: Sequence[RetentionRow]) -> list[Table]:
    """Return the mean accuracy by model and prompt, a column per size of the picture.

    There is no table for fewer than two VLM runs.
    """
    of_vlms = [row for row in once_per_category(means) if is_vlm(row) and row.category == MEAN]
    if len(of_vlms) < 2:
        return []
    sizes = sorted(
        {str(row.answers.picture_size) for row in of_vlms}, key=lambda size: [int(n) for n in size.split("x")]
    )
    lines: dict[tuple[str, str], dict[str, Cell]] = {}
    for row in of_vlms:
        name = full_name(row.run.model, row.run.random_weights)
        extras = [
            str(part) for part in (row.answers.picture, row.answers.asked_for) if part not in ("frame", "target")
        ]
        prompt = " · ".join([str(row.answers.prompt), *extras])
        size = str(row.answers.picture_size)
        # Runs of one model, prompt and size, such as two checkpoints, stand in lines of their own.
        names = chain([name], (model_name(row) + " '" * primes for primes in count()))
        free = next(name for name in names if size not in lines.get((name, prompt), {}))
        lines.setdefault((free, prompt), {})[size] = success_interval(row)
    cells: list[Cells] = [
        (*name, *(rates.get(size, Cell(None)) for size in sizes)) for name, rates in lines.items()
    ]
    title, note = "Accuracy by prompt and size of the picture", "mean over categories in %, with its 95 % interval"
    return [Table.of(title, ("model", "prompt", *sizes), cells, names=2, notes=[note])]


# -- VLM − VLA ---------------------------------------------------------------------------------------------------

_SOURCES: Mapping[Relation, str] = {
    "yes": "the policy grew from these weights",
    "no": "the policy did NOT grow from these weights",
    "unknown": "unknown whether the policy grew from these weights",
}


def vlm_vla_tables(differences: Sequence[Difference]) -> list[Table]:
    """Return one table per pair of a VLM run and a policy run."""
    return [
        _vlm_vla_table(vlm, policy, list(rows))
        for (vlm, policy), rows in groupby(differences, key=lambda row: (row.group, row.minus))
    ]


def _vlm_vla_table(vlm: str, policy: str, rows: Sequence[Difference]) -> Table:
    frames = {row.same_frames for row in rows}
    first = (
        "the same first frames" if frames == {True} else "OTHER first frames" if False in frames else "no hashes"
    )
    items = "the same items" if all(row.paired for row in rows) else "OTHER items: not paired, no p"
    tests = (
        "p: exact, whole groups of items flipped; (Holm): over the categories of all pairs shown, means by "
        f"themselves; {P_DECIDES}"
    )
    cells = [
        (
            row.category,
            Cell(row.sr_group, percent),
            Cell(row.sr_minus, percent),
            Cell(row.sr, percent, row.sr_ci),
            Cell(row.p, _p4),
            Cell(row.p_holm, _p4),
            _items(row),
        )
        for row in rows
    ]
    columns = ("category", "VLM %", "VLA %", "VLM − VLA [95 %]", "p", "p (Holm)", "items")
    notes = [items, first, _SOURCES[rows[0].source or "unknown"], tests]
    return Table.of(f"VLM − VLA: {vlm} − {policy}", columns, cells, mean=MEAN, notes=["; ".join(notes)])


# -- answer, probe, success --------------------------------------------------------------------------------------

Columns = Sequence[tuple[Heading | str, Callable[[CategoryCounts], Cell]]]
_p4 = partial(number, digits=4)
_BOTH_LAYOUTS = "an item counts as right only if it is right in both layouts; guessing reaches that in 25 %"
_NAMES = {"answered": "answer", "encoded": "probe", "acted": "success"}
_CODES = "a capital letter for what is right, a small one for what is not"
_TESTS = "p: exact McNemar over items or over whole groups, the larger; (Holm) over all categories and pairs shown"


def known_used_tables(joined: KnownUsedTable) -> list[Table]:
    """Return four tables: counts of items, their codes, tests, and counts of single episodes."""
    probes = f"probes in view {joined.view}" if joined.view else "no probes: answer and success only"
    title = f"Answer, probe, success: {joined.vlm} (by {joined.score}) · {joined.policy}"
    rows = joined.rows
    which = "Which of them: VLM · probe · success (expected of coins)"
    return [
        _counts(
            title, f"{_BOTH_LAYOUTS}; {probes}", rows, ("Items", _SHARES), ("Answer right, without success", _LOST)
        ),
        _counts(which, _CODES, rows, ("", _codes(rows))),
        _counts("Equally many?", _TESTS, rows, ("", _TESTED)),
        _counts("Single episodes (nothing is tested)", "", rows, ("", _episodes(rows))),
    ]


def _counts(title: str, note: str, rows: Sequence[CategoryCounts], *groups: tuple[str, Columns]) -> Table:
    headings = [
        replace(heading if isinstance(heading, Heading) else Heading(heading), group=group)
        for group, columns in groups
        for heading, _ in columns
    ]
    cells: list[Cells] = [
        (row.category, *(cell(row) for _, columns in groups for _, cell in columns)) for row in rows
    ]
    legend = Legend(after=(note,))
    return Table.of(title, ("category", *headings), cells, mean=OVERALL, legend=legend).filled()


def _share(count: int | None, row: CategoryCounts) -> Cell:
    return Cell(count, after="" if count is None else f" ({percent(count / row.n_items, 0)} %)")


_SHARES: Columns = [
    ("items (groups)", lambda row: Cell(row.n_items, after=f" ({row.n_groups})")),
    (
        Heading("answer right", term="answer: the VLM answers right"),
        lambda row: _share(row.answered_correctly, row),
    ),
    (Heading("probe right", term="probe: its held-out decision is right"), lambda row: _share(row.encoded, row)),
    (Heading("success", term="success: the cube ends right"), lambda row: _share(row.acted_correctly, row)),
    ("shown", lambda row: Cell({True: "yes", False: "no", None: None}[row.has_signal])),
]
_LOST: Columns = [
    ("answer and probe right", lambda row: Cell(row.answered_and_encoded)),
    (
        "of these without success % [95 %]",
        lambda row: Cell(row.share_not_acted_on, percent, row.share_not_acted_on_ci),
    ),
    ("answer with success, p", lambda row: Cell(row.p_linked, _p4)),
]


def _codes(rows: Sequence[CategoryCounts]) -> Columns:
    def cell(code: str, row: CategoryCounts) -> Cell:
        if code not in row.counts:
            return Cell(None)
        return Cell(row.counts[code], after=f" ({row.guessed[code]:.1f})")

    codes = dict.fromkeys(code for row in rows for code in row.counts)
    return [(_spelt(code), partial(cell, code)) for code in codes]


def _episodes(rows: Sequence[CategoryCounts]) -> Columns:
    def cell(code: str, row: CategoryCounts) -> Cell:
        return Cell(row.episodes.get(code))

    codes = dict.fromkeys(code for row in rows for code in row.episodes)
    return [(_spelt(code), partial(cell, code)) for code in codes]


def _spelt(code: str) -> str:
    """Return `101` as V p S: a capital for what is right, a small letter for what is not."""
    letters = zip("VPS", code, strict=True)
    return " ".join(letter if mark == "1" else letter.lower() for letter, mark in letters if mark != "-")


def _test(first: str, second: str, row: CategoryCounts) -> Cell:
    for test in row.comparisons:
        if (test.first, test.second) == (first, second):
            corrected = "" if test.p_holm is None else f" ({_p4(test.p_holm)})"
            return Cell(test.only_first, after=f" against {test.only_second}, {_p4(test.p)}{corrected}")
    return Cell(None)


_TESTED: Columns = [
    (f"{_NAMES[first]} − {_NAMES[second]}: only one of them, p (Holm)", partial(_test, first, second))
    for first, second in PAIRS
]
