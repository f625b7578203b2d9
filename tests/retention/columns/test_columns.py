"""A column is declared once, and every format shows it."""

import html
import io
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from rich.console import Console

from probe_kit.retention import Difference, RetentionRow, RetentionTable, retention_table
from probe_kit.retention.columns.columns import TABLES, Column, ColumnGroup, all_columns, averaged_fields, share
from probe_kit.retention.columns.tables import retention_tables
from probe_kit.retention.displays import (
    KnowledgeActionDisplay,
    collect_figures,
)
from probe_kit.retention.report import report_html
from probe_kit.retention.report.page import words_of
from probe_kit.train import ArrayRun, Controls, ControlScore, UntrainedScore, load_results, save_results
from tests.retention.asked_runs import SaidRun, acted, answer_run, probes

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
        kind = next((candidate for candidate in (kind, *get_args(kind)) if is_dataclass(candidate)), kind)
        kind = get_type_hints(kind)[name] if is_dataclass(kind) else kind
    return kind


def test_a_new_column_is_one_declaration_and_stands_in_every_format(
    probed_run: ProbedRun, monkeypatch: pytest.MonkeyPatch, table: RetentionTable
) -> None:
    """The worked example of CONTRIBUTING: the field is in `SuccessRate`, the column is declared."""
    new = share("success.layout_mean", "layout mean %", "Mean of the success rates of both layouts.")
    for text in every_form(table).values():
        assert "layout mean" not in text
    first, *other_groups = TABLES["Success rate"]
    group = ColumnGroup(first.title, (*first.columns, new))
    monkeypatch.setitem(TABLES, "Success rate", (group, *other_groups))  # type: ignore[misc]
    again = retention_table([probed_run({"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]])})])
    for form, text in every_form(again).items():
        assert "layout mean" in text, form
    assert again.means[0].success.layout_mean == again.rows[0].success.layout_mean == 0.6, "means average it too"
    words = words_of([*retention_tables(again.all_rows).values()]).entries["Success rate"]
    assert [meaning for name, meaning, _ in words if name == "layout mean %"] == [new.help]
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
def test_every_averaged_column_holds_numbers(path: str) -> None:
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
    assert {field.name for field in fields(table.rows[0].success)} - {"paired", "ci"} <= set(table.success)


RIGHT = {"color": np.random.default_rng(0).random((20, 2)) < 0.85}
OF_POLICIES = re.compile(
    r"\bcube\b|\bhand\b|success rate|\bSR\b|never moved|outcome rule|the policy|ended on", re.I
)


def vlm(path: Path) -> SaidRun:
    run = answer_run(path, RIGHT)
    save_results(probes(run, {"color": [0.5, 0.9]}), run.location)
    return run


def text_of(page: str) -> str:
    """What a reader can see or point at; the page's own code serves both kinds of run."""
    page = re.sub(r"<style>.*?</style>|<script>.*?</script>", "", page, flags=re.DOTALL)
    return html.unescape(page).replace("\u00a0", " ")


def formats(runs: list[SaidRun]) -> Mapping[str, str]:
    table = retention_table(runs)
    console = Console(width=220, record=True, file=StringIO())
    console.print(table.to_rich("all"))
    exhibits = collect_figures(runs, table)
    return {
        "terminal": console.export_text(),
        "markdown": table.to_markdown(),
        "latex": table.to_latex("all"),
        "notebook": table._repr_html_(),
        "report": text_of(report_html(runs, table)),
        "captions": "\n".join(f"{exhibit.title}: {exhibit.reading}" for exhibit in exhibits),
        "figures": "\n".join(words for exhibit in exhibits for words in written(exhibit.draw())),
    }


def written(figure) -> list[str]:  # type: ignore[no-untyped-def]
    """All words of a figure."""
    from matplotlib.text import Text

    return [text.get_text() for text in figure.findobj(Text)]


@pytest.fixture(scope="module")
def printed_formats(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """One with probes, and one without, of which a note says so."""
    folder = tmp_path_factory.mktemp("asked")
    return formats([vlm(folder), answer_run(folder / "plain", RIGHT, "vlm-tiny")])


FORMATS = ("terminal", "markdown", "latex", "notebook", "report", "captions", "figures")


@pytest.mark.parametrize("name", FORMATS)
def test_a_run_of_answers_is_never_described_as_acting(printed_formats: Mapping[str, str], name: str) -> None:
    assert printed_formats[name]
    assert [line for line in printed_formats[name].splitlines() if OF_POLICIES.search(line)] == []


@pytest.mark.parametrize("name", FORMATS)
def test_a_run_of_answers_is_described_as_answering(printed_formats: Mapping[str, str], name: str) -> None:
    assert re.search(r"accuracy of answers|answers right|knowledge and answers", printed_formats[name], re.I)


def test_the_summary_says_how_many_answers_are_right(printed_formats: Mapping[str, str]) -> None:
    share = 100 * RIGHT["color"].mean()
    assert f"the VLM answers right in {share:.0f} %" in printed_formats["report"]


@pytest.mark.slow
def test_a_policy_is_described_as_before_and_a_mixture_as_both(tmp_path: Path) -> None:
    policy = acted(tmp_path, RIGHT)
    alone, both = formats([policy]), formats([policy, vlm(tmp_path)])
    assert "the cube ends right in" in alone["report"]
    assert "share of its answers that are right" not in alone["report"]
    assert "the cube ends right in" in both["report"]
    assert "share of its answers that are right" in both["report"]
    for name in set(FORMATS) - {"captions", "figures"}:  # of a run without probes none names the rate
        assert re.search(r"success rate", alone[name], re.I), name
        assert not re.search(r"accuracy of answers", alone[name], re.I), name
        assert re.search(r"accuracy of answers", both[name], re.I), name


def test_axes_and_titles_name_the_share_they_show(tmp_path: Path) -> None:
    table = retention_table([vlm(tmp_path)])
    axes = KnowledgeActionDisplay.from_table(table).plot().ax_
    assert axes is not None
    assert axes.figure.get_supylabel() == "accuracy of answers (%)"


def test_answers_that_cannot_be_read_are_no_cube_that_missed(tmp_path: Path) -> None:
    run = answer_run(tmp_path, RIGHT)
    run.episodes["outcome"] = "oob"
    run.episodes["side_placed"] = "none"
    page = text_of(report_html([run]))
    assert "No answer could be read in 100.0 % of episodes" in page
    assert "reached neither picture" not in page


@pytest.fixture
def table_text(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    """Pictures that give the answer away, an instruction that does not, and an untrained network."""
    run = probed_run({"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]])})
    sites = ("backbone.01.residual", "expert.01.residual@0")
    controls = Controls(
        (
            ControlScore("pixels", "color", 0.75, (0.7, 0.8), 0.005, 0.5, 200),
            ControlScore("instruction", "color", 0.51, (0.45, 0.57), 0.4, 0.5, 200),
        ),
        tuple(
            UntrainedScore(
                "color", "mean", site, site, True, 0.9, 0.6, gain, (gain - 0.1, gain + 0.1), "pi0 (random weights)"
            )
            for site, gain in zip(sites, (0.3, 0.2), strict=True)
        ),
    )
    save_results(replace(load_results(run), controls=controls), run.path)
    return retention_table([run])


def test_a_baseline_above_chance_is_red_in_every_format(table_text: RetentionTable) -> None:
    console = Console(width=120, file=io.StringIO(), force_terminal=True, color_system="standard")
    console.print(table_text.to_rich("all"))
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "\x1b[1;31m75.0 above chance" in printed
    assert "31m51.0" not in printed
    assert "🔴 **75.0 above chance**" in table_text.to_markdown()
    assert r"\textcolor{red}{75.0 above chance}" in table_text.to_latex("all")


def test_json_has_controls_by_name_and_csv_a_column_each(table_text: RetentionTable) -> None:
    row = json.loads(table_text.to_json())[0]
    assert row["controls"]["baselines"] == {"pixels": 0.75, "instruction": 0.51}
    assert row["controls"]["leaks"] == ["pixels"]
    assert (
        row["controls"]["untrained"],
        row["backbone"]["minus_untrained"],
        row["action"]["minus_untrained"],
    ) == ("pi0 (random weights)", 0.3, 0.2)
    frame = table_text.to_frame()
    assert frame["controls.baselines.pixels"].tolist() == [0.75, 0.75]
    assert frame["action.minus_untrained_ci_high"][0] == pytest.approx(0.3)


def test_controls_take_no_room_where_there_are_none(probed_run: Callable[..., ArrayRun]) -> None:
    bare = retention_table([probed_run({"color": ([0.9], [[0.7]])})])
    assert "Controls" not in bare.to_markdown() + bare.to_latex("all")
