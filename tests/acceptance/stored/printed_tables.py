"""Numbers of printed tables, whatever the format: rows by a cell, and values with their intervals."""

import re
from collections.abc import Iterable, Iterator
from html.parser import HTMLParser
from typing import Any

_NUMBER = r"[-+]?\d+(?:\.\d+)?"
_WITH_INTERVAL = re.compile(rf"({_NUMBER})\s*\[\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\]")
QUANTITIES = {
    "backbone": ("backbone.score", "backbone.ci", 100),
    "action": ("action.score", "action.ci", 100),
    "success": ("success.sr", "success.ci", 100),
    "retention": ("retention.value", "retention.ci", 1),
}
"""Names of a quantity's value and interval in JSON, and the factor by which tables show them."""


def rows_with(text: str, cell: str) -> Iterator[list[str]]:
    """Rows of printed tables that have a cell of this content, in any case of letters."""
    for line in text.replace("−", "-").splitlines():
        border = next((mark for mark in (r"\|", "&") if re.search(mark, line)), r"\s{2,}")
        cells = [part.strip() for part in re.split(border, line.replace(r"\\", ""))]
        if cell.casefold() in (part.casefold() for part in cells):
            yield cells


def intervals(rows: Iterable[list[str]]) -> list[tuple[str, str, str]]:
    """The values of these rows that have an interval, as printed: value, lower and upper end."""
    return [match for cells in rows for cell in cells for match in _WITH_INTERVAL.findall(cell)]


def equal_as_printed(printed: tuple[str, ...], exact: tuple[float, ...]) -> bool:
    """Whether these texts are those numbers, rounded to the decimals that the texts have."""
    return all(
        abs(float(text) - number) <= 0.5 * 10 ** -len(text.partition(".")[2]) + 1e-9
        for text, number in zip(printed, exact, strict=True)
    )


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    """A nested object as one level: names joined by dots, intervals as `ci_low` and `ci_high`."""
    if isinstance(value, dict):
        parts = (leaves(part, f"{name}.{key}" if name else key) for key, part in value.items())
        return {key: part for level in parts for key, part in level.items()}
    if isinstance(value, list) and name.endswith("ci"):
        return {f"{name}_low": value[0], f"{name}_high": value[1]}
    return {name: value}


def quantities_of(row: dict[str, Any]) -> dict[str, tuple[float, float, float]]:
    """Backbone, action, success and retention of a JSON row, with intervals, in the units of tables."""
    flat = leaves(row)
    return {
        quantity: (scale * flat[value], scale * flat[f"{interval}_low"], scale * flat[f"{interval}_high"])
        for quantity, (value, interval, scale) in QUANTITIES.items()
        if flat.get(value) is not None and flat.get(f"{interval}_low") is not None
    }


class Page(HTMLParser):
    """An HTML page as a browser reads it. elements: tag and attributes. text: readable text without scripts."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.tables: list[list[list[str]]] = []
        self._texts: list[str] = []
        self._open: list[str] = []
        self.feed(content)

    @property
    def text(self) -> str:
        return " ".join("".join(self._texts).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr" and self.tables:
            self.tables[-1].append([])
        elif tag in ("td", "th") and self.tables and self.tables[-1]:
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        while tag in self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] in ("script", "style"):
            return
        self._texts.append(data)
        if {"td", "th"} & set(self._open) and self.tables and self.tables[-1] and self.tables[-1][-1]:
            self.tables[-1][-1][-1] += data
