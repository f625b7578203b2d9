"""Success rates by outcome rules: what each of them makes of the same episodes."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.env.scoring import RULES, Trajectory
from probe_kit.errors import NoTrajectoryError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.retention import FinalPositionsDisplay, OutcomeRulesDisplay, retention_table, success_rate
from probe_kit.retention.behaviour import rule_sentence
from probe_kit.retention.displays import collect_figures
from probe_kit.retention.report import report_html
from probe_kit.runs import Run, open_run
from probe_kit.statistics.intervals import Share
from probe_kit.suite import build_suite
from probe_kit.train import ArrayRun

from .conftest import outcomes


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A policy that does nothing, in the released scene: four episodes of two steps."""
    pytest.importorskip("rtbdata")
    folder = tmp_path_factory.mktemp("idle")
    suite = build_suite(folder / "suite", ["color"], 2)
    scene = SceneSpec.preset("act2answer", max_steps=2)
    return extract_run(
        ExtractSettings("idle", suite=suite.folder, scene=scene, env_workers=0, frames="none"), folder / "run"
    )


@pytest.mark.parametrize(("rule", "sr"), [("disc", 0.0), ("box", 0.5), ("released-on-tile", 0.0)])
def test_doing_nothing_scores_a_half_by_the_released_rule_and_nothing_by_the_others(
    idle: Run, rule: str, sr: float
) -> None:
    result = CliRunner().invoke(app, ["retention", str(idle.path), "--rule", rule, "--format", "json"])
    assert result.exit_code == 0
    rows = json.loads(result.stdout)
    for row in rows:
        assert (row["rules"]["rule"], row["success"]["sr"], row["rules"]["sr_idle"]) == (rule, sr, sr)
        assert row["rules"]["sr_by_rule"] == {"disc": 0.0, "box": 0.5, "released-on-tile": 0.0}
        assert (row["rules"]["n_grasped"], row["rules"]["sr_grasped"]) == (4, sr)
        assert row["rules"]["behaviour"]["moved"] == row["rules"]["behaviour"]["first_choice_made"] == 0
    if rule == "box":
        assert (
            rows[0]["success"]["sr_left"],
            rows[0]["success"]["sr_right"],
            rows[0]["rules"]["share_answered"],
        ) == (0, 1, 1)
        assert (
            rows[0]["rules"]["share_unmoved_answers"],
            rows[0]["rules"]["idle_side"],
            rows[0]["rules"]["sr_answered"],
        ) == (
            1,
            "right",
            0.5,
        )
    else:
        assert (
            rows[0]["rules"]["share_unmoved_answers"],
            rows[0]["rules"]["idle_side"],
            rows[0]["rules"]["sr_answered"],
        ) == (
            None,
            "none",
            None,
        )


@pytest.mark.slow
def test_tables_name_the_rule_and_say_what_it_gives_away(idle: Run) -> None:
    for rule, why in (("box", "already lies in the zone of the right picture"), ("disc", "lies in neither zone")):
        table = retention_table([idle], rule=rule)
        share = "50.0" if rule == "box" else "0.0"
        sentence = f"a policy that does nothing would score {share} %, as the untouched cube {why}"
        assert sentence in rule_sentence(table.means[0].rules)
        page = report_html([idle], table).replace("\u00a0", " ")
        for text in (table.to_markdown(), table.to_latex("all").replace(r"\%", "%"), page):
            assert sentence in text
            assert f"utcome rule {rule}" in text


def test_the_mean_over_the_last_steps_is_an_option_of_the_rule(idle: Run) -> None:
    row = retention_table([idle], rule="box", last_steps=11).rows[0]
    assert (row.success.sr, row.rules.last_steps) == (0.5, 11)
    assert "mean of the last 11 control steps (all, where there are fewer)" in rule_sentence(row.rules)


