"""The retention table as a notebook shows it: success rates, probes and retention on heat colours."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from probe_kit.retention.cells import model_name
from probe_kit.retention.report.tables import (
    HtmlCell,
    HtmlTable,
    behaviour_table,
    difference_tables,
    retention_table,
)

if TYPE_CHECKING:
    from probe_kit.retention.table import RetentionTable

_CELL = "text-align:{align};padding:.25em .6em;white-space:nowrap"
_INK = ";color:#1b1f24"  # on a heat colour, whatever the page's own colour of text


def table_html(table: "RetentionTable") -> str:
    """The report's first tables, without its page: headings explain themselves when pointed at."""
    rows = table.all_rows
    found = [behaviour_table(rows), retention_table(rows), *difference_tables(table.differences)]
    return _heading(table) + "".join(_table(one) for one in found if one is not None)


def _heading(table: "RetentionTable") -> str:
    """Whose numbers these are, since a table of one model does not repeat its name."""
    suites = ", ".join(dict.fromkeys(row.suite for row in table.rows))
    return f"<div>{escape(_models(table))} on {escape(suites)}</div>" if table.rows else ""


def _models(table: "RetentionTable") -> str:
    return ", ".join(dict.fromkeys(map(model_name, table.rows)))


def table_text(table: "RetentionTable") -> str:
    """One line: how many rows, of which models."""
    categories = len({row.category for row in table.rows})
    models = _models(table) or "no runs"
    return f"<RetentionTable of {models}: {categories} categories; print(table.to_markdown()) shows it>"


def _table(table: HtmlTable) -> str:
    numeric = [column.numeric for column in table.columns]
    head = "".join(
        f'<th style="{_style(column.numeric)}" title="{escape(column.explanation)}">{escape(column.name)}</th>'
        for column in table.columns
    )
    body = "".join(_row(cells, numeric) for cells in table.body)
    foot = "".join(_row(cells, numeric, bold=True) for cells in table.foot)
    title = f'<div style="margin-top:.6em"><b>{escape(table.title)}</b></div>'
    return f"{title}<table><thead><tr>{head}</tr></thead><tbody>{body}{foot}</tbody></table>"


def _row(cells: Sequence[HtmlCell], numeric: Sequence[bool], bold: bool = False) -> str:
    return "<tr>" + "".join(_cell(cell, right, bold) for cell, right in zip(cells, numeric, strict=True)) + "</tr>"


def _cell(cell: HtmlCell, numeric: bool, bold: bool) -> str:
    style = _style(numeric)
    style += f";background:{cell.heat}{_INK}" if cell.heat else ""
    style += ";font-weight:bold" if bold or cell.strong else ""
    style += ";color:#b00020" if cell.alarm else ""
    return f'<td style="{style}" title="{escape(cell.note)}">{escape(cell.text)}</td>'


def _style(numeric: bool) -> str:
    return _CELL.format(align="right" if numeric else "left")
