"""JSON that other programs read holds no word for a number, as Python's NaN is one."""

import json
from math import inf, nan
from typing import Any

import pytest

from probe_kit._system.json_text import json_text
from probe_kit._tables.table import Table
from probe_kit._terminal.console import print_json


def strict(text: str) -> Any:
    """JSON as JavaScript reads it."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_a_number_that_is_not_finite_is_null_wherever_it_stands() -> None:
    value = {"p": nan, "ci": (-inf, 0.5), "rows": [{"share": inf, "count": 3, "word": "NaN", "none": None}]}
    expected = {"p": None, "ci": [None, 0.5], "rows": [{"share": None, "count": 3, "word": "NaN", "none": None}]}
    assert strict(json_text(value)) == expected
    assert strict(json_text([0.1, 10**30, "é"])) == [0.1, 10**30, "é"]
    assert "é" in json_text({"é": nan})


def test_tables_and_commands_print_it(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table.of("a table", ("name", "share"), [("a", "–")], numbers=({"name": "a", "share": nan},))
    assert strict(table.to_json()) == [{"name": "a", "share": None}]
    print_json({"share": [nan]})
    assert strict(capsys.readouterr().out) == {"share": [None]}
