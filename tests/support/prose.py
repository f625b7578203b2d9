"""Finds the text that users read: strings and docstrings of modules, and pages of documentation."""

import ast
import io
import json
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from tests.support.parsed import nodes, parsed

type Kind = Literal["docstring", "summary", "help", "string", "page", "table", "comment"]


class Prose(NamedTuple):
    """One text. location: `file:line` of its first line. kind: a `summary` is the first paragraph of a module."""

    location: str
    text: str
    kind: Kind


def prose_of_module(path: Path, name: str) -> Iterator[Prose]:
    """Docstrings of the module and of its public names, help texts, and every other string with a space in it."""
    tree = parsed(path)
    docstrings: dict[ast.Constant, bool] = {}
    _collect_docstrings(tree, docstrings, public=True)
    helps = {
        keyword.value
        for node in nodes(tree)
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg == "help"
    }
    for node in nodes(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
            continue
        location = f"{name}:{node.lineno}"
        if docstrings.get(node):
            yield Prose(location, node.value, "docstring")
        elif node not in docstrings and " " in node.value.strip():
            yield Prose(location, node.value, "help" if node in helps else "string")
    if summary := ast.get_docstring(tree):
        yield Prose(f"{name}:1", summary.split("\n\n")[0], "summary")


def remarks_of_module(path: Path, name: str) -> Iterator[Prose]:
    """Comments and every docstring, also those of private names."""
    source = path.read_text(encoding="utf-8")
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield Prose(f"{name}:{token.start[0]}", token.string.lstrip("# "), "comment")
    docstrings: dict[ast.Constant, bool] = {}
    _collect_docstrings(parsed(path), docstrings, public=True)
    for node in docstrings:
        yield Prose(f"{name}:{node.lineno}", str(node.value), "docstring")


def prose_of_page(path: Path, name: str) -> Iterator[Prose]:
    """Paragraphs, list items and table rows of a Markdown page, without code blocks."""
    yield from _prose_of_markdown(path.read_text(encoding="utf-8"), name)


def prose_of_notebook(path: Path, name: str) -> Iterator[Prose]:
    """The same of the Markdown cells of a notebook; a place is a cell and a line of it."""
    for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] == "markdown":
            yield from _prose_of_markdown("".join(cell["source"]), f"{name}:{number}")


def _prose_of_markdown(page: str, name: str) -> Iterator[Prose]:
    text = re.sub(r"^```.*?^```", lambda block: "\n" * block[0].count("\n"), page, flags=re.MULTILINE | re.DOTALL)
    line = 1
    for block in re.split(r"(\n{2,}|\n(?=[-*|] ))", text):
        if block.strip():
            yield Prose(f"{name}:{line}", block, "table" if block.startswith("|") else "page")
        line += block.count("\n")


def without_code(text: str) -> str:
    """The text with every `code` span, URL and file name replaced by one word."""
    return re.sub(r"`[^`]*`|https?://\S+|\]\([^)]*\)|[\w./-]+\.\w+", "code", text)


def sentences(text: str) -> list[str]:
    """The sentences of a text; a `·` in a list of links ends one, a colon or semicolon ends none."""
    return [sentence for sentence in re.split(r"(?<=[.!?])\s+| · ", " ".join(text.split())) if sentence]


def _collect_docstrings(node: ast.AST, docstrings: dict[ast.Constant, bool], public: bool) -> None:
    """Every string that is a statement, and whether it belongs to a public name."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
            docstrings[child.value] = public
        elif isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            _collect_docstrings(child, docstrings, public and not child.name.startswith("_"))
        else:
            _collect_docstrings(child, docstrings, public)