def test_shares_of_an_episode_count_as_shares() -> None:
    episodes = outcomes(2, 2, 4)
    episodes["share_correct"] = [1, 0.5, 0, 0, 0.25, 0, 0, 0.25]
    episodes["share_wrong"] = [0, 0.5, 1, 1, 0, 0, 0, 0]
    episodes["share_oob"] = 1 - episodes["share_correct"] - episodes["share_wrong"]
    rate = success_rate(episodes)
    assert (rate.sr, rate.share_wrong, rate.share_outside) == (0.25, 0.3125, 0.4375)
    assert rate.ci[0] < 0.25 < rate.ci[1]
    assert (rate.paired.both, rate.paired.both_wrong) == (1, 1)


def test_a_run_by_another_rule_leaves_the_run_as_it_was(idle: Run) -> None:
    judged = idle.under("box")
    assert judged.episodes["side_placed"].tolist() == ["right"] * 4
    assert judged.episodes["is_success"].sum() == 2
    assert idle.episodes["outcome"].tolist() == ["oob"] * 4
    assert judged.under("disc").episodes["outcome"].tolist() == idle.episodes["outcome"].tolist()
    assert idle.under("disc") is idle
    assert not judged.episodes["never_moved"].any()
    assert idle.episodes["never_moved"].all()


