"""Tables that are as wide as the console allows."""

import io

import pytest
from rich.console import Console

from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

TABLE = ResponsiveTable(
    title="Rates",
    caption="a caption",
    name="system · category",
    names=("color", "mean", "color"),
    styles=("", "bold", ""),
    parts=(
        Part("first", ("rate %",), ((Cell("98.1"),), (Cell("72.5"),), (Cell("3.4"),))),
        Part("second", ("interval",), ((Cell("[90, 99]"),), (Cell("[60, 80]"),), (Cell("[1, 9]"),))),
    ),
    sections=("a policy with a long name", "a policy with a long name", "another"),
)


def printed(table: ResponsiveTable, width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO())
    console.print(table)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def test_rows_stand_below_the_name_of_their_section_which_is_written_once() -> None:
    lines = printed(TABLE, 80)
    assert lines[3:9] == [
        "a policy with a long name",
        "  color            98.1    [90, 99]",
        "  mean             72.5    [60, 80]",
        "another",
        "  color            3.4     [1, 9]",
        "a caption",
    ]


@pytest.mark.parametrize("width", [20, 30, 36, 44, 80])
def test_sections_are_named_and_no_value_is_cut_at_any_width(width: int) -> None:
    text = " ".join(" ".join(printed(TABLE, width)).split())
    for value in ("98.1", "72.5", "3.4", "[90, 99]", "[60, 80]", "[1, 9]"):
        assert text.count(value) == 1
    assert "another" in text
    assert "a policy with a long name" in text
