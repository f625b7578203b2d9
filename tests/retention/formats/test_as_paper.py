"""The paper's own numbers: its 96 printed cells, and its formulas by hand."""

import json
from dataclasses import replace
from typing import Any

import pytest

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.formats import EPSILON, paper_regime, paper_retention
from probe_kit.retention.rows.row import ActionPart, BackbonePart
from tests.study.paper_runs import paper, run_of

WORDS = {Regime.KNOWLEDGE: "knowledge", Regime.NO_RELIABLE_KNOWLEDGE: "none", Regime.FAILURE: "failure"}


@pytest.fixture(scope="module")
def policies() -> dict[str, Any]:
    """The printed rates of the policies by category."""
    main = paper("tables")["tables"]["sr_main"]
    return {name: rates for name, rates in main["values"].items() if main["kind"][name] == "vla"}


def test_all_96_cells_of_the_policies_have_the_papers_regime(policies: dict[str, Any]) -> None:
    items = paper("tables")["tables"]["items"]["values"]
    runs = [run_of(name, rates, items) for name, rates in policies.items()]
    cells = {
        (row["model"], row["category"]): WORDS[Regime(row["regime"])]
        for row in retention_table(runs, pairs=()).as_paper.numbers
        if row["category"] != "mean"
    }
    printed = paper("recomputed")["derived_unprinted"]["regimes_by_episodes"]
    assert len(cells) == 96
    assert cells == {(name, category): printed[name][category] for name, category in cells}


def test_an_interval_that_includes_one_half_changes_the_regime_here_and_not_in_the_paper() -> None:
    items = {"color": {"episodes": 300}}
    row = retention_table([run_of("model", {"color": 57.0}, items)]).rows[0]
    assert row.success.regime == Regime.NO_RELIABLE_KNOWLEDGE
    assert row.success.sr is not None
    assert row.success.chance_margin_episodes is not None
    assert paper_regime(row.success.sr, row.success.chance_margin_episodes) == Regime.KNOWLEDGE


@pytest.mark.parametrize(
    ("success", "expected"),
    [
        (0.56, Regime.KNOWLEDGE),
        (0.55, Regime.NO_RELIABLE_KNOWLEDGE),  # the border belongs to the band
        (0.45, Regime.NO_RELIABLE_KNOWLEDGE),
        (0.44, Regime.FAILURE),
    ],
)
def test_three_regimes_meet_at_the_borders_of_the_band(success: float, expected: Regime) -> None:
    assert paper_regime(success, 0.05) == expected


def test_retention_of_given_accuracies_is_the_papers_formula_by_hand() -> None:
    assert paper_retention(0.726, 0.7523) == pytest.approx(0.226 / 0.2523, rel=1e-5)
    assert paper_retention(0.5, 0.9) == 0
    assert paper_retention(0.6, 0.5) == pytest.approx(0.1 / EPSILON)  # finite where the backbone is at chance
    assert paper_retention(0.6, 0.4) == pytest.approx(-1, rel=1e-4)


def with_accuracies(table: RetentionTable, accuracies: dict[str, tuple[float, float]]) -> RetentionTable:
    """The table with these best accuracies of backbone and action by category, none of them shown."""
    rows = [
        replace(
            row,
            view="mean",
            backbone=BackbonePart(peak=accuracies[row.category][0]),
            action=ActionPart(peak=accuracies[row.category][1]),
        )
        for row in table.rows
    ]
    return replace(table, rows=rows, means=[replace(mean, view="mean") for mean in table.means])


def test_the_mean_of_retention_is_over_all_categories_those_without_a_signal_too() -> None:
    rates = {"color": 90.0, "shape": 50.0}
    table = retention_table([run_of("model", rates, {name: {"episodes": 300} for name in rates})])
    numbers = with_accuracies(table, {"color": (0.9, 0.7), "shape": (0.6, 0.7)}).as_paper.numbers
    assert [row["retention"] for row in numbers] == pytest.approx([0.5, 2.0, 1.25], rel=1e-4)
    assert [row["backbone"] for row in numbers] == pytest.approx([0.9, 0.6, 0.75])
    assert numbers[2]["normalised_score"] == pytest.approx(40)


def test_every_format_prints_the_same_cells() -> None:
    rates = {"color": 90.0, "shape": 50.0}
    table = retention_table([run_of("a_b", rates, {name: {"episodes": 300} for name in rates})]).as_paper
    assert [row["sr"] for row in json.loads(table.to_json())] == pytest.approx([0.9, 0.5, 0.7])
    assert table.to_csv().splitlines()[1].startswith("/paper/a_b,a_b,,color,300,0.9,0.0565")
    for text in (table.to_markdown(), table.to_latex()):
        assert "90.0" in text
        assert Regime.KNOWLEDGE in text
    assert r"a\_b" in table.to_latex()
