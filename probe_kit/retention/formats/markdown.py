"""Retention tables in Markdown."""

from collections.abc import Sequence

from probe_kit._system.markdown_text import markdown_safe
from probe_kit.retention.behaviour.wordings import WordingPair
from probe_kit.retention.columns.conditions import wording_tables
from probe_kit.retention.columns.row_names import named_cells, row_headings, titled
from probe_kit.retention.columns.summary import summarise_runs, summary_table
from probe_kit.retention.columns.tables import Table, cell_text, tables_of
from probe_kit.retention.columns.text import ABOVE_CHANCE
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import RetentionRow


def markdown(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    wordings: Sequence[WordingPair] = (),
    further: Sequence[TextTable] = (),
    unpaired: Sequence[str] = (),
) -> str:
    """The summary, success rates and, where there are any, retention, controls, wordings, more and notes.

    Differences stand below the runs of their category; unpaired: why others have none.
    """
    found = summarise_runs(rows)
    whole = summary_table(found, differences)
    parts = [_markdown_table(whole.title, whole.columns, whole.cells), f"{markdown_safe(whole.note)}.\n"]
    parts += [f"* {markdown_safe(sentence)}" for run in found for sentence in run.sentences]
    parts += ["", *(_table(table) for table in tables_of(rows, differences, unpaired))]
    plain = [*wording_tables(wordings), *further]
    parts += [f"{markdown_table(own)}\n{markdown_safe(own.note)}\n" for own in plain]
    return "\n".join([*parts, *(f"> {markdown_safe(note)}\n" for note in notes)])


def _table(table: Table) -> str:
    columns = [*row_headings(table), *(column.heading for column in table.columns)]
    cells = [
        [*named_cells(table, row), *(cell_text(column, row) for column in table.columns)] for row in table.rows
    ]
    captions = (f"> {markdown_safe(caption)}\n" for caption in table.captions)
    return "\n".join([_markdown_table(titled(table), columns, cells), *captions])


def markdown_table(table: TextTable) -> str:
    """A table of text in Markdown, without its note."""
    return _markdown_table(table.title, table.columns, table.cells)


def _markdown_table(heading: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [
        f"**{markdown_safe(heading)}**",
        "",
        _markdown_line([markdown_safe(column) for column in columns]),
        _markdown_line(["---"] * len(columns)),
        *(_markdown_line([_marked(cell) for cell in cells]) for cells in rows),
        "",
    ]
    return "\n".join(lines)


def _marked(cell: str) -> str:
    """Markdown has no colour that renders everywhere: a red sign and bold type."""
    safe = markdown_safe(cell)
    return f"🔴 **{safe}**" if cell.endswith(ABOVE_CHANCE) else safe


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
