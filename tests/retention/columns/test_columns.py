"""A column is declared once, and every format shows it."""

import io
import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_type_hints

import pytest
from rich.console import Console

from probe_kit.retention import Difference, RetentionRow, RetentionTable, retention_table
from probe_kit.retention.columns.columns import TABLES, Column, ColumnGroup, all_columns, averaged_fields, share
from probe_kit.retention.columns.tables import retention_tables
from probe_kit.retention.report.parts import words_of
from probe_kit.train import ArrayRun

ProbedRun = Callable[..., ArrayRun]


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    return retention_table(
        [probed_run({"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]]), "shape": ([0.5, 0.9], [[0.6]])})]
    )


def every_form(table: RetentionTable) -> dict[str, str]:
    console = Console(width=400, file=io.StringIO())
    console.print(table.to_rich("all"))
    return {
        "terminal": console.file.getvalue(),  # type: ignore[attr-defined]
        "markdown": table.to_markdown(),
        "latex": table.to_latex("all"),
        "page": table._repr_html_().replace("\u00a0", " "),
    }


def field_of(path: str) -> Any:
    """The type of `part.field` of a row. Raises KeyError where there is none."""
    kind: Any = RetentionRow
    for name in path.split("."):
        kind = next((one for one in (kind, *get_args(kind)) if is_dataclass(one)), kind)
        kind = get_type_hints(kind)[name] if is_dataclass(kind) else kind
    return kind


def test_a_new_column_is_one_declaration_and_stands_in_every_format(
    probed_run: ProbedRun, monkeypatch: pytest.MonkeyPatch, table: RetentionTable
) -> None:
    """The worked example of CONTRIBUTING: the field is in `SuccessRate`, the column is declared."""
    new = share("success.layout_mean", "layout mean %", "Mean of the success rates of both layouts.")
    for text in every_form(table).values():
        assert "layout mean" not in text
    first, *others = TABLES["Success rate"]
    group = ColumnGroup(first.title, (*first.columns, new))
    monkeypatch.setitem(TABLES, "Success rate", (group, *others))  # type: ignore[misc]
    again = retention_table([probed_run({"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]])})])
    for form, text in every_form(again).items():
        assert "layout mean" in text, form
    assert again.means[0].success.layout_mean == again.rows[0].success.layout_mean == 0.6, "means average it too"
    words = words_of([*retention_tables(again.all_rows).values()]).entries["Success rate"]
    assert [word.meaning for word in words if word.name == "layout mean %"] == [new.help]
    assert json.loads(again.to_json())[0]["success"]["layout_mean"] == 0.6
    assert again.to_frame()["success.layout_mean"].tolist() == [0.6, 0.6]
    assert again.success["layout_mean"].tolist() == [0.6, 0.6]


@pytest.mark.parametrize("column", all_columns(), ids=lambda column: column.heading)
def test_a_column_names_a_field_of_a_row_and_explains_itself(column: Column) -> None:
    if column.key.startswith("difference."):
        assert column.key.removeprefix("difference.") in get_type_hints(Difference)
        assert column.difference is not None
    else:
        assert field_of(column.key) is not None
    assert column.help.endswith(".")
    assert len(column.help) > 20


@pytest.mark.parametrize("path", averaged_fields())
def test_what_is_averaged_is_a_number(path: str) -> None:
    kind = field_of(path)
    assert float in (kind, *get_args(kind))


def test_no_two_columns_of_a_table_have_one_heading() -> None:
    for title, groups in TABLES.items():
        headings = [column.heading for group in groups for column in group.columns]
        assert len(set(headings)) == len(headings), title


def test_parts_are_frames_keyed_by_run_category_and_view(table: RetentionTable) -> None:
    assert table.success[["run", "category"]].values.tolist() == [
        ["pi0", "color"],
        ["pi0", "shape"],
        ["pi0", "mean"],
    ]
    for frame in (table.retention, table.controls):
        assert frame[["run", "category", "view"]].values.tolist()[0] == ["pi0", "color", "mean"]
        assert len(frame) == 3
    assert table.probes[["category", "stream"]].values.tolist()[:2] == [["color", "backbone"], ["color", "action"]]
    assert table.probes.loc[0, "score"] == pytest.approx(0.9)
    assert table.probes.loc[0, "verdict"] == "shown"
    assert table.retention.loc[0, "value"] == table.rows[0].retention.value
    assert table.answers.empty
    assert table.interventions.empty
    assert "sr_answered" in table.rules
    assert {one.name for one in fields(table.rows[0].success)} - {"paired", "ci"} <= set(table.success)
