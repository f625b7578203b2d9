"""The page with one table of all families has every family that acts, and is filled block by block."""

import re
from importlib import import_module
from pathlib import Path

from probe_kit.hooks.registry import own_families

PAGE = Path(__file__).parents[2] / "docs" / "notes" / "families.md"


def rows(page: str, block: str) -> set[str]:
    found = re.search(rf"families_table.py: {block} -->\n(.*?)<!-- end of it -->", page, re.DOTALL)
    assert found is not None
    return set(re.findall(r"^\| ([a-z0-9.-]+) \|", found[1], re.MULTILINE)) - {"family", "system", "---"}


def test_every_family_that_acts_has_a_row() -> None:
    page = PAGE.read_text(encoding="utf-8")
    acting = {name for name, family in own_families().items() if family.acts}
    assert rows(page, "study") == acting - {"pi0-tiny-early", "pi0-tiny-state"}
    assert rows(page, "weights") == {
        name for name in acting if own_families()[name].full_size and not own_families()[name].sizes
    }


def test_a_block_is_filled_and_nothing_else() -> None:
    script = import_module("families_table")
    page = PAGE.read_text(encoding="utf-8")
    filled = script.filled(page, {"study": "| new |", "weights": "| heavy |"})
    assert rows(filled, "study") == {"new"}
    assert rows(filled, "weights") == {"heavy"}
    assert filled.splitlines()[:5] == page.splitlines()[:5]


def test_rows_of_means_are_left_out_where_there_is_one_category() -> None:
    script = import_module("families_table")
    table = "| system | view | category |\n| --- | --- | --- |\n| a | mean | Color |\n| a | mean | mean |\n\nn/a"
    assert script.one_row_each(table).splitlines()[2:] == ["| a | mean | Color |"]
