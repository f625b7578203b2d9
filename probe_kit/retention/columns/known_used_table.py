"""Answer, probe and success, item by item, on a console and in the report."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable
from probe_kit.retention.columns.text import number, percent, with_limits
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.known_used import OVERALL, PAIRS, CategoryCounts, Comparison, KnownUsedTable

if TYPE_CHECKING:
    from rich.console import Group

Columns = Sequence[tuple[str, Callable[[CategoryCounts], str]]]
_LEGEND = (
    "answer: the VLM answers right; probe: its held-out decision is right; success: the cube ends right; each in "
    "both layouts of an item, which a coin manages in 25 %"
)
_NAMES = {"answered": "answer", "encoded": "probe", "acted": "success"}
_CODES = "a capital letter for what is right, a small one for what is not"
_TESTS = "p: exact McNemar over items or over whole groups, the larger; (Holm) over all categories and pairs shown"


def rich_known_used(joined: KnownUsedTable) -> "Group":
    """Counts, tests and notes as tables for a rich console."""
    from rich.console import Group
    from rich.text import Text

    title = f"Answer, probe, success: {joined.asked} (by {joined.score}) · {joined.acted}"
    seen = f"probes in view {joined.view}" if joined.view else "no probes: answer and success only"
    rows = joined.rows
    tables = [
        _table(title, f"{_LEGEND}; {seen}", rows, [("Items", _SHARES), ("Answer right, without success", _LOST)]),
        _table("Which of them: VLM · probe · success (expected of coins)", "", rows, [("", _codes(rows))]),
        _table("Equally many?", _TESTS, rows, [("", _tests())]),
        _table("Single episodes (nothing is tested)", "", rows, [("", _episodes(rows))]),
    ]
    return Group(*tables, *(Text(note, style="yellow") for note in joined.notes))


def known_used_tables(joined: KnownUsedTable) -> list[TextTable]:
    """The same counts and tests as tables of text, for pages."""
    seen = f"probes in view {joined.view}" if joined.view else "no probes: answer and success only"
    title = f"Answer, probe, success: {joined.asked} (by {joined.score}) · {joined.acted}"
    rows = joined.rows
    return [
        _plain(title, f"{_LEGEND}; {seen}", rows, [*_SHARES, *_LOST]),
        _plain("Which of them: VLM · probe · success (expected of coins)", _CODES, rows, _codes(rows)),
        _plain("Equally many?", _TESTS, rows, _tests()),
    ]


def _plain(title: str, note: str, rows: Sequence[CategoryCounts], columns: Columns) -> TextTable:
    shown = [column for column in columns if any(column[1](row) != "–" for row in rows)]
    return TextTable(
        title,
        note,
        ("category", *(name for name, _ in shown)),
        tuple((row.category, *(cell(row) for _, cell in shown)) for row in rows),
    )


def _share(count: int | None, row: CategoryCounts) -> str:
    return "–" if count is None else f"{count} ({percent(count / row.n_items, 0)} %)"


_SHARES: Columns = [
    ("items (groups)", lambda row: f"{row.n_items} ({row.n_groups})"),
    ("answer right", lambda row: _share(row.answered_correctly, row)),
    ("probe right", lambda row: _share(row.encoded, row)),
    ("success", lambda row: _share(row.acted_correctly, row)),
    ("shown", lambda row: {True: "yes", False: "no", None: "–"}[row.has_signal]),
]
_LOST: Columns = [
    (
        "answer and probe right",
        lambda row: "–" if row.answered_and_encoded is None else str(row.answered_and_encoded),
    ),
    (
        "of these without success % [95 %]",
        lambda row: with_limits(percent(row.share_not_acted_on), row.share_not_acted_on_ci, percent),
    ),
    ("answer with success, p", lambda row: number(row.p_linked, 4)),
]


def _codes(rows: Sequence[CategoryCounts]) -> Columns:
    codes = dict.fromkeys(code for row in rows for code in row.counts)
    return [(_spelt(code), _count_of(code)) for code in codes]


def _count_of(code: str) -> Callable[[CategoryCounts], str]:
    def cell(row: CategoryCounts) -> str:
        return f"{row.counts[code]} ({row.guessed[code]:.1f})" if code in row.counts else "–"

    return cell


def _episodes(rows: Sequence[CategoryCounts]) -> Columns:
    codes = dict.fromkeys(code for row in rows for code in row.episodes)
    return [(_spelt(code), _episodes_of(code)) for code in codes]


def _episodes_of(code: str) -> Callable[[CategoryCounts], str]:
    return lambda row: str(row.episodes.get(code, "–"))


def _spelt(code: str) -> str:
    """`101` as V p S: a capital for what is right, a small letter for what is not."""
    letters = zip("VPS", code, strict=True)
    return " ".join(letter if mark == "1" else letter.lower() for letter, mark in letters if mark != "-")


def _tests() -> Columns:
    return [
        (f"{_NAMES[first]} − {_NAMES[second]}: only one of them, p (Holm)", _test_of(first, second))
        for first, second in PAIRS
    ]


def _test_of(first: str, second: str) -> Callable[[CategoryCounts], str]:
    def cell(row: CategoryCounts) -> str:
        found = [one for one in row.comparisons if (one.first, one.second) == (first, second)]
        return _spell_test(found[0]) if found else "–"

    return cell


def _spell_test(one: Comparison) -> str:
    corrected = "" if one.p_holm is None else f" ({number(one.p_holm, 4)})"
    return f"{one.only_first} against {one.only_second}, {number(one.p, 4)}{corrected}"


def _table(
    title: str, caption: str, rows: Sequence[CategoryCounts], parts: Sequence[tuple[str, Columns]]
) -> ResponsiveTable:
    found = []
    for question, columns in parts:
        shown = [column for column in columns if any(column[1](row) != "–" for row in rows)]
        cells = tuple(tuple(Cell(cell(row)) for _, cell in shown) for row in rows)
        if shown:
            found.append(Part(question, tuple(name for name, _ in shown), cells))
    return ResponsiveTable(
        title=title,
        caption=caption,
        name="category",
        names=tuple(row.category for row in rows),
        styles=tuple("bold" if row.category == OVERALL else "" for row in rows),
        parts=tuple(found),
    )
