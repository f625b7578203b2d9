"""Data flows one way, and so do imports: no circle, and nothing imports what comes after it."""

import re
import tomllib
from pathlib import Path

import pytest

from tests.support.import_graph import Graph, children, circles, import_graph, levels, packages, upward

PACKAGE = Path(__file__).parents[1] / "probe_kit"

TOP = {"__init__", "__main__", "cli", "doctor", "doctor_command"}
BASE = {path.stem for path in PACKAGE.glob("*.py")} - TOP | {"_terminal", "_system", "_execution", "_tables"}
FOLDERS = {
    **dict.fromkeys(BASE, BASE),
    "statistics": BASE,
    "suite": BASE | {"statistics"},
    "env": BASE | {"suite"},
    "models": BASE | {"suite"},
    "hooks": BASE | {"models"},
    "runs": BASE | {"suite", "env", "hooks"},
    "extract": BASE | {"suite", "env", "hooks", "runs"},
    "serve": BASE | {"suite", "env", "hooks", "runs", "extract"},
    "train": BASE | {"suite", "hooks", "runs", "statistics"},
    "intervene": BASE | {"suite", "env", "hooks", "runs", "extract", "train", "statistics"},
    "retention": BASE | {"suite", "env", "hooks", "runs", "extract", "train", "intervene", "statistics"},
    "diagnose": BASE
    | {"suite", "env", "hooks", "runs", "extract", "train", "intervene", "retention", "statistics"},
    "view": BASE
    | {"suite", "env", "hooks", "runs", "extract", "train", "intervene", "retention", "diagnose", "statistics"},
    "study": BASE | {"suite", "env", "hooks", "runs", "extract", "train", "intervene", "retention", "statistics"},
}
"""What a folder may import; what is not named here, such as `cli` and `demo`, stands on top."""

MOST_LEVELS = 14

READS_ONLY = (
    "probe_kit.runs",
    "probe_kit.hooks.contract.sites",
    "probe_kit.hooks.contract.lineage",
    "probe_kit.env.scoring",
    "probe_kit.env.scoring",
    "probe_kit.env.scoring",
)
"""All that probes and tables may know of the rooms that hold models and simulators."""


@pytest.fixture(scope="module")
def graph() -> Graph:
    return import_graph(PACKAGE)


def test_no_module_imports_itself_by_way_of_others(graph: Graph) -> None:
    assert circles(graph) == []


def test_no_package_imports_one_that_comes_after_it(graph: Graph) -> None:
    assert upward(graph, FOLDERS, "probe_kit") == []


def test_no_two_children_of_a_folder_import_each_other(graph: Graph) -> None:
    """A newcomer reads a folder from the bottom up, on at most 14 levels."""
    folders = {folder: children(graph, folder) for folder in packages(graph)}
    assert {folder: circles(inside) for folder, inside in folders.items() if circles(inside)} == {}
    assert {folder for folder, inside in folders.items() if levels(inside) > MOST_LEVELS} == set()


@pytest.mark.parametrize("room", ["train", "retention"])
def test_packages_that_read_runs_import_neither_models_nor_simulators(room: str, graph: Graph) -> None:
    imported_rooms = {
        other
        for module, imported in graph.items()
        if module.startswith(f"probe_kit.{room}")
        for other in imported
        if other.startswith(
            ("probe_kit.extract", "probe_kit.runs", "probe_kit.hooks", "probe_kit.env", "probe_kit.models")
        )
    }
    assert imported_rooms
    strange = {
        other for other in imported_rooms if other not in READS_ONLY and not other.startswith(READS_ONLY[0] + ".")
    }
    assert not strange


def test_packages_that_no_test_machine_installs_are_imported_by_require_alone() -> None:
    """An `import` of it is an error of types in a fresh clone, and none where a developer happens to have it."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))
    installed = names(project["project"]["dependencies"]) | names(project["dependency-groups"]["dev"])
    extras = project["project"]["optional-dependencies"].values()
    absent = {name for extra in extras for name in names(extra)} - installed
    assert "ray" in absent
    statement = re.compile(rf"^\s*(?:import|from) (?:{'|'.join(sorted(absent))})\b", re.MULTILINE)
    assert statement.search("def late():\n    import ray")
    assert not [path for path in PACKAGE.rglob("*.py") if statement.search(path.read_text(encoding="utf-8"))]


def names(requirements: list[str]) -> set[str]:
    """The modules that requirements such as `ray>=2.50` bring, where they are called like their package."""
    return {re.split(r"[^\w-]", requirement)[0].replace("-", "_") for requirement in requirements}


def test_a_circle_is_found_wherever_its_imports_stand(tmp_path: Path) -> None:
    write(tmp_path, "a", "import house.b")
    write(tmp_path, "b", "def late():\n    from house.c import name")
    write(tmp_path, "c", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house import a")
    write(tmp_path, "d", "import house.a")
    assert circles(import_graph(tmp_path / "house")) == [["house.a", "house.b", "house.c"]]


def test_an_import_upwards_is_found(tmp_path: Path) -> None:
    write(tmp_path, "cellar", "from house.attic import box")
    write(tmp_path, "attic", "import house.cellar")
    graph = import_graph(tmp_path / "house")
    assert upward(graph, {"cellar": set(), "attic": {"cellar"}}, "house") == ["house.cellar -> house.attic"]


def write(folder: Path, name: str, text: str) -> None:
    (folder / "house").mkdir(exist_ok=True)
    (folder / "house" / "__init__.py").touch()
    (folder / "house" / f"{name}.py").write_text(text, encoding="utf-8")
