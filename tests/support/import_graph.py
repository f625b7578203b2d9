"""Which module of a package imports which: read from the source, wherever in a file an import stands."""

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from tests.support.parsed import nodes, parsed

Graph = Mapping[str, set[str]]


def import_graph(package: Path) -> dict[str, set[str]]:
    """Per module of `package` the modules of it that it imports: at its top, in functions, and for types only.

    That a module loads its parents' `__init__` is left out: those name what is below them.
    """
    modules = {_name(package, path): path for path in package.rglob("*.py")}
    return {name: set(_imports(path, modules)) - {name} for name, path in modules.items()}


def _name(package: Path, path: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(path: Path, modules: Mapping[str, Path]) -> Iterator[str]:
    for node in nodes(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                if full in modules:
                    yield full
                elif node.module in modules:
                    yield node.module


def circles(graph: Graph) -> list[list[str]]:
    """Every group of modules that reach each other, sorted (Tarjan's strongly connected components)."""
    cycles: list[list[str]] = []
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []

    def visit(name: str) -> None:
        number[name] = lowest[name] = len(number)
        stack.append(name)
        for other in graph[name]:
            if other not in number:
                visit(other)
                lowest[name] = min(lowest[name], lowest[other])
            elif other in stack:
                lowest[name] = min(lowest[name], number[other])
        if lowest[name] == number[name]:
            start = stack.index(name)
            group, stack[start:] = stack[start:], []
            if len(group) > 1:
                cycles.append(sorted(group))

    for name in graph:
        if name not in number:
            visit(name)
    return cycles


def upward(graph: Graph, order: Mapping[str, set[str]], root: str) -> list[str]:
    """Imports between the rooms of `root` that `order` does not allow, as `importer -> imported`.

    order: per room, a module or package right below `root`, the rooms it may import. What is not in it, such as
    the modules on top, may import everything, and may be imported by nothing that is in it.
    """
    wrong = []
    for importer, imported in graph.items():
        importer_room = room(importer, root)
        for other in imported:
            imported_room = room(other, root)
            inside = other == root or other.startswith(f"{root}.")
            if (
                inside
                and importer_room in order
                and imported_room != importer_room
                and imported_room not in order[importer_room]
            ):
                wrong.append(f"{importer} -> {other}")
    return sorted(wrong)


def room(module: str, root: str) -> str:
    """The part of `module` right below `root`; empty for `root` itself and for what is not in it."""
    return module.removeprefix(f"{root}.").split(".")[0] if module.startswith(f"{root}.") else ""


def packages(graph: Graph) -> set[str]:
    """The folders that hold modules of `graph`."""
    return {name.rsplit(".", 1)[0] for name in graph if "." in name}


def children(graph: Graph, folder: str) -> dict[str, set[str]]:
    """Which child of `folder`, a module or subfolder, imports which other."""
    imports_by_room: dict[str, set[str]] = {}
    for importer, imported in graph.items():
        if importer_room := room(importer, folder):
            imports_by_room.setdefault(importer_room, set()).update(room(other, folder) for other in imported)
    return {name: imported_rooms - {name, ""} for name, imported_rooms in imports_by_room.items()}


def levels(graph: Graph) -> int:
    """Length of the longest chain of imports; the graph has no circle."""

    @cache
    def level(name: str) -> int:
        return 1 + max(map(level, graph[name]), default=0)

    return max(map(level, graph), default=0)
