"""LaTeX of the retention table: escaped, coloured, labelled, and within its line."""

import re
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
    text = table.to_latex("all")
    assert r"[95 \%]" not in text, "percent stands close to its number in every heading"
    (part,) = (one for one in text.split(r"\begin{tabular}") if "retention [95" in one)
    lines = {line.split(" & ")[3]: line for line in part.splitlines() if line.startswith("pi0-tiny (random")}
    row = table.rows[0]
    assert row.retention.value is not None
    shown = rf"\cellcolor{{{heat_colour(row.retention.value)}}}{row.retention.value:.2f}"
    assert shown in lines["color"]
    assert "cellcolor" not in lines[r"traffic\_sign"]
    assert text.count("{") == text.count("}")
    assert r"(suite@1\#0123456789ab; random weights)" in text


def test_without_details_there_is_the_summary_alone_and_every_table_has_a_label_of_its_own(
    table: RetentionTable,
) -> None:
    summary, everything = table.to_latex(), table.to_latex("all")
    assert re.findall(r"\\label\{(.*)\}", summary) == ["tab:summary"]
    assert "xcolor" not in summary, "only tables of details have colours"
    assert r"\begin{tabular}{lrrrrl}" in summary, "words to the left, numbers to the right"
    labels = re.findall(r"\\label\{(.*)\}", everything)
    assert labels[:3] == ["tab:summary", "tab:success-rate", "tab:retention"]
    assert len(set(labels)) == len(labels) == everything.count(r"\begin{table}")


def test_no_tabular_is_wider_than_its_line(table: RetentionTable) -> None:
    """A box has its natural width, or that of the line; groups of columns stand below each other."""
    text = table.to_latex("all")
    fitted = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%" + "\n" + r"\begin{tabular}"
    assert text.count(r"\begin{tabular}") == text.count(fitted) == text.count(r"\end{tabular}}")
    columns = [len(one) for one in re.findall(r"\\begin\{tabular\}\{([lr]+)\}", text)]
    assert max(columns) <= 13


def test_a_backslash_is_escaped_once() -> None:
    assert escape(r"a_b\c%") == r"a\_b\textbackslash{}c\%"
    assert escape("λ|π0 × 2") == r"$\lambda$\textbar{}$\pi$0 $\times$ 2"


@pytest.mark.parametrize(
    ("value", "name"), [(-1.0, "pkheat1"), (0.39, "pkheat2"), (0.8, "pkheat5"), (9.0, "pkheat5")]
)
def test_five_heat_colours_run_from_lost_to_kept(value: float, name: str) -> None:
    assert heat_colour(value) == name
