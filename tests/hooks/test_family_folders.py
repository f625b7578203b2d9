"""A family is one folder: what it alone uses stands in it, and it needs no other family's folder."""

import re
from importlib import import_module
from pathlib import Path

import pytest

from probe_kit.hooks.registry import FOLDERS
from tests.support.import_graph import Graph, import_graph, room

ROOT = Path(__file__).parents[2]
FAMILIES = "probe_kit.hooks.families"
COMMON = ("probe_kit.models.", f"{FAMILIES}.shared.")
BUILT_ON = {"openvla": {"prismatic"}}
"""OpenVLA is a Prismatic model that acts."""


@pytest.fixture(scope="module")
def graph() -> Graph:
    return import_graph(ROOT / "probe_kit")


def owner(module: str) -> str:
    """The folder of the family that a module belongs to, empty if it is no family's."""
    folder = room(module, FAMILIES)
    return folder if folder in FOLDERS else ""


def imported_families(graph: Graph, folder: str) -> set[str]:
    return {owner(other) for module in graph if owner(module) == folder for other in graph[module]} - {"", folder}


def only_users(graph: Graph) -> dict[str, set[str]]:
    """Modules of the common folders by the one family that imports them, alone."""
    users = {module: [user for user in graph if module in graph[user]] for module in graph}
    of_one = {
        module: {owner(user) or user for user in users[module]} for module in graph if module.startswith(COMMON)
    }
    return {module: names for module, names in of_one.items() if len(names) == 1 and names <= set(FOLDERS)}


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_family_imports_no_other_but_the_one_that_it_is_built_on(folder: str, graph: Graph) -> None:
    assert imported_families(graph, folder) == BUILT_ON.get(folder, set())


def test_what_one_family_alone_uses_stands_in_its_folder(graph: Graph) -> None:
    assert only_users(graph) == {}


def test_a_network_of_one_family_in_a_common_folder_is_noticed() -> None:
    magma, network = f"{FAMILIES}.magma.adapter", "probe_kit.models.trunk"
    assert only_users({magma: {network}, network: set()}) == {network: {"magma"}}


def test_no_common_folder_knows_a_family(graph: Graph) -> None:
    families = {module: {owner(other) for other in graph[module]} - {""} for module in graph}
    assert {module for module, names in families.items() if module.startswith(COMMON) and names} == set()


def test_every_folder_is_registered() -> None:
    folders = {path.parent.name for path in (ROOT / FAMILIES.replace(".", "/")).glob("*/__init__.py")}
    assert folders == {*FOLDERS, "shared"}


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_names_its_page_and_its_golden_reference(folder: str) -> None:
    paths = re.findall(r"`((?:docs|tests)/[^`]+)`", import_module(f"{FAMILIES}.{folder}").__doc__ or "")
    assert {path.split("/")[0] for path in paths} == {"docs", "tests"}
    assert [path for path in paths if not (ROOT / path).exists()] == []