@pytest.mark.slow
def test_a_table_with_its_report_reads_every_trajectory_once(idle: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run, read = open_run(idle.path), Counter[bytes]()
    decode = Trajectory.of_frames

    def counted(frames: Any) -> Trajectory:
        read[frames.tobytes()] += 1
        return decode(frames)

    monkeypatch.setattr(Trajectory, "of_frames", counted)
    table = retention_table([run], rule="box")
    report_html([run], table)
    OutcomeRulesDisplay.from_runs([run])
    assert sum(read.values()) == 4


def test_a_table_without_behaviour_reads_no_trajectory_and_has_the_same_rates(
    idle: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_rows = retention_table([idle]).rows
    monkeypatch.delattr(Trajectory, "of_frames")
    rows = retention_table([open_run(idle.path)], with_behaviour=False).rows
    assert [row.success for row in rows] == [row.success for row in full_rows]
    assert [(row.rules.sr_answered, row.rules.sr_by_rule) for row in rows] == [
        (row.rules.sr_answered, {}) for row in full_rows
    ]
    with pytest.raises(AttributeError):
        retention_table([open_run(idle.path)], rule="box", with_behaviour=False)


def test_every_rule_agrees_with_what_was_stored_where_it_is_the_same(recorded_run: Run) -> None:
    verdicts = recorded_run.judged("disc")
    assert verdicts["outcome"].tolist() == recorded_run.episodes["outcome"].tolist()


def test_rules_stand_side_by_side_on_the_same_episodes(idle: Run) -> None:
    bars = OutcomeRulesDisplay.from_runs([idle]).bars
    assert [bar.rule for bar in bars] == list(RULES)
    assert [bar.shares["correct"] for bar in bars if bar.shares] == [0, 0.5, 0]
    assert [bar.idle for bar in bars] == [0, 0.5, 0]
    OutcomeRulesDisplay.from_runs([idle]).plot()


def test_rules_are_drawn_as_means_over_categories_as_the_tables_have_them(
    tmp_path: Path, outcome_table: Any
) -> None:
    few, many = outcome_table(2, 0, 0, "color"), outcome_table(1, 8, 1, "shape")
    run = ArrayRun(tmp_path, "pi0", "suite", pd.concat([few, many], ignore_index=True), {})
    shares = [row.success.sr for row in retention_table([run]).rows]
    bar = next(bar for bar in OutcomeRulesDisplay.from_runs([run]).bars if bar.shares is not None)
    assert bar.shares["correct"] == pytest.approx(np.mean(shares))
    assert bar.shares["correct"] != pytest.approx((run.episodes["outcome"] == "correct").mean())


def test_figures_follow_the_rule_of_the_table(idle: Run) -> None:
    names = {exhibit.name: exhibit for exhibit in collect_figures([idle], retention_table([idle], rule="box"))}
    assert "outcome-rules" in names
    with names["run-final-positions"].drawn() as figure:
        assert any("2 right · 2 wrong · 0 out" in axes.get_xlabel() for axes in figure.axes)
        zones = [patch for patch in figure.axes[0].patches if patch.get_linestyle() == "--"]
        assert [zone.get_width() for zone in zones] == pytest.approx([0.27, 0.27])  # type: ignore[attr-defined]
    assert FinalPositionsDisplay.from_run(idle).counts["oob"] == 4


def test_a_run_without_trajectories_has_no_rate_by_other_rules(tmp_path: Path) -> None:
    run = ArrayRun(tmp_path / "old", "old", "suite@1#0123456789ab", outcomes(6, 2, 4), {})
    table = retention_table([run], rule="box")
    row = table.rows[0]
    assert (row.success.sr, row.success.regime, row.rules.sr_by_rule, row.success.n_episodes) == (
        None,
        None,
        {},
        12,
    )
    assert json.loads(table.to_json())[0]["success"]["sr"] is None
    assert "n/a" in table.to_markdown()
    assert any("keeps no trajectories" in note for note in table.notes)
    assert retention_table([run]).rows[0].success.sr == 0.5
    assert retention_table([run]).rows[0].rules.sr_answered == 0.75
    assert collect_figures([run], table) == []
    with pytest.raises(NoTrajectoryError, match="groups cannot be compared by the rule box"):
        retention_table({"a": [run]}, rule="box")


def test_radii_belong_to_the_disc(idle: Run) -> None:
    assert retention_table([idle], rule="box").rows[0].rules.sr_by_epsilon == {}
    assert retention_table([idle]).rows[0].rules.sr_by_epsilon
    with pytest.raises(UsageError, match="belong to the outcome rule disc"):
        retention_table([idle], rule="box", epsilons=(0.05,))
    for options in (["--rule", "box", "--epsilons", "0.05"], ["--rule", "boxx"], ["--last-steps", "0"]):
        assert CliRunner().invoke(app, ["retention", "nowhere", *options]).exit_code == 2


def test_a_conditional_share_has_the_interval_of_its_own_episodes() -> None:
    """Korn and Graubard's for a ratio: groups count as far as their episodes have the condition."""
    generator = np.random.default_rng(0)
    groups = np.repeat(np.arange(40), 2)
    answered = generator.random(80) < 0.5
    right = answered & (generator.random(80) < 0.6)
    rate = Share.of(right[answered], groups[answered])
    weighted = Share.of(right, groups, answered)
    assert weighted.value == rate.value == right.sum() / answered.sum()
    assert weighted.interval() == rate.interval()
    by_group = [
        (right[groups == group].sum(), answered[groups == group].sum()) for group in np.unique(groups[answered])
    ]
    share, episodes = rate.value, answered.sum()
    variance = sum((hits - share * size) ** 2 for hits, size in by_group) / episodes**2
    variance *= len(by_group) / (len(by_group) - 1)
    df = episodes**2 / sum(size**2 for _, size in by_group) - 1
    count = min(share * (1 - share) / variance, episodes)
    count *= (stats.t.ppf(0.975, episodes - 1) / stats.t.ppf(0.975, df)) ** 2
    low = stats.beta.ppf(0.025, share * count, (1 - share) * count + 1)
    high = stats.beta.ppf(0.975, share * count + 1, (1 - share) * count)
    assert (rate.interval().low, rate.interval().high) == pytest.approx((low, high))


def test_answered_and_grasped_rates_are_of_their_own_episodes(tmp_path: Path) -> None:
    run = ArrayRun(tmp_path / "run", "pi0", "suite@1#0123456789ab", outcomes(30, 20, 50), {})
    row = retention_table([run]).rows[0]
    assert (row.rules.n_answered, row.rules.sr_answered) == (50, 0.6)
    alone = success_rate(run.episodes[run.episodes["outcome"] != "oob"])
    assert row.rules.sr_answered_ci == pytest.approx(alone.ci)
