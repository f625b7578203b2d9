"""Runs against each other: pairs, groups of models, VLM − VLA, stages, wordings."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit
from tests.acceptance.stored.conftest import StoredRuns
from tests.acceptance.stored.printed_tables import rows_with


def correct(run: Any, category: str) -> pd.Series:
    """Whether each episode of a category ended right, by item and layout."""
    episodes = pk.open_run(run).episodes
    mine = episodes[episodes["category"] == category]
    return (mine["outcome"] == "correct").set_axis(pd.MultiIndex.from_frame(mine[["item_id", "layout"]]))


def rows_of(answer: Any) -> list[dict[str, Any]]:
    """Rows of a JSON answer, alone or beside comparisons."""
    rows: list[dict[str, Any]] = answer["rows"] if isinstance(answer, dict) else answer
    return rows


def differences(answer: Any) -> list[dict[str, Any]]:
    """Differences of a JSON answer, wherever rows or the table hold them."""
    if isinstance(answer, dict) and "differences" in answer:
        of_groups: list[dict[str, Any]] = answer["differences"]
        return of_groups
    return [difference for row in rows_of(answer) for difference in row.get("differences", [])]


def test_two_runs_are_compared_on_their_common_items_with_a_corrected_p(runs: StoredRuns) -> None:
    answer = probe_kit("compare", runs.trained, runs.untrained, "--format", "json").json()
    rows = {(row["run"]["label"], row["category"]): row for row in rows_of(answer)}
    (color,) = [one for one in differences(answer) if one["category"] == "color"]
    first, second = correct(runs.trained, "color"), correct(runs.untrained, "color")
    assert sorted(first.index) == sorted(second.index)
    assert color["sr"] == pytest.approx(second.mean() - first.mean())  # the other run minus the first
    assert color["sr_ci"][0] <= color["sr"] <= color["sr_ci"][1]
    labels = ("trained", "untrained")
    for part in ("backbone", "action"):
        expected = rows[labels[1], "color"][part]["score"] - rows[labels[0], "color"][part]["score"]
        assert color[part] == pytest.approx(expected, abs=1e-9)
    assert color["n_items"] == 12
    assert color["p"] <= color["p_holm"] <= 1
    assert not [one for one in differences(answer) if one["category"] == "state"], (
        "State was played by one run only"
    )


def test_against_names_the_run_that_is_subtracted_and_the_table_prints_the_difference(runs: StoredRuns) -> None:
    def color(*words: object) -> dict[str, Any]:
        answer = probe_kit("compare", *words, "--format", "json").json()
        return next(one for one in differences(answer) if one["category"] == "color")

    straight = color(runs.trained, runs.untrained)
    turned = color(runs.untrained, runs.trained)
    against = color(runs.untrained, runs.trained, "--reference", runs.untrained)
    assert turned["sr"] > 0.5
    assert straight["sr"] == pytest.approx(-turned["sr"])
    assert against["sr"] == pytest.approx(turned["sr"])
    assert against["backbone"] == pytest.approx(turned["backbone"]) == pytest.approx(-straight["backbone"])
    text = probe_kit("compare", runs.untrained, runs.trained, "--format", "markdown").out
    assert f"+{100 * turned['sr']:.1f}" in text


def test_a_group_of_models_is_compared_with_another_with_the_exact_p_over_models(runs: StoredRuns) -> None:
    groups = (f"right={runs.expert}", f"wrong={runs.mirrored},{runs.idle}")
    typed = ("--kind", "groups", *groups)
    answer = probe_kit("compare", *typed, "--format", "json").json()
    (color,) = [one for one in differences(answer) if one["category"] == "color"]
    assert (color["group"], color["minus"]) == ("wrong", "right")
    rates = {row["run"]["label"]: row["success"]["sr"] for row in rows_of(answer) if row["category"] == "color"}
    assert color["sr"] == pytest.approx((rates["expert-mirrored"] + rates["idle"]) / 2 - rates["expert"])
    models = color["sr_models"]
    assert (models["n"], models["n_minus"]) == (2, 1)
    # Three labelings of one model against two; the observed one is the most extreme.
    assert models["smallest_p"] == pytest.approx(1 / 3)
    assert models["smallest_p"] <= models["p"] <= 1
    assert "wrong - right" in probe_kit("compare", *typed).text.replace("−", "-")


def test_vlm_minus_vla_is_the_paired_difference_on_the_same_first_frames(runs: StoredRuns) -> None:
    answer = probe_kit("compare", runs.asked, runs.trained, "--kind", "vlm-vla", "--format", "json").json()
    pairs = {pair["category"]: pair for pair in answer["vlm_vla"]}
    assert set(pairs) == {"color", "state", "mean"}
    for category in ("color", "state"):
        pair = pairs[category]
        assert pair["same_frames"]
        assert pair["accuracy"] == pytest.approx(correct(runs.asked, category).mean())
        assert pair["sr"] == pytest.approx(correct(runs.trained, category).mean())
        assert pair["difference"] == pytest.approx(pair["accuracy"] - pair["sr"])
        assert pair["difference_ci"][0] <= pair["difference"] <= pair["difference_ci"][1]
        assert 0 < pair["p"] <= pair["p_holm"] <= 1
    # State: the VLM answers it, the policy was not trained to act on it.
    assert pairs["state"]["difference"] > 0.2
    text = probe_kit("compare", runs.asked, runs.trained, "--kind", "vlm-vla").out
    printed = f"{100 * pairs['state']['difference']:.1f}"
    assert any(printed in " ".join(cells) for cells in rows_with(text, "state"))


def test_stages_count_items_by_answered_encoded_and_acted(runs: StoredRuns) -> None:
    typed = ("compare", runs.asked, runs.trained, "--kind", "stages")
    rows = {row["category"]: row for row in probe_kit(*typed, "--format", "json").json()["rows"]}
    for category in ("color", "state"):
        row = rows[category]
        answered, acted = (correct(run, category).groupby("item_id").all() for run in (runs.asked, runs.trained))
        assert row["n_items"] == sum(row["counts"].values()) == 12
        assert row["answered_correctly"] == answered.sum()
        assert row["acted_correctly"] == acted.sum()
        both = sum(number for which, number in row["counts"].items() if which[0] == which[2] == "1")
        assert both == (answered & acted).sum()
        assert row["encoded"] == sum(number for which, number in row["counts"].items() if which[1] == "1")
    text = probe_kit(*typed).out
    for category, row in rows.items():
        printed = " ".join(cell for cells in rows_with(text, category) for cell in cells)
        assert f"{row['answered_correctly']} (" in printed
        assert f"{row['acted_correctly']} (" in printed


@pytest.mark.slow
def test_wordings_of_one_run_are_compared_on_the_same_seeds_and_chosen_by_name(tmp_path: Path) -> None:
    run = tmp_path / "run"
    policy = ("--model", "pi0-tiny", "--random-weights", "--max-steps", "6", "--execute", "3")
    asked = ("--items", "12", "--categories", "color", "--wordings", "knowledge,named", "--env-workers", "0")
    probe_kit("extract", *policy, *asked, "--out", run)
    episodes = pk.open_run(run).episodes
    rates = (episodes["outcome"] == "correct").groupby(episodes["wording"]).mean()
    assert set(rates.index) == {"knowledge", "named"}
    for wording, rate in rates.items():
        answer = probe_kit("retention", run, "--wording", wording, "--format", "json").json()
        assert rows_of(answer)[0]["success"]["sr"] == pytest.approx(rate)
    answer = probe_kit("retention", run, "--format", "json").json()
    (pair,) = [one for one in answer["wordings"] if one["category"] == "color"]
    assert {pair["wording"], pair["other"]} == {"knowledge", "named"}
    assert pair["sr"] == pytest.approx(rates[pair["wording"]])
    assert pair["other_sr"] == pytest.approx(rates[pair["other"]])
    right = (episodes["outcome"] == "correct").groupby(
        [episodes["wording"], episodes["item_id"], episodes["layout"]]
    )
    first, second = (right.first()[pair[name]] for name in ("wording", "other"))
    assert (pair["only"], pair["only_other"]) == ((first & ~second).sum(), (second & ~first).sum())
    assert "knowledge" in probe_kit("retention", run, "--details", "success").text


def test_runs_of_other_seeds_or_items_are_named_and_not_subtracted(runs: StoredRuns, tmp_path: Any) -> None:
    settings = ("--categories", "color", "--items", "4", "--max-steps", "1", "--env-workers", "0", "--seed", "5")
    probe_kit("extract", "--model", "idle", *settings, "--out", tmp_path / "elsewhere")
    answer = probe_kit("compare", runs.expert, tmp_path / "elsewhere", "--format", "json").json()
    assert not differences(answer)
    assert "seed" in probe_kit("compare", runs.expert, tmp_path / "elsewhere").text
