"""Tables in HTML: one macro for notebooks and for pages, whose links lead into a glossary.

pandas' Styler has neither sort values nor links, which pages need; so the macro is ours.
"""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.escaping import without_folders
from probe_kit._system.line_breaks import keep_numbers_whole
from probe_kit._tables.content import Cell, Content, heat_colour
from probe_kit._tables.numbers import NONE, is_missing

if TYPE_CHECKING:
    from jinja2 import Environment

_FOLDER = Path(__file__).parent
_NOTEBOOK = (
    "<style>.probe-kit td,.probe-kit th{text-align:left;white-space:nowrap;padding:.25em .6em}"
    ".probe-kit .number{text-align:right}.probe-kit .strong,.probe-kit tfoot{font-weight:bold}"
    ".probe-kit .alarm{color:#b00020}.probe-kit .difference{font-style:italic}"
    ".probe-kit .heat{color:#1b1f24}</style>"
)
"""Rules of a table in a notebook, which has no page of ours around it."""


def environment(*folders: Path, paths: tuple[str, ...] = ()) -> "Environment":
    """Return the environment of templates in `folders`, which may import `table.html.jinja`.

    No text that it renders holds one of `paths` or another absolute path: pages and notebooks are sent to others.
    No line breaks between a number and its unit.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def escape_value(value: Any) -> Any:
        if not isinstance(value, str) or isinstance(value, Markup) or value.startswith("data:"):
            return value
        return keep_numbers_whole(without_folders(value, paths))

    templates = Environment(
        loader=FileSystemLoader([*folders, _FOLDER]), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=escape_value,
    )  # fmt: skip
    templates.filters |= {"heat": heat_colour, "sort_key": sort_key}
    return templates


def html(table: Content) -> str:
    """Return the table for a notebook: a title, the table, and its notes."""
    text: str = _notebook().get_template("notebook.html.jinja").render(table=table, words=None)
    return _NOTEBOOK + text


@cache
def _notebook() -> "Environment":
    return environment()


def sort_key(cell: Cell, is_numeric: bool) -> float | str | None:
    """Return what a page sorts a cell by: a number, text, or None for last."""
    if cell.sort is not None:
        return cell.sort
    if is_numeric and not isinstance(cell.value, str):
        return None if is_missing(cell.value) else cell.value
    return cell.text if cell.text not in ("", NONE) else None
