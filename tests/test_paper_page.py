"""docs/paper.md has a row per table and figure of the paper, and the numbers of its contradictions."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import SHARED

PAGE = (Path(__file__).parents[1] / "docs" / "paper.md").read_text(encoding="utf-8")


def data(name: str) -> Any:
    file = SHARED / "data" / "paper" / name
    if not file.is_file():
        pytest.skip(f"no {file} (set PROBE_KIT_SHARED)")
    return json.loads(file.read_text(encoding="utf-8"))


def section(title: str) -> str:
    return PAGE.split(f"## {title}\n")[1].split("\n## ")[0]


def test_every_table_and_figure_has_a_row() -> None:
    tables = data("paper-tables.json")
    rows = section("Table by table")
    numbers = {record["source"]["table"] for record in tables["tables"].values()}
    assert numbers == {int(number) for number in re.findall(r"^\| Table (\d)", rows, re.MULTILINE)}
    figures = {record["figure"] for record in tables["figures"].values()}
    assert figures <= {int(number) for line in re.findall(r"^\| Figures? ([^|]*)", rows, re.MULTILINE)
                       for number in re.findall(r"\d", line)}  # fmt: skip


def test_every_contradiction_that_was_recomputed_is_on_the_page() -> None:
    rows = section("Where the paper contradicts itself")
    for record in data("paper-recomputed.json")["disagree"]:
        for value in (record["printed"], record["recomputed"]):
            for number in re.findall(r"\d+\.\d+|\b\d\d\b", str(value)):
                assert f"{float(number):g}" in rows, (number, record)
