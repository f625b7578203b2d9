"""Retention of a label: scores above each site's own chance, compared with formulas by hand and with sides."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import NoProbesError, UnknownSiteError, UsageError
from probe_kit.hooks import Site
from probe_kit.retention import label_retention_table, measure_label_retention, measure_retention
from probe_kit.retention.behaviour.success_rate import capture_only
from probe_kit.retention.labels.estimate import with_corrected_p
from probe_kit.runs import Run, open_run
from probe_kit.train import ControlComparison, Controls, ControlScore, ProbeCurve, Target, train_probes
from probe_kit.train.results.inventory import stored_probes
from tests.support.label_results import label_results
from tests.support.recorded_run import write_recorded_run

GROUPS, EACH = 20, 4
BACKBONE, ACTION = (Site("backbone", 0), Site("backbone", 1)), (Site("expert", 0),)


def controls(name: str, score: float, p: float, view: str = "mean") -> Controls:
    """One control against every site."""
    sites = [str(site) for site in (*BACKBONE, *ACTION)]
    return Controls(
        (ControlScore(name, "all", score, (score, score), None, None, 80),),
        comparisons=tuple(ControlComparison(name, "all", view, site, score, p) for site in sites),
    )


def test_of_one_site_each_it_is_the_ratio_of_scores_minus_the_chance_of_that_site() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH)
    found = measure_label_retention(results)
    assert found.defined
    assert found.backbone.above == pytest.approx(0.8 - 0.3)
    assert found.action.above == pytest.approx(0.5 - 0.4)
    assert found.value == pytest.approx((0.5 - 0.4) / (0.8 - 0.3))
    assert (found.backbone.score, found.backbone.chance) == pytest.approx((0.8, 0.3))
    low, high = found.backbone.ci
    assert low is not None
    assert high is not None
    assert low < 0.5 < high


def test_its_variance_is_that_of_group_means_and_its_limits_are_fiellers() -> None:
    """With one site per stream nothing is chosen: the variance is that of a mean over groups."""
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, 60, EACH, noise=0.3)
    found = measure_label_retention(results)
    each = results.curves["all", "mean"].scores.reshape(2, 60, EACH).mean(axis=2)
    errors = each.std(axis=1, ddof=1) / np.sqrt(60)
    quantile = stats.t.ppf(0.975, 59)
    for peak, error in zip((found.backbone, found.action), errors, strict=True):
        assert peak.ci[1] is not None
        assert (peak.ci[1] - peak.above) / quantile == pytest.approx(error)
    # Fieller: ratios r at which |a - r b| is t standard errors, from the variances above and their covariance
    covariance = np.cov(each) / 60
    a, b = found.action.above, found.backbone.above
    V, square = covariance[::-1, ::-1], quantile**2
    limits = np.sort(np.roots([b**2 - square * V[1, 1], -2 * (a * b - square * V[0, 1]), a**2 - square * V[0, 0]]))
    assert found.ci == pytest.approx(tuple(limits))


def test_a_site_is_chosen_by_what_it_has_above_its_own_chance() -> None:
    results = label_results(
        {BACKBONE[0]: (0.95, 0.9), BACKBONE[1]: (0.6, 0.1), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH
    )
    found = measure_label_retention(results)
    assert found.backbone.site == str(BACKBONE[1])
    assert found.backbone.above == pytest.approx(0.5)


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
    own = replace(
        results.curves["all", "mean"], sample_scores=scores, null=null, inner=curve.inner, groups=curve.groups,
        fold_of=curve.fold_of,
    )  # fmt: skip
    settings = replace(results.settings, seed_text="")
    found = measure_label_retention(replace(results, curves={("all", "mean"): own}, settings=settings))
    assert found.value == pytest.approx(sides.value)
    assert found.ci == pytest.approx((sides.interval.low, sides.interval.high))
    assert found.backbone.above == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("planted", "task", "given", "note", "reason"),
    [
        (0.8, "binary", controls("state", 0.79, 0.4), "not shown to exceed state", "state 0.79"),
        (0.31, "binary", controls("state", 0.2, 0.001), "not shown to exceed chance", "chance 0.30, p "),
        (0.34, "continuous", Controls(), "n/a (backbone 0.04 above chance)", "expected 0.05 or more"),
    ],
)
def test_without_signal_in_the_backbone_it_is_refused_by_what_is_missing(
    planted: float, task: str, given: Controls, note: str, reason: str
) -> None:
    spread = 0.02 if note.startswith("not shown to exceed chance") else 0.0
    results = label_results(
        {BACKBONE[0]: (planted, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, task=task, null_spread=spread
    )  # fmt: skip
    found = measure_label_retention(replace(results, controls=given))
    assert not found.defined
    assert note in found.note
    assert reason in found.reason
    assert str(BACKBONE[0]) in found.reason
    assert "abel" in found.reason, "what to do"


def test_labels_that_change_within_episodes_need_the_control_step() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, window=EACH)
    without = measure_label_retention(replace(results, controls=controls("state", 0.1, 0.001)))
    assert without.note == "n/a (control step was not run)"
    assert "--controls step,state" in without.reason
    assert measure_label_retention(replace(results, controls=controls("step", 0.1, 0.001))).defined


def test_without_permutations_there_is_no_chance_and_no_retention() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, permutations=0)
    found = measure_label_retention(results)
    assert found.note == "n/a (no permutations)"
    assert "--permutations 200" in found.reason


def test_a_run_without_an_action_stream_and_an_unknown_view_or_iteration_are_refused() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3)}, GROUPS, EACH)
    with pytest.raises(NoProbesError, match="no site of the action"):
        measure_label_retention(results)
    both = label_results({BACKBONE[0]: (0.8, 0.3), Site("expert", 0, iteration=1): (0.5, 0.4)}, GROUPS, EACH)
    with pytest.raises(UnknownSiteError, match="probed: mean"):
        measure_label_retention(both, "last")
    with pytest.raises(UsageError, match="iterations"):
        measure_label_retention(both, iterations=7)


@pytest.fixture
def trained(labelled_run: Path, tmp_path: Path) -> Run:
    """A run with stored probes of a quantity that was planted in the backbone alone."""
    shutil.copytree(labelled_run, tmp_path / "run")
    run = open_run(tmp_path / "run")
    labels = Target.of_run(run, "sim.tool_y")
    train_probes(run, target=labels, permutations=39, controls=("step", "instruction"))
    return run


def test_what_was_planted_in_the_backbone_alone_does_not_reach_the_action(trained: Run) -> None:
    table = label_retention_table([trained], "sim.tool_y")
    found = table.rows[0].retention
    assert found.defined
    assert found.backbone.site == "backbone.01.residual"
    assert found.backbone.has_signal
    assert not found.action.has_signal
    assert abs(found.value) < 0.2
    assert found.ci[0] is not None
    assert found.ci[1] is not None
    assert found.ci[0] < found.value < found.ci[1]
    frame = table.to_frame()
    assert frame.loc[0, "retention"] == found.value
    stored = json.loads(table.to_json())
    assert stored[0]["retention"]["backbone"]["site"] == "backbone.01.residual"


def test_the_command_prints_it_in_every_format_and_names_what_a_label_does_not_have(trained: Run) -> None:
    place = str(trained.path)
    for style in ("table", "json", "csv", "markdown", "latex"):
        done = CliRunner().invoke(app, ["retention", place, "--target", "sim.tool_y", "--format", style])
        assert done.exit_code == 0, done.output
        assert "sim.tool" in done.stdout.replace("\\", "")
    done = CliRunner().invoke(app, ["retention", place, "--target", "sim.tool_y", "--rule", "box"])
    assert done.exit_code == 2
    assert "--rule is not for labels of your own" in " ".join(done.stderr.split())
    done = CliRunner().invoke(app, ["retention", place, "--family", "table"])
    assert done.exit_code == 2
    assert "--family is for labels of your own" in " ".join(done.stderr.split())
    done = CliRunner().invoke(app, ["retention", place, "--target", "sim.tool_z"])
    assert done.exit_code == 2
    assert "'sim.tool_z'" in done.stderr


def test_runs_whose_labels_differ_are_not_put_into_one_table(trained: Run, tmp_path: Path) -> None:
    shutil.copytree(trained.path, tmp_path / "other")
    other = open_run(tmp_path / "other")
    frame = pd.DataFrame({"episode_id": other.episodes["episode_id"], "y": np.arange(len(other.episodes)) / 7})
    for run, values in ((trained, frame), (other, frame.assign(y=frame["y"] + 1))):
        train_probes(run, target=Target.read(values, "y", task="continuous"), permutations=9, controls=())
    with pytest.raises(UsageError, match=r"the labels .y. of .*other and .* differ \(sha256"):
        label_retention_table([trained, other], "y")


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
    done = CliRunner().invoke(app, [*command, "--format", "json"])
    assert done.exit_code == 0, done.output
    rows = [row["retention"] for row in json.loads(done.stdout)]
    assert [(row["target"], row["task"], row["metric"]) for row in rows] == [
        ("even", "binary", "balanced accuracy"),
        ("kind", "classes", "balanced accuracy"),
        ("sim.tool_y", "continuous", "R²"),
    ]
    for row, name in zip(rows, NAMES, strict=True):
        alone = label_retention_table([three], name).rows[0].retention
        assert row["value"] == alone.value, "the same as by itself"
    text = label_retention_table([three], NAMES).text
    assert text.columns[:4] == ("label", "metric", "run", "view")
    assert len(text.rows) == len(NAMES), "no row is a mean over tasks"
    for style in ("table", "csv", "markdown", "latex"):
        done = CliRunner().invoke(app, [*command, "--format", style], env={"COLUMNS": "250"})
        assert done.exit_code == 0, done.output
        assert all(name.replace("_", "") in done.stdout.replace("\\", "").replace("_", "") for name in NAMES)


def test_trap_9_the_table_says_how_many_labels_were_tried_and_corrects_them_by_holm(three: Run) -> None:
    alone = label_retention_table([three], NAMES)
    assert (
        alone.sentences[-1]
        == "labelled (random weights) has probes of 3 labels (even, kind, sim.tool_y); p is of each label alone."
    )
    family = label_retention_table([three], NAMES, family="table")
    assert family.sentences[-1].endswith("p is corrected for the 3 labels of this table (Holm).")
    for part in ("backbone", "action"):
        before = [getattr(row.retention, part).p_fwe for row in alone.rows]
        after = [getattr(row.retention, part).p_fwe for row in family.rows]
        assert after == pytest.approx([holm_by_hand(before, p) for p in before])
    assert (
        label_retention_table([three], "kind")
        .sentences[-1]
        .startswith("labelled (random weights) has probes of 3")
    )
    table = pd.DataFrame({"episode_id": three.episodes["episode_id"]})
    table["even"] = np.arange(len(table)) // 2 % 2
    train_probes(three, target=Target.read(table, "even"), permutations=0, controls=())
    tried = label_retention_table([three], "kind").sentences[-1]
    assert "has probes of 4 labels (even in 2 versions, kind, sim.tool_y)" in tried


def holm_by_hand(family: list[float], p: float) -> float:
    """The largest of the smaller p, each times how many of the family are not smaller than it."""
    return min(1.0, max(smaller * sum(other >= smaller for other in family) for smaller in family if smaller <= p))


def test_a_site_that_is_above_chance_alone_may_not_be_among_several_labels() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH)
    found = measure_label_retention(results)
    assert found.defined
    corrected = with_corrected_p(found, results, 0.06, None, 2)
    assert not corrected.defined
    assert corrected.note == "n/a (backbone not shown to exceed chance)"
    assert "p 0.060" in corrected.reason
    assert corrected.action.p_fwe == found.action.p_fwe
    assert corrected.value == found.value


def test_stored_probes_are_chosen_by_key_for_one_target_that_they_are_of(three: Run) -> None:
    labels = Target.of_run(three, "sim.tool_y")
    other = train_probes(three, target=labels, permutations=19, controls=("step",))
    newest = label_retention_table([three], "sim.tool_y")
    assert newest.rows[0].settings == other.key
    first = next(one for one in stored_probes(three) if one.permutations == 39 and "tool_y" in str(one.target))
    place = str(three.path)

    def asked(*further: str) -> tuple[int, str, str]:
        done = CliRunner().invoke(app, ["retention", place, *further, "--format", "csv"])
        return done.exit_code, done.stdout, " ".join(done.stderr.split())

    code, said, _ = asked("--target", "sim.tool_y", "--probes", f"{place}={first.key}")
    assert code == 0
    assert first.key in said
    code, _, error = asked("--target", "kind", "--probes", f"{place}={first.key}")
    assert code == 2
    assert f"the probes {first.key} are of 'sim.tool_y', not of 'kind'" in error
    code, _, error = asked("--target", "kind", "--target", "even", "--probes", f"{place}={first.key}")
    assert code == 2
    assert "a key is of one" in error
    code, _, error = asked("--probes", f"{place}={first.key}")
    assert code == 2, "without --target a key of a label is none of sides"
    assert first.key in error
    with pytest.raises(UsageError, match="'kind' is given twice"):
        label_retention_table([three], ["kind", "kind"])
    code, _, error = asked(place, "--target", "kind")
    assert code == 2
    assert "is given twice" in error


# -- recordings --------------------------------------------------------------------------------------------------


def test_recordings_have_a_table_and_a_page_though_they_have_no_success_rate(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run", expert=True)
    train_probes(
        run, target=Target.of_run(run, "dataset.state.x"), permutations=39, controls=("step", "instruction")
    )
    found = label_retention_table([run], "dataset.state.x")
    assert found.rows[0].run == "shown (capture only)"
    assert found.rows[0].retention.defined
    page = tmp_path / "report.html"
    done = CliRunner().invoke(
        app, ["retention", str(run.path), "--target", "dataset.state.x", "--html", str(page)]
    )
    assert done.exit_code == 0, done.output
    assert "kitchen#" in page.read_text(encoding="utf-8")
    assert "data:image/webp" not in page.read_text(encoding="utf-8"), "no picture of a recording"
    done = CliRunner().invoke(app, ["retention", str(run.path)])
    assert done.exit_code == 2
    assert f"probe-kit targets {run.path}" in " ".join(done.stderr.split())


def test_runs_without_outcomes_have_a_name(trained: Run) -> None:
    episodes = trained.episodes.drop(columns="outcome")
    assert not capture_only(episodes)
    assert capture_only(episodes.assign(outcome="capture_only"))
