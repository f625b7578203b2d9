"""Formats of text: a file each, called like its format, with `render(tables, sentences, notes)`.

A file that is added is a format of `retention` and of studies; it is loaded when it is asked for.
"""

from collections.abc import Sequence
from importlib import import_module
from pkgutil import iter_modules

from probe_kit._tables.content import Content


def names() -> tuple[str, ...]:
    """Return the names of the formats, sorted."""
    return tuple(sorted(module.name for module in iter_modules(__path__)))


def render(name: str, tables: Sequence[Content], sentences: Sequence[str] = (), notes: Sequence[str] = ()) -> str:
    """Return tables in a format.

    Args:
        name: The format, one of `names`.
        tables: The tables, at least one.
        sentences: The finding, behind the first table.
        notes: Remarks to be read with the tables.
    """
    text: str = import_module(f"{__name__}.{name}").render(tables, sentences, notes)
    return text
