"""`retention` of one run: the same values in the terminal, Markdown, LaTeX, JSON, CSV and the data frame."""

import json
import re
from typing import Any

import pandas as pd
import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit, probe_kit_process
from tests.acceptance.stored.conftest import StoredRuns
from tests.acceptance.stored.printed_tables import (
    QUANTITIES,
    equal_as_printed,
    intervals,
    leaves,
    quantities_of,
    rows_with,
)


@pytest.fixture(scope="module")
def rows(runs: StoredRuns) -> list[dict[str, Any]]:
    """The rows of the trained policy as JSON: State, Color, and their mean."""
    answer: list[dict[str, Any]] = probe_kit("retention", runs.trained, "--format", "json").json()
    return answer


def test_the_json_has_a_row_per_category_and_their_mean_within_bounds(rows: list[dict[str, Any]]) -> None:
    assert {row["category"] for row in rows} == {"state", "color", "mean"}
    for row in rows:
        for quantity in quantities_of(row).values():
            value, low, high = quantity
            assert low <= value <= high
    by_category = {row["category"]: row for row in rows}
    for value in ("success.sr", "backbone.score", "action.score"):
        state, color, mean = (leaves(by_category[name])[value] for name in ("state", "color", "mean"))
        assert mean == pytest.approx((state + color) / 2)
        assert state != color


def test_success_in_the_table_is_the_share_of_correct_episodes_of_the_run(
    runs: StoredRuns, rows: list[dict[str, Any]]
) -> None:
    episodes = pk.open_run(runs.trained).episodes
    shares = (episodes["outcome"] == "correct").groupby(episodes["category"]).mean()
    for row in rows[:2]:
        assert row["success"]["sr"] == pytest.approx(shares[row["category"]])
        assert row["success"]["n_episodes"] == 24


def test_the_backbones_peak_is_the_best_accuracy_that_train_printed(
    runs: StoredRuns, rows: list[dict[str, Any]]
) -> None:
    scores = pk.load_results(pk.open_run(runs.trained)).scores
    for row in rows[:2]:
        mine = scores[scores["category"] == row["category"]]
        for part, stream in (("backbone", "backbone"), ("action", "expert")):
            assert row[part]["peak"] == mine[mine["stream"] == stream]["accuracy"].max()


@pytest.mark.parametrize("style", ["table", pytest.param("markdown", marks=pytest.mark.slow), "latex"])
def test_every_text_format_shows_the_values_of_the_json(
    style: str, runs: StoredRuns, rows: list[dict[str, Any]]
) -> None:
    # A console of fewer columns has the intervals in the sentences alone.
    text = probe_kit_process("retention", runs.trained, "--format", style, COLUMNS="120").out
    for row in rows:
        printed = intervals(rows_with(text, row["category"]))
        assert set(quantities_of(row)) == set(QUANTITIES)
        for name, exact in quantities_of(row).items():
            assert any(equal_as_printed(three, exact) for three in printed), (style, row["category"], name, text)


def test_markdown_names_every_quantity_above_its_own_value(runs: StoredRuns, rows: list[dict[str, Any]]) -> None:
    text = probe_kit("retention", runs.trained, "--format", "markdown").out
    head = next(cells for cells in rows_with(text, "verdict") if any("backbone" in cell for cell in cells))
    places = {name: next(i for i, cell in enumerate(head) if cell.startswith(name)) for name in QUANTITIES}
    for row in rows:
        cells = next(cells for cells in rows_with(text, row["category"]) if len(cells) == len(head))
        for name, exact in quantities_of(row).items():
            (printed,) = intervals([[cells[places[name]]]])
            assert equal_as_printed(printed, exact)


def test_csv_and_the_data_frame_hold_every_number_of_the_json(
    runs: StoredRuns, rows: list[dict[str, Any]]
) -> None:
    lines = probe_kit("retention", runs.trained, "--format", "csv").rows()
    frame = pk.retention_table([pk.open_run(runs.trained)]).to_frame()
    assert [line["category"] for line in lines] == frame["category"].tolist() == [row["category"] for row in rows]
    compared = 0
    for row, line, (_, framed) in zip(rows, lines, frame.iterrows(), strict=True):
        for name, value in leaves(row).items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            compared += 1
            assert float(line[name]) == pytest.approx(value, rel=1e-12), name
            assert float(framed[name]) == pytest.approx(value, rel=1e-12), name
    assert compared > 100


def test_python_prints_the_table_of_the_command(runs: StoredRuns) -> None:
    table = pk.retention_table([pk.open_run(runs.trained)])
    printed = probe_kit("retention", runs.trained, "--format", "markdown").out
    summary = [line for line in table.to_markdown().splitlines() if line.startswith("| State")]
    assert summary
    assert all(line in printed.splitlines() for line in summary)


@pytest.mark.parametrize("style", ["table", "markdown"])
def test_details_show_success_backbone_action_and_retention_with_more_digits(
    style: str, runs: StoredRuns, rows: list[dict[str, Any]]
) -> None:
    text = probe_kit("retention", runs.trained, "--details", "all", "--format", style).out
    for row in rows:
        finer = [three for three in intervals(rows_with(text, row["category"])) if "." in three[0]]
        for name, exact in quantities_of(row).items():
            assert any(equal_as_printed(three, exact) for three in finer), (row["category"], name)


def test_every_name_of_details_adds_its_own_table_above_the_same_summary(runs: StoredRuns) -> None:
    bare = probe_kit("retention", runs.trained).out
    adds = {}
    for name in ("success", "rules", "probes", "retention", "controls", "interventions"):
        text = probe_kit("retention", runs.trained, "--details", name).out
        assert text.endswith(bare)
        adds[name] = text.removesuffix(bare)
    assert "follow" in adds["interventions"]
    assert len({adds[name] for name in ("success", "retention", "interventions")}) == 3
    del adds["controls"]  # none was run
    assert all(list(rows_with(text, "color")) for text in adds.values())


def test_unknown_formats_and_details_are_refused_with_the_names_that_exist(runs: StoredRuns) -> None:
    for option, unknown, exists in (("--format", "xml", "markdown"), ("--details", "colours", "interventions")):
        answer = probe_kit("retention", runs.trained, option, unknown, code=2)
        assert exists in answer.text
        assert not answer.out


def test_the_json_has_no_value_that_json_does_not_know(runs: StoredRuns) -> None:
    text = probe_kit("compare", runs.trained, runs.untrained, runs.expert, "--format", "json").out
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert not re.search(r"\bNaN\b", text)


def test_a_run_without_probes_has_success_and_says_that_nothing_was_probed(runs: StoredRuns) -> None:
    (row, _) = probe_kit("retention", runs.expert, "--format", "json").json()
    assert row["success"]["sr"] == 1.0
    assert row["backbone"]["score"] is row["action"]["score"] is row["retention"]["value"] is None
    assert "activations" in probe_kit("retention", runs.expert).text
    assert pd.isna(pk.retention_table([pk.open_run(runs.expert)]).to_frame()["retention.value"]).all()
