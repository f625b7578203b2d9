"""Pages and notebooks use public names only: those of `__all__` of a public package."""

import ast
import json
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PUBLIC = (
    "probe_kit", "probe_kit.suite", "probe_kit.env", "probe_kit.hooks", "probe_kit.hooks.testing",
    "probe_kit.runs", "probe_kit.extract", "probe_kit.train", "probe_kit.intervene",
    "probe_kit.intervene.patching", "probe_kit.retention",
    "probe_kit.retention.displays", "probe_kit.retention.report", "probe_kit.suite.converters",
    "probe_kit.diagnose", "probe_kit.errors",
)  # fmt: skip
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def code_of(file: Path) -> Iterator[str]:
    """Python of a page's fenced blocks, or of a notebook's cells without its magics."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        yield from re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        return
    for cell in json.loads(text)["cells"]:
        if cell["cell_type"] == "code":
            yield re.sub(r"^\s*[%!].*$", "", "".join(cell["source"]), flags=re.MULTILINE)


def private_names(code: str) -> list[str]:
    """What is imported from probe_kit past a public package."""
    private = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            private += [
                alias.name
                for alias in node.names
                if alias.name.startswith("probe_kit.") and alias.name not in PUBLIC
            ]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "probe_kit":
            assert node.module is not None
            names = [alias.name for alias in node.names]
            public = public_names(node.module) if node.module in PUBLIC else set()
            private += [f"{node.module}.{name}" for name in names if name not in public]
    return private


def public_names(package: str) -> set[str]:
    """`__all__`, or every name without an underscore of a module that has none."""
    module = import_module(package)
    return set(getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")]))


@pytest.mark.parametrize("file", [*PAGES, *NOTEBOOKS], ids=lambda file: str(file.relative_to(ROOT)))
def test_pages_and_notebooks_import_public_names_only(file: Path) -> None:
    assert [name for code in code_of(file) for name in private_names(code)] == []


def test_a_private_import_is_found() -> None:
    assert private_names("from probe_kit.train.solver.logistic import LogisticSolver") == [
        "probe_kit.train.solver.logistic.LogisticSolver"
    ]
    assert private_names("from probe_kit.train import LogisticSolver, train_probes") == [
        "probe_kit.train.LogisticSolver"
    ]
    assert private_names("import probe_kit as pk\nfrom probe_kit.train import train_probes") == []
