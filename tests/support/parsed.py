"""The syntax trees of the package, read once per process: many tests look through all of its files."""

import ast
import gc
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "probe_kit"


@cache
def parsed(path: Path) -> ast.Module:
    """Return the tree of one file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(tree: ast.Module) -> list[ast.AST]:
    """Return every node of a tree."""
    return list(ast.walk(tree))


@cache
def package_trees() -> dict[Path, ast.Module]:
    """Return the tree of every file of the package, by path and sorted."""
    trees = {path: parsed(path) for path in sorted(PACKAGE.rglob("*.py"))}
    gc.freeze()  # they stay: looking through them for garbage again and again takes seconds
    return trees


@cache
def package_nodes[Node: ast.AST](kind: type[Node]) -> list[tuple[Path, Node]]:
    """Return every node of a kind, such as `ast.Call`, with its file."""
    return [
        (path, node) for path, tree in package_trees().items() for node in nodes(tree) if isinstance(node, kind)
    ]
