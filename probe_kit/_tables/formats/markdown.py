"""Tables in Markdown."""

from collections.abc import Iterable, Sequence

from probe_kit._system.escaping import markdown_safe
from probe_kit._tables.content import Cell, Content


def render(tables: Sequence[Content], sentences: Sequence[str] = (), notes: Sequence[str] = ()) -> str:
    """Return the first table, the sentences as a list, the other tables, and the notes as quotations."""
    first, *following = map(_table, tables)
    items = [f"* {markdown_safe(sentence)}" for sentence in sentences]
    if items:
        items.append("")
    return "\n".join([first, *items, *following, *(f"> {markdown_safe(note)}\n" for note in notes)])


def _table(table: Content) -> str:
    """Return a bold title, the table, and its notes as quotations."""
    lines = [
        f"**{markdown_safe(table.title)}**",
        "",
        _line(map(markdown_safe, table.full_headings)),
        _line(["---"] * len(table.headings)),
        *(_line(map(_cell, row.cells)) for row in table.rows),
        "",
        *(f"> {markdown_safe(sentence)}\n" for sentence in table.sentences),
    ]
    return "\n".join(lines)


def _cell(cell: Cell) -> str:
    """Return a cell; Markdown has no color that renders everywhere, so that red is a sign and bold type."""
    safe = markdown_safe(cell.text)
    return f"🔴 **{safe}**" if cell.alarm else safe


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
