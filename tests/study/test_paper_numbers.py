"""The paper's tables through the code of ours: what agrees, what does not, and what cannot be derived.

Runs are made whose rates are the printed ones; tables of them must give the paper's other numbers.
"""

from collections.abc import Mapping
from statistics import fmean
from typing import Any

import pytest

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.behaviour import Regime, regime
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.study.rates import score_table, sides_table, success_table
from probe_kit.study.tables import difference_table, group_table, vlm_vla_table
from probe_kit.suite.categories import category_of
from tests.retention.asked_runs import SaidRun
from tests.study.paper_runs import paper, run_of

REGIMES = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "none",
    Regime.FAILURE: "failure",
}


@pytest.fixture(scope="module")
def tables() -> dict[str, Any]:
    return paper("tables")["tables"]


@pytest.fixture(scope="module")
def derived() -> dict[str, Any]:
    return paper("recomputed")["derived_unprinted"]


@pytest.fixture(scope="module")
def runs(tables: dict[str, Any]) -> dict[str, SaidRun]:
    """The 17 systems of the main table, as policies: what is computed of rates is the same for answers."""
    return {
        name: run_of(name, rates, tables["items"]["values"]) for name, rates in tables["sr_main"]["values"].items()
    }


@pytest.fixture(scope="module")
def rows(runs: dict[str, SaidRun]) -> dict[str, RetentionTable]:
    return {name: retention_table([run]) for name, run in runs.items()}


def by_category(table: RetentionTable) -> Mapping[str, RetentionRow]:
    return {row.category: row for row in table.rows}


@pytest.mark.slow
def test_means_and_normalised_scores_of_17_systems(
    rows: dict[str, RetentionTable], derived: dict[str, Any]
) -> None:
    assert len(rows) == 17
    for name, table in rows.items():
        (mean,) = table.means
        assert mean.success.sr is not None
        assert 100 * mean.success.sr == pytest.approx(derived["mean_accuracy"][name], abs=0.01)
        assert mean.success.normalised_score == pytest.approx(derived["normalised_score"][name], abs=0.01)


def test_the_margin_of_guessing_is_the_papers(rows: dict[str, RetentionTable], derived: dict[str, Any]) -> None:
    for category, row in by_category(rows["OpenVLA"]).items():
        assert row.success.chance_margin_episodes is not None
        assert 100 * row.success.chance_margin_episodes == pytest.approx(
            derived["delta_points"][category], abs=0.001
        )
        assert row.success.n_episodes == (140 if category == "celebrity" else 300)
    half = by_category(rows["OpenVLA"])["color"].success.chance_margin_items
    assert half is not None
    assert 100 * half == pytest.approx(8.002, abs=0.001)


@pytest.mark.slow
def test_the_main_table_has_a_row_per_system_and_the_printed_numbers(
    runs: dict[str, SaidRun], tables: dict[str, Any], derived: dict[str, Any]
) -> None:
    table = retention_table(list(runs.values()), pairs=())
    main, score = success_table(table), score_table(table)
    assert len(main.texts) == 17
    assert main.columns[:2] == ("system", "Emotion")
    for name, *cells in main.texts:
        cell_by_heading = dict(zip(main.columns[1:], cells, strict=True))
        for category, printed in tables["sr_main"]["values"][name].items():
            cell = cell_by_heading[category_of(category).title]
            assert float(cell.split()[0]) == pytest.approx(printed, abs=0.051)
    marked = {(name, at): cell for name, *cells in main.texts for at, cell in enumerate(cells) if cell[-1] == "↑"}
    assert ("Magma", 3) in marked
    assert not any(name == "Paligemma-3B" for name, _ in marked)
    assert {name: float(cell.split()[0]) for name, cell, *_ in score.texts} == pytest.approx(
        derived["normalised_score"], abs=0.01
    )
    assert len(main.numbers) == 17 * (13 + 2), "two domains have several categories"


