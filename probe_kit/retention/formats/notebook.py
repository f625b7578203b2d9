"""The retention table as a notebook shows it: the summary, and success rates, probes and retention below it."""

from collections.abc import Sequence
from html import escape

from probe_kit._terminal.local_paths import without_places
from probe_kit.retention.columns.summary import summarise_runs, summary_table
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.formats.html import HtmlCell, HtmlTable, html_tables, plain_tables
from probe_kit.retention.rows.row import RetentionRow

_CELL = "text-align:{align};padding:.25em .6em;white-space:nowrap"
_INK = ";color:#1b1f24"  # on a heat colour, whatever the page's own colour of text


def table_html(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> str:
    """The summary, and folded below it the report's first tables: headings explain themselves when pointed at."""
    found = summarise_runs(rows)
    summary = plain_tables([summary_table(found, differences)])
    said = "".join(f"<li>{_safe(sentence)}</li>" for run in found for sentence in run.sentences)
    tables = [
        table for table in html_tables(rows, differences) if table.subject != "controls" and not table.details
    ]
    details = f"<details><summary>All tables</summary>{''.join(map(_table, tables))}</details>"
    return f"{_heading(rows)}{''.join(map(_table, summary))}<ul>{said}</ul>{details}"


def text_table_html(table: TextTable, sentences: Sequence[str]) -> str:
    """A table of text, and sentences below it."""
    said = "".join(f"<li>{_safe(sentence)}</li>" for sentence in sentences)
    return f"{''.join(map(_table, plain_tables([table])))}<ul>{said}</ul>"


def _safe(text: str) -> str:
    """For HTML, and without the places of this machine: notebooks are sent to others."""
    return escape(without_places(text))


def _heading(rows: Sequence[RetentionRow]) -> str:
    """Whose numbers these are, since a table of one model does not repeat its name."""
    suites = ", ".join(dict.fromkeys(row.run.suite for row in rows))
    return f"<div>{_safe(_models(rows))} on {_safe(suites)}</div>" if rows else ""


def _models(rows: Sequence[RetentionRow]) -> str:
    return ", ".join(dict.fromkeys(map(model_name, rows)))


def table_text(rows: Sequence[RetentionRow]) -> str:
    """One line: how many rows, of which models."""
    categories = len({row.category for row in rows})
    models = _models(rows) or "no runs"
    return f"<RetentionTable of {models}: {categories} categories; print(table.to_markdown()) shows it>"


def _table(table: HtmlTable) -> str:
    numeric = [column.numeric for column in table.columns]
    head = "".join(
        f'<th style="{_style(column.numeric)}" title="{escape(column.explanation)}">{escape(column.name)}</th>'
        for column in table.columns
    )
    body = "".join(_row(cells, numeric) for cells in table.body)
    foot = "".join(_row(cells, numeric, bold=True) for cells in table.foot)
    title = f'<div style="margin-top:.6em"><b>{_safe(table.title)}</b></div>'
    return f"{title}<table><thead><tr>{head}</tr></thead><tbody>{body}{foot}</tbody></table>"


def _row(cells: Sequence[HtmlCell], numeric: Sequence[bool], bold: bool = False) -> str:
    return "<tr>" + "".join(_cell(cell, right, bold) for cell, right in zip(cells, numeric, strict=True)) + "</tr>"


def _cell(cell: HtmlCell, numeric: bool, bold: bool) -> str:
    style = _style(numeric)
    style += f";background:{cell.heat}{_INK}" if cell.heat else ""
    style += ";font-weight:bold" if bold or cell.strong else ""
    style += ";color:#b00020" if cell.alarm else ""
    style += ";font-style:italic" if cell.difference else ""
    below = f"<br><small>{_safe(cell.below)}</small>" if cell.below else ""
    return f'<td style="{style}" title="{_safe(cell.note)}">{_safe(cell.text)}{below}</td>'


def _style(numeric: bool) -> str:
    return _CELL.format(align="right" if numeric else "left")
