"""What every form of table has in common: one retention first, the published ratio, the call, ties, and Δ."""

import io
import re
from collections.abc import Callable
from html import unescape

import pytest
from rich.console import Console

from probe_kit._tables.table import Table
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns.summary import HEADINGS
from probe_kit.retention.columns.tables import retention_tables
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.report.summaries import read_row
from probe_kit.train import ArrayRun

ProbedRun = Callable[..., ArrayRun]
TIED = ([0.5, 0.9, 0.9], [[0.6, 0.8], [0.8, 0.8]])
FORMER = ("bounded [", "debiased", "area [", "unbounded")
"""Words of the three estimates that there were once."""


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    runs = [probed_run({"color": TIED}, name) for name in ("one", "other")]
    return retention_table({"first": [runs[0]], "second": [runs[1]]})


def console(table: RetentionTable) -> str:
    screen = Console(width=240, file=io.StringIO())
    screen.print(table.to_rich("all"))
    return screen.file.getvalue()  # type: ignore[attr-defined,no-any-return]


def every_form(table: RetentionTable) -> dict[str, str]:
    """Text from the retention table on, by form; the one of a page is its headings and cells."""
    made = retention_tables(table.all_rows, table.differences)["Retention"]
    return {
        "console": console(table).split("Retention, view")[1],
        "markdown": table.to_markdown().split("**Retention, view")[1],
        "latex": table.to_latex("all").split(r"\caption{Retention")[1],
        "page": text_of(made),
    }


def text_of(table: Table) -> str:
    """What a page shows without its markup."""
    return unescape(re.sub(r"<style.*?</style>|<[^>]+>", " ", table._repr_html_())).replace("\u00a0", " ")


def test_every_table_leads_with_the_one_retention_and_the_published_ratio_beside_it(table: RetentionTable) -> None:
    row = table.rows[0].retention
    assert row.value is not None
    assert row.published is not None
    numbers = [f"{row.value:.2f}", f"{row.published:.2f}"]
    assert len(set(numbers)) == 2, "the two can be told apart"
    for form, text in every_form(table).items():
        shown = text.lower()
        places = [shown.find(name) for name in ("retention [95", "published ratio", "backbone")]
        assert -1 not in places, (form, places)
        assert places[0] < places[1], form
        assert -1 < text.find(numbers[0]) < text.find(numbers[1]), form
        assert not [name for name in FORMER if name in shown], form


def test_every_table_names_the_call_the_first_iteration_and_ties(table: RetentionTable) -> None:
    for form, text in every_form(table).items():
        assert re.search(r"\bcall\b", text, re.IGNORECASE), form
        assert re.search(r"first it", text, re.IGNORECASE), form
        assert "80.0" in text.split("first it")[-1].lower(), form
        assert re.search(r"(?<![@\d])1 \+1\b", text), (form, "two layers of the backbone are as good")
        assert re.search(r"1 @0 \+2\b", text), (form, "three sites of the expert are as good")


def test_ties_stand_in_the_row_and_in_the_reading(table: RetentionTable) -> None:
    row = table.rows[0]
    assert (row.backbone.ties, row.action.ties) == (1, 2)
    words = " ".join(read_row(row))
    assert "and at 1 other site as well" in words
    assert "and at 2 other sites as well" in words


def test_the_margin_that_decides_stands_before_the_papers(table: RetentionTable) -> None:
    row = table.rows[0]
    assert row.success.chance_margin_episodes is not None
    assert row.success.chance_margin is not None
    assert row.success.chance_margin_episodes < row.success.chance_margin
    deciding, papers = f"{100 * row.success.chance_margin:.1f}", f"{100 * row.success.chance_margin_episodes:.1f}"
    texts = {
        "console": console(table),
        "markdown": table.to_markdown(),
        "latex": table.to_latex("all"),
        "page": text_of(retention_tables(table.all_rows)["Success rate"]),
    }
    for form, text in texts.items():
        assert -1 < text.find(deciding) < text.find(papers), form


def test_the_summary_quotes_the_retention_of_the_mean(table: RetentionTable) -> None:
    rows = [row for row in table.all_rows if row.group == "first"]
    found = rows[-1].retention
    assert found.value is not None
    assert f"{found.value:.2f}" != f"{found.published:.2f}"
    first = next(run for run in table.summary if run.mean.row.group == "first")
    assert first.mean.cells[HEADINGS.index("retention")].startswith(f"{found.value:.2f} [")


def test_differences_hold_one_retention_and_the_call(table: RetentionTable) -> None:
    (row, mean) = table.differences
    assert isinstance(row, Difference)
    first, second = (one.retention.value for one in table.rows if one.category == "color")
    assert row.retention == pytest.approx(first - second)  # type: ignore[operator]
    assert row.retention_ci is not None
    assert (row.call, mean.call) == (0, 0)
    assert [name for name in vars(row) if "retention" in name] == [
        "retention", "retention_ci", "retention_models",
    ]  # fmt: skip