@pytest.mark.parametrize("unit", ["episodes", "items"])
def test_204_regimes_by_episodes_and_by_items(
    rows: dict[str, RetentionTable], derived: dict[str, Any], unit: str
) -> None:
    regimes = {}
    for name, table in rows.items():
        for category, row in by_category(table).items():
            success = row.success
            margin = getattr(success, f"chance_margin_{unit}")
            assert success.sr is not None
            regime_name, _ = regime(success.sr, margin, success.share_wrong or 0, success.share_outside or 0)
            regimes[name, category] = REGIMES[regime_name]
    expected = derived[f"regimes_by_{unit}"]
    assert len(regimes) == 204
    assert [
        cell_key for cell_key, computed in regimes.items() if expected[cell_key[0]][cell_key[1]] != computed
    ] == []


def test_8_of_204_cells_change_their_regime_between_episodes_and_items(
    rows: dict[str, RetentionTable], derived: dict[str, Any]
) -> None:
    """Our table decides by items, as one question has two layouts, and says so where the paper would not."""
    different = []
    for name, table in rows.items():
        for category, row in by_category(table).items():
            success = row.success
            assert success.sr is not None
            assert success.chance_margin_episodes is not None
            paper_says, _ = regime(
                success.sr, success.chance_margin_episodes, success.share_wrong or 0, success.share_outside or 0
            )
            if paper_says != success.regime:
                different.append(f"{name} {category} {100 * success.sr:.0f}")
    assert different == derived["regimes_that_differ"]


@pytest.mark.slow
def test_46_of_48_means_of_left_and_right_are_the_printed_rate(tables: dict[str, Any]) -> None:
    other = {}
    for name, sides in tables["left_right"]["values"].items():
        rates = {category: (side_rates["left"], side_rates["right"]) for category, side_rates in sides.items()}
        table = retention_table([run_of(name, rates, tables["items"]["values"])])
        printed_table = sides_table(table)
        assert printed_table.texts[0][2] == f"{sides['emotion']['left']:.1f} / {sides['emotion']['right']:.1f}"
        for category, row in by_category(table).items():
            success = row.success
            assert success.sr is not None
            assert (100 * (success.sr_left or 0), 100 * (success.sr_right or 0)) == pytest.approx(rates[category])
            printed = tables["sr_main"]["values"][name][category]
            if abs(100 * success.sr - printed) > 1:
                other[name, category] = (printed, 100 * success.sr)
    assert other == {
        ("SpatialVLA", "time"): (46, pytest.approx(47.5)),
        ("Magma", "shape"): (81, pytest.approx(83.5)),
    }


GROUPS = {
    "robot-only": ["OpenVLA", "SpatialVLA", "pi0"],
    "co-trained": ["Magma", "Xiaomi-Robotics-R0", "InternVLA-M1"],
}


@pytest.mark.slow
def test_co_trained_minus_robot_only_is_10_points_and_p_over_models_a_fifth(
    runs: dict[str, SaidRun], derived: dict[str, Any]
) -> None:
    table = retention_table({group: [runs[name] for name in names] for group, names in GROUPS.items()})
    texts = group_table(table, "co-training").texts
    assert texts[-1][:2] == ("co-trained − robot-only", "mean")
    assert texts[-1][2].startswith("0.200 (0.100)")
    assert texts[-1][3].startswith("+10.1 [")
    *each, mean = table.differences
    assert mean.category == "mean"
    assert mean.sr is not None
    assert 100 * mean.sr == pytest.approx(10.06, abs=0.005)
    computed = {row.category: 100 * (row.sr or 0) for row in each}
    assert computed == pytest.approx(derived["rq5_difference_by_category"], abs=0.005)
    assert sum(gain > 0 for gain in computed.values()) == 11
    assert mean.sr_models is not None
    assert (mean.sr_models.p, mean.sr_models.smallest_p) == (pytest.approx(0.2), pytest.approx(0.1))


