import io
from collections.abc import Callable

import pytest
from rich.console import Console

from probe_kit.retention import RetentionTable, retention
from probe_kit.retention.latex import escape, heat_colour
from probe_kit.train import ArrayRun

SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])


@pytest.fixture
def table(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    random = probed_run({"color": SIGNAL, "traffic_sign": NONE}, "pi0-tiny", random_weights=True)
    return retention([random])


def rich_text(table: RetentionTable) -> str:
    console = Console(width=250, file=io.StringIO())
    console.print(table.to_rich())
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


@pytest.mark.parametrize("write", [rich_text, RetentionTable.to_markdown, RetentionTable.to_latex])
def test_every_table_marks_random_weights_and_undefined_retention(
    table: RetentionTable, write: Callable[[RetentionTable], str]
) -> None:
    text = write(table)
    title = text.replace("\\", "")
    assert "(suite@1#0123456789ab; random weights)" in title
    assert text.count("pi0-tiny (random weights)") >= 3
    assert "n/a (no backbone signal)" in text
    assert "0.50" in text


def test_markdown_rows_have_as_many_cells_as_the_heading(table: RetentionTable) -> None:
    for block in table.to_markdown().split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) <= 1


def test_success_rates_are_listed_once_however_many_views(table: RetentionTable) -> None:
    twice = RetentionTable(table.rows * 2, table.means)
    assert twice.to_markdown().split("**Retention")[0].count("| color |") == 1


def test_latex_escapes_text_and_colours_defined_retention_only(table: RetentionTable) -> None:
    text = table.to_latex()
    assert r"traffic\_sign" in text
    lines = {line.split(" & ")[2]: line for line in text.splitlines() if line.startswith("pi0-tiny")}
    assert r"\cellcolor{pkheat3}0.50" in lines["color"]
    assert "cellcolor" not in lines[r"traffic\_sign"]
    assert text.count("{") == text.count("}")


def test_a_backslash_is_escaped_once() -> None:
    assert escape(r"a_b\c%") == r"a\_b\textbackslash{}c\%"


@pytest.mark.parametrize(
    ("value", "name"), [(-1.0, "pkheat1"), (0.39, "pkheat2"), (0.8, "pkheat5"), (9.0, "pkheat5")]
)
def test_five_heat_colours_run_from_lost_to_kept(value: float, name: str) -> None:
    assert heat_colour(value) == name
