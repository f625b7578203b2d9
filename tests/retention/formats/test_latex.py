from collections.abc import Callable

import pytest

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.formats.latex import escape, heat_colour
from probe_kit.train import ArrayRun


@pytest.fixture
def table(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    accuracies = {"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]]), "traffic_sign": ([0.5, 0.55, 0.5], [[0.58, 0.5]])}
    return retention_table([probed_run(accuracies, "pi0-tiny", random_weights=True)])


def test_text_is_escaped_and_only_defined_retention_is_coloured(table: RetentionTable) -> None:
    text = table.to_latex()
    assert r"[95 \%]" not in text, "percent stands close to its number in every heading"
    lines = {line.split(" & ")[3]: line for line in text.splitlines() if line.startswith("pi0-tiny (random")}
    row = table.rows[0]
    assert row.retention.value is not None
    shown = rf"\cellcolor{{{heat_colour(row.retention.value)}}}{row.retention.value:.2f}"
    assert shown in lines["color"]
    assert "cellcolor" not in lines[r"traffic\_sign"]
    assert text.count("{") == text.count("}")
    assert r"(suite@1\#0123456789ab; random weights)" in text


def test_a_backslash_is_escaped_once() -> None:
    assert escape(r"a_b\c%") == r"a\_b\textbackslash{}c\%"
    assert escape("λ|π0 × 2") == r"$\lambda$\textbar{}$\pi$0 $\times$ 2"


@pytest.mark.parametrize(
    ("value", "name"), [(-1.0, "pkheat1"), (0.39, "pkheat2"), (0.8, "pkheat5"), (9.0, "pkheat5")]
)
def test_five_heat_colours_run_from_lost_to_kept(value: float, name: str) -> None:
    assert heat_colour(value) == name