def test_without_magma_the_difference_is_half(rows: dict[str, RetentionTable]) -> None:
    means = {name: table.means[0].success.sr or 0 for name, table in rows.items()}
    co_trained, robot_only = ([means[name] for name in GROUPS[group]] for group in ("co-trained", "robot-only"))
    assert 100 * (fmean(co_trained[1:]) - fmean(robot_only)) == pytest.approx(5.51, abs=0.005)


@pytest.mark.slow
def test_the_differences_of_fine_tuning_equal_the_printed_ones(
    runs: dict[str, SaidRun], derived: dict[str, Any]
) -> None:
    names = ["OpenVLA (SFT)", "OpenVLA (RL)", "OpenVLA"]
    table = retention_table([runs[name] for name in names], against="OpenVLA")
    texts = difference_table(table, "tuning").texts
    assert [cells[2].split()[0] for cells in texts if cells[1] == "mean"] == ["-6.2", "-1.1"]
    for name, printed in zip(names[:2], (-6.17, -1.08), strict=True):
        computed = {row.category: 100 * (row.sr or 0) for row in table.differences if row.group == name}
        assert computed["mean"] == pytest.approx(printed, abs=0.005)
        assert computed == pytest.approx(derived[f"rq6 {name} - OpenVLA"], abs=0.005)


@pytest.mark.slow
def test_ablations_minus_the_default_are_paired_on_the_four_categories_in_common(
    tables: dict[str, Any], runs: dict[str, SaidRun], derived: dict[str, Any]
) -> None:
    """The main run has twelve categories, an ablation four: differences are of these, and the rest is left out."""
    checked = 0
    for row in tables["environment_ablations"]["rows"]:
        name = f"{row['ablation']} {row['setting']} {row['model']}"
        if name not in derived["ablation_minus_default"] or row["model"] != "pi0":
            continue
        ablated = run_of(name, row["values"], tables["items"]["values"])
        table = retention_table([ablated, runs[row["model"]]], against=row["model"])
        computed = {
            difference.category: 100 * (difference.sr or 0)
            for difference in table.differences
            if difference.category != "mean"
        }
        assert computed == pytest.approx(derived["ablation_minus_default"][name], abs=0.005)
        assert all(
            difference.paired and difference.n_items == difference.of_items for difference in table.differences
        )
        checked += 1
    assert checked == 5


@pytest.mark.slow
@pytest.mark.parametrize(("vlm", "policy"), [("Prismatic-VLM-7B", "OpenVLA"), ("Paligemma-3B", "pi0")])
def test_vlm_minus_vla_of_the_two_policies_whose_source_is_there(
    tables: dict[str, Any], runs: dict[str, SaidRun], derived: dict[str, Any], vlm: str, policy: str
) -> None:
    vlm_run = run_of(vlm, tables["sr_main"]["values"][vlm], tables["items"]["values"], is_answer_run=True)
    table = retention_table([vlm_run, runs[policy]], vlm_vla=True)
    computed = {row.category: 100 * row.sr for row in table.vlm_vla if row.category != "mean"}
    assert computed == pytest.approx(derived["gap_pairs"][f"{vlm} - {policy}"], abs=0.005)
    assert all(row.paired for row in table.vlm_vla)
    assert len(vlm_vla_table(table.vlm_vla).texts) == 13


def test_the_six_retentions_cannot_be_derived_from_what_is_printed(tables: dict[str, Any]) -> None:
    """They are means of ratios per category, which stand in a figure only; ratios of printed means are others."""
    values = tables["probing_retention"]["values"]
    assert len(values) == 6
    for row in values.values():
        least, most = (
            (row["action"] + sign * 0.005 - 50) / (row["prefix"] - sign * 0.005 - 50) for sign in (-1, 1)
        )
        assert not least <= row["retention"] <= most
