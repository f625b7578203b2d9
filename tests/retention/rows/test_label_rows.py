"""Retention of a label: scores above each site's own chance, compared with formulas by hand and with sides."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks import Site
from probe_kit.retention import measure_retention, retention_table
from probe_kit.retention.behaviour import SuccessRate, capture_only
from probe_kit.retention.columns.text import label_finding
from probe_kit.retention.rows.build import with_corrected_p, with_probes
from probe_kit.retention.rows.row import RetentionRow, RunInfo
from probe_kit.runs import Run, open_run
from probe_kit.statistics.retention import OTHER_TRAINING
from probe_kit.train import (
    ArrayRun,
    ControlComparison,
    Controls,
    ControlScore,
    ProbeCurve,
    ProbeResults,
    Target,
    train_probes,
)
from probe_kit.train.results.inventory import stored_probes
from tests.support.label_results import label_results
from tests.support.recorded_run import write_recorded_run

GROUPS, EACH = 20, 4
BACKBONE, ACTION = (Site("backbone", 0), Site("backbone", 1)), (Site("expert", 0),)


RUN = RunInfo(
    location="runs/made", model="made", random_weights=False, weights_sha256=None, suite="some@1",
    settings="0" * 64, probes=None,
)  # fmt: skip


def measured(results: ProbeResults, view: str = "mean", iterations: int | Literal["all"] = "all") -> RetentionRow:
    """The row of a label."""
    settings = results.settings
    success = SuccessRate(n_episodes=GROUPS, n_items=GROUPS)
    row = RetentionRow(
        category="all", view=view, target=settings.target, task=settings.task, run=RUN, success=success
    )
    return with_probes(row, results, iterations, seed_text=settings.seed_text)[0]


def controls(name: str, score: float, p: float, view: str = "mean") -> Controls:
    """One control against every site."""
    sites = [str(site) for site in (*BACKBONE, *ACTION)]
    return Controls(
        (ControlScore(name, "all", score, (score, score), None, None, 80),),
        comparisons=tuple(ControlComparison(name, "all", view, site, score, p) for site in sites),
    )


def test_of_one_site_each_it_is_the_ratio_of_scores_minus_the_chance_of_that_site() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH)
    row = measured(results)
    assert row.retention.defined
    assert row.backbone.above == pytest.approx(0.8 - 0.3)
    assert row.action.above == pytest.approx(0.5 - 0.4)
    assert row.retention.value == pytest.approx((0.5 - 0.4) / (0.8 - 0.3))
    assert row.retention.published is None, "the paper's ratio is of accuracies above one half"
    assert (row.backbone.peak, row.backbone.chance) == pytest.approx((0.8, 0.3))
    low, high = row.backbone.above_ci
    assert low is not None
    assert high is not None
    assert low < 0.5 < high


def test_its_variance_is_that_of_group_means_and_its_limits_are_fiellers() -> None:
    """With one site per stream nothing is chosen: the variance is that of a mean over groups."""
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, 60, EACH, noise=0.3)
    row = measured(results)
    each = results.curves["all", "mean"].scores.reshape(2, 60, EACH).mean(axis=2)
    errors = each.std(axis=1, ddof=1) / np.sqrt(60)
    quantile = stats.t.ppf(0.975, 59)
    for peak, error in zip((row.backbone, row.action), errors, strict=True):
        assert peak.above_ci[1] is not None
        assert (peak.above_ci[1] - peak.above) / quantile == pytest.approx(error)
    # Fieller: ratios r at which |a - r b| is t standard errors, from the variances above and their covariance
    covariance = np.cov(each) / 60
    a, b = row.action.above, row.backbone.above
    V, square = covariance[::-1, ::-1], (quantile * OTHER_TRAINING) ** 2
    limits = np.sort(np.roots([b**2 - square * V[1, 1], -2 * (a * b - square * V[0, 1]), a**2 - square * V[0, 0]]))
    assert row.retention.ci == pytest.approx(tuple(limits))


def test_a_site_is_chosen_by_what_it_has_above_its_own_chance() -> None:
    results = label_results(
        {BACKBONE[0]: (0.95, 0.9), BACKBONE[1]: (0.6, 0.1), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH
    )
    row = measured(results)
    assert row.backbone.site == str(BACKBONE[1])
    assert row.backbone.above == pytest.approx(0.5)


def test_with_chance_one_half_it_is_retention_of_sides(
    curve_of: Callable[..., ProbeCurve], outcome_table: Callable[..., pd.DataFrame]
) -> None:
    """The same decisions, once as sides and once as a binary label, give one number and one interval."""
    curve = curve_of(outcome_table(100, 100, 0), [0.5, 0.9, 0.7], [[0.55, 0.6], [0.7, 0.6]])
    sides = measure_retention(curve)
    assert sides is not None
    results = label_results(dict.fromkeys(curve.sites, (0.5, 0.5)), 100, 2, suite="")
    scores = curve.correct.astype(float)
    null = np.full((len(curve.sites), 59), 0.5)
    side_curve = replace(
        results.curves["all", "mean"], sample_scores=scores, null=null, inner=curve.inner, groups=curve.groups,
        fold_of=curve.fold_of,
    )  # fmt: skip
    settings = replace(results.settings, seed_text="")
    row = measured(replace(results, curves={("all", "mean"): side_curve}, settings=settings))
    assert row.retention.value == pytest.approx(sides.value)
    assert row.retention.ci == pytest.approx((sides.interval.low, sides.interval.high))
    assert row.backbone.above == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("planted", "task", "control_results", "note", "reason"),
    [
        (0.8, "binary", controls("state", 0.79, 0.4), "not shown to exceed state", "state 0.79"),
        (0.31, "binary", controls("state", 0.2, 0.001), "not shown to exceed chance", "chance 0.30, p "),
        (0.34, "continuous", Controls(), "n/a (backbone 0.04 above chance)", "expected 0.05 or more"),
    ],
)
def test_without_signal_in_the_backbone_it_is_refused_by_what_is_missing(
    planted: float, task: str, control_results: Controls, note: str, reason: str
) -> None:
    spread = 0.02 if note.startswith("not shown to exceed chance") else 0.0
    results = label_results(
        {BACKBONE[0]: (planted, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, task=task, null_spread=spread
    )  # fmt: skip
    row = measured(replace(results, controls=control_results))
    assert not row.retention.defined
    assert note in row.retention.note
    assert reason in row.retention.reason
    assert str(BACKBONE[0]) in row.retention.reason
    assert "abel" in row.retention.reason, "what to do"


def test_labels_that_change_within_episodes_need_the_control_step() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, window=EACH)
    without = measured(replace(results, controls=controls("state", 0.1, 0.001)))
    assert without.retention.note == "n/a (control step was not run)"
    assert "--controls step,state" in without.retention.reason
    assert measured(replace(results, controls=controls("step", 0.1, 0.001))).retention.defined


def test_without_permutations_there_is_no_chance_and_no_retention() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, permutations=0)
    row = measured(results)
    assert row.retention.note == "n/a (no permutations)"
    assert "--permutations 200" in row.retention.reason


def test_a_run_without_an_action_stream_has_no_retention_and_an_unknown_iteration_is_refused() -> None:
    row = measured(label_results({BACKBONE[0]: (0.8, 0.3)}, GROUPS, EACH))
    assert not row.retention.defined
    assert "no site of the action was probed" in row.retention.reason
    assert row.backbone.peak == pytest.approx(0.8), "what the backbone holds is shown all the same"
    assert label_finding(row) == "open: no site of the action was probed."
    both = label_results({BACKBONE[0]: (0.8, 0.3), Site("expert", 0, iteration=1): (0.5, 0.4)}, GROUPS, EACH)
    with pytest.raises(UsageError, match="iterations"):
        measured(both, iterations=7)


@pytest.fixture
def trained(labelled_run: Path, tmp_path: Path) -> Run:
    """A run with stored probes of a quantity that was planted in the backbone alone."""
    shutil.copytree(labelled_run, tmp_path / "run")
    run = open_run(tmp_path / "run")
    labels = Target.of_run(run, "sim.tool_y")
    train_probes(run, target=labels, permutations=39, controls=("step", "instruction"))
    return run


@pytest.mark.slow
def test_a_label_that_only_the_backbone_encodes_does_not_reach_the_action(trained: Run) -> None:
    table = retention_table([trained], target="sim.tool_y")
    (row,) = table.rows
    assert row.retention.defined
    assert row.backbone.site == "backbone.01.residual"
    assert row.backbone.has_signal
    assert not row.action.has_signal
    assert abs(row.retention.value) < 0.2
    assert row.retention.ci[0] is not None
    assert row.retention.ci[1] is not None
    assert row.retention.ci[0] < row.retention.value < row.retention.ci[1]
    frame = table.to_frame()
    assert frame.loc[0, "retention.value"] == row.retention.value
    stored = json.loads(table.to_json())
    assert stored[0]["backbone"]["site"] == "backbone.01.residual"
    assert "%" in stored[0]["finding"] or "not beyond" in stored[0]["finding"]
    with pytest.raises(UnknownSiteError, match=r"not probed in view 'last'; probed: .* in views mean"):
        retention_table([trained], ["last"], target="sim.tool_y")


@pytest.mark.slow
def test_the_command_prints_it_in_every_format_and_names_what_a_label_does_not_have(trained: Run) -> None:
    run_path = str(trained.path)
    for style in ("table", "json", "csv", "markdown", "latex"):
        result = CliRunner().invoke(app, ["retention", run_path, "--target", "sim.tool_y", "--format", style])
        assert result.exit_code == 0, result.output
        assert "sim.tool" in result.stdout.replace("\\", "")
    result = CliRunner().invoke(app, ["retention", run_path, "--target", "sim.tool_y", "--rule", "box"])
    assert result.exit_code == 2
    assert "--rule is not for labels of your own" in " ".join(result.stderr.split())
    result = CliRunner().invoke(app, ["retention", run_path, "--family", "table"])
    assert result.exit_code == 2
    assert "--family is for labels of your own" in " ".join(result.stderr.split())
    result = CliRunner().invoke(app, ["retention", run_path, "--target", "sim.tool_z"])
    assert result.exit_code == 2
    assert "'sim.tool_z'" in result.stderr


def test_runs_whose_labels_differ_are_not_put_into_one_table(trained: Run, tmp_path: Path) -> None:
    shutil.copytree(trained.path, tmp_path / "other")
    other = open_run(tmp_path / "other")
    frame = pd.DataFrame({"episode_id": other.episodes["episode_id"], "y": np.arange(len(other.episodes)) / 7})
    for run, values in ((trained, frame), (other, frame.assign(y=frame["y"] + 1))):
        train_probes(run, target=Target.read(values, "y", task="continuous"), permutations=9, controls=())
    with pytest.raises(UsageError, match=r"the labels .y. of .*other and .* differ \(sha256"):
        retention_table([trained, other], target="y")


# -- several labels in one table ---------------------------------------------------------------------------------


@pytest.fixture
def three(trained: Run) -> Run:
    """Probes of a continuous label, a binary one and one of classes."""
    frame = pd.DataFrame({"episode_id": trained.episodes["episode_id"]})
    for name, count in (("even", 2), ("kind", 3)):
        drawn = np.random.default_rng(0).integers(count, size=len(frame) // 2).repeat(2)
        table = frame.assign(**{name: [f"{name} {number}" for number in drawn]})
        train_probes(trained, target=Target.read(table, name), permutations=39, controls=("instruction",))
    return trained


NAMES = ["even", "kind", "sim.tool_y"]


def test_one_table_has_a_binary_label_one_of_classes_and_a_continuous_one_and_no_mean_of_them(three: Run) -> None:
    command = ["retention", str(three.path), *(part for name in NAMES for part in ("--target", name))]
    result = CliRunner().invoke(app, [*command, "--format", "json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [(row["target"], row["task"]) for row in rows] == [
        ("even", "binary"), ("kind", "classes"), ("sim.tool_y", "continuous"),
    ]  # fmt: skip
    for row, name in zip(rows, NAMES, strict=True):
        alone = retention_table([three], target=name).rows[0].retention
        assert row["retention"]["value"] == alone.value, "the same as by itself"
    table = retention_table([three], target=NAMES)
    for text in (table.summary_table, table.tables()["Retention"]):
        assert text.columns[:2] == ("label", "metric")
        assert [cells[1] for cells in text.texts] == ["balanced accuracy", "balanced accuracy", "R²"]
        assert len(text.rows) == len(NAMES), "no row is a mean over tasks"
    for style in ("table", "csv", "markdown", "latex"):
        result = CliRunner().invoke(app, [*command, "--format", style], env={"COLUMNS": "250"})
        assert result.exit_code == 0, result.output
        assert all(name.replace("_", "") in result.stdout.replace("\\", "").replace("_", "") for name in NAMES)


@pytest.mark.slow
def test_trap_9_the_table_says_how_many_labels_were_tried_and_corrects_them_by_holm(three: Run) -> None:
    alone = retention_table([three], target=NAMES)
    assert (
        alone.notes[-1]
        == "labelled (random weights) has probes of 3 labels (even, kind, sim.tool_y); p is of each label alone."
    )
    family = retention_table([three], target=NAMES, family="table")
    assert family.notes[-1].endswith("p is corrected for the 3 labels of this table (Holm).")
    for part in ("backbone", "action"):
        before = [getattr(row, part).p_fwe for row in alone.rows]
        after = [getattr(row, part).p_fwe for row in family.rows]
        assert after == pytest.approx([holm_by_hand(before, p) for p in before])
    assert (
        retention_table([three], target="kind").notes[-1].startswith("labelled (random weights) has probes of 3")
    )
    table = pd.DataFrame({"episode_id": three.episodes["episode_id"]})
    table["even"] = np.arange(len(table)) // 2 % 2
    train_probes(three, target=Target.read(table, "even"), permutations=0, controls=())
    tried = retention_table([three], target="kind").notes[-1]
    assert "has probes of 4 labels (even in 2 versions, kind, sim.tool_y)" in tried


def holm_by_hand(family: list[float], p: float) -> float:
    """The largest of the smaller p, each times how many of the family are not smaller than it."""
    return min(1.0, max(smaller * sum(other >= smaller for other in family) for smaller in family if smaller <= p))


def test_a_site_that_is_above_chance_alone_may_not_be_among_several_labels() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH)
    row = measured(results)
    assert row.retention.defined
    corrected = with_corrected_p(row, results, 0.06, None, 2)
    assert not corrected.retention.defined
    assert corrected.retention.note == "n/a (backbone not shown to exceed chance)"
    assert "p 0.060" in corrected.retention.reason
    assert corrected.action.p_fwe == row.action.p_fwe
    assert corrected.retention.value == row.retention.value


@pytest.mark.slow
def test_stored_probes_are_chosen_by_key_for_one_target_that_they_are_of(three: Run) -> None:
    labels = Target.of_run(three, "sim.tool_y")
    other = train_probes(three, target=labels, permutations=19, controls=("step",))
    newest = retention_table([three], target="sim.tool_y")
    assert newest.rows[0].run.probes == other.key
    first = next(
        stored for stored in stored_probes(three) if stored.permutations == 39 and "tool_y" in str(stored.target)
    )
    run_path = str(three.path)

    def retention_csv(*options: str) -> tuple[int, str, str]:
        result = CliRunner().invoke(app, ["retention", run_path, *options, "--format", "csv"])
        return result.exit_code, result.stdout, " ".join(result.stderr.split())

    code, csv_text, _ = retention_csv("--target", "sim.tool_y", "--probes", f"{run_path}={first.key}")
    assert code == 0
    assert first.key in csv_text
    code, _, error = retention_csv("--target", "kind", "--probes", f"{run_path}={first.key}")
    assert code == 2
    assert f"the probes {first.key} are of 'sim.tool_y', not of 'kind'" in error
    code, _, error = retention_csv("--target", "kind", "--target", "even", "--probes", f"{run_path}={first.key}")
    assert code == 2
    assert "a key is of one" in error
    code, _, error = retention_csv("--probes", f"{run_path}={first.key}")
    assert code == 2, "without --target a key of a label is none of sides"
    assert first.key in error
    with pytest.raises(UsageError, match="'kind' is given twice"):
        retention_table([three], target=["kind", "kind"])
    code, _, error = retention_csv(run_path, "--target", "kind")
    assert code == 2
    assert "reads one run, and 2 are given" in error


# -- recordings --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_recordings_have_a_table_and_a_page_though_they_have_no_success_rate(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run", expert=True)
    train_probes(
        run, target=Target.of_run(run, "dataset.state.x"), permutations=39, controls=("step", "instruction")
    )
    table = retention_table([run], target="dataset.state.x")
    assert table.rows[0].run.name == "shown (capture only)"
    assert table.rows[0].retention.defined
    page = tmp_path / "report.html"
    result = CliRunner().invoke(
        app, ["retention", str(run.path), "--target", "dataset.state.x", "--html", str(page)]
    )
    assert result.exit_code == 0, result.output
    assert "kitchen#" in page.read_text(encoding="utf-8")
    assert "data:image/webp" not in page.read_text(encoding="utf-8"), "no picture of a recording"
    result = CliRunner().invoke(app, ["retention", str(run.path)])
    assert result.exit_code == 2
    assert f"probe-kit targets {run.path}" in " ".join(result.stderr.split())


def test_runs_without_outcomes_have_a_name(trained: Run) -> None:
    episodes = trained.episodes.drop(columns="outcome")
    assert not capture_only(episodes)
    assert capture_only(episodes.assign(outcome="capture_only"))


def test_runs_of_one_name_are_told_apart(probed_run: Callable[..., ArrayRun], tmp_path: Path) -> None:
    first = probed_run({"color": ([0.5, 0.8], [[0.6]])})
    features = {key: np.ones_like(values) for key, values in first.features.items()}
    other = ArrayRun(tmp_path / "other", first.model, first.suite, first.episodes, features)
    table = retention_table([first, other])
    labels = {row.run.label for row in table.rows}
    assert len(labels) == 2
    assert all(label.startswith("pi0 · ") for label in labels)
    assert {row.run.model for row in table.rows} == {"pi0"}
    assert all(label in table.to_markdown() for label in labels)


def test_a_run_alone_keeps_its_name(probed_run: Callable[..., ArrayRun]) -> None:
    table = retention_table([probed_run({"color": ([0.5, 0.8], [[0.6]])})])
    assert {row.run.label for row in (*table.rows, *table.means)} == {"pi0"}


def test_labels_that_are_given_name_runs_in_tables_figures_and_differences(
    probed_run: Callable[..., ArrayRun],
) -> None:
    first, other = (probed_run({"color": ([0.5, 0.8], [[0.6]])}, name) for name in ("one", "other"))
    table = retention_table([first, other], labels={str(first.location): "π0", str(other.location): "π0 (SFT)"})
    assert [row.run.label for row in table.rows] == ["π0", "π0 (SFT)"]
    assert {(row.group, row.minus) for row in table.differences} == {("π0 (SFT)", "π0")}
    assert {results.label for results in table.results.values()} == {"π0", "π0 (SFT)"}
    assert first.label == "one"
    alike = retention_table([first, other], labels={str(other.location): "one"})
    assert len({row.run.label for row in alike.rows}) == 2
    with pytest.raises(UsageError, match="labels are given for elsewhere; the runs are"):
        retention_table([first], labels={"elsewhere": "π0"})
