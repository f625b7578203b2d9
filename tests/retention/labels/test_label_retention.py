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
from probe_kit.extract import Run, open_run
from probe_kit.hooks import Site
from probe_kit.retention import label_retention_table, measure_label_retention, measure_retention
from probe_kit.train import Labels, ProbeCurve, train_probes
from probe_kit.train.labels.label_results import LabelComparison, LabelControl, LabelControls
from tests.support.label_results import label_results

GROUPS, EACH = 20, 4
BACKBONE, ACTION = (Site("backbone", 0), Site("backbone", 1)), (Site("expert", 0),)


def controls(name: str, score: float, p: float, view: str = "mean") -> LabelControls:
    """One control against every site."""
    sites = [str(site) for site in (*BACKBONE, *ACTION)]
    return LabelControls(
        (LabelControl(name, score, (score, score), None, None),),
        tuple(LabelComparison(name, view, site, score, p) for site in sites),
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
    """With one site per stream nothing is chosen: halvings measure the variance of a mean over groups."""
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, 60, EACH, noise=0.3)
    found = measure_label_retention(results)
    each = results.curves["mean"].scores.reshape(2, 60, EACH).mean(axis=2)
    errors = each.std(axis=1, ddof=1) / np.sqrt(60)
    quantile = stats.t.ppf(0.975, 50)
    for peak, error in zip((found.backbone, found.action), errors, strict=True):
        assert peak.ci[1] is not None
        assert (peak.ci[1] - peak.above) / quantile == pytest.approx(error, rel=0.2)
    # Fieller: ratios r at which |a - r b| is t standard errors, from the variances above and their covariance
    covariance = np.cov(each) / 60
    a, b = found.action.above, found.backbone.above
    V, square = covariance[::-1, ::-1], quantile**2
    limits = np.sort(np.roots([b**2 - square * V[1, 1], -2 * (a * b - square * V[0, 1]), a**2 - square * V[0, 0]]))
    assert found.ci == pytest.approx(tuple(limits), abs=0.06)


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
    own = replace(results.curves["mean"], scores=scores, null=np.full((len(curve.sites), 59), 0.5))
    settings = replace(results.settings, suite="")
    found = measure_label_retention(
        replace(results, curves={"mean": own}, groups=np.asarray(curve.groups, str), settings=settings)
    )
    assert found.value == pytest.approx(sides.value)
    assert found.ci == pytest.approx((sides.interval.low, sides.interval.high))
    assert found.backbone.above == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("planted", "task", "given", "note", "reason"),
    [
        (0.8, "binary", controls("state", 0.79, 0.4), "not shown to exceed state", "state 0.79"),
        (0.31, "binary", controls("state", 0.2, 0.001), "not shown to exceed chance", "chance 0.30, p "),
        (0.34, "continuous", LabelControls(), "n/a (backbone 0.04 above chance)", "expected 0.05 or more"),
    ],
)
def test_without_signal_in_the_backbone_it_is_refused_by_what_is_missing(
    planted: float, task: str, given: LabelControls, note: str, reason: str
) -> None:
    spread = 0.02 if note.startswith("not shown to exceed chance") else 0.0
    results = label_results(
        {BACKBONE[0]: (planted, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, task=task, null_spread=spread
    )  # fmt: skip
    found = measure_label_retention(results.with_controls(given))
    assert not found.defined
    assert note in found.note
    assert reason in found.reason
    assert str(BACKBONE[0]) in found.reason
    assert "abel" in found.reason, "what to do"


def test_labels_that_change_within_episodes_need_the_control_step() -> None:
    results = label_results({BACKBONE[0]: (0.8, 0.3), ACTION[0]: (0.5, 0.4)}, GROUPS, EACH, window=EACH)
    without = measure_label_retention(results.with_controls(controls("state", 0.1, 0.001)))
    assert without.note == "n/a (control step was not run)"
    assert "--controls step,state" in without.reason
    assert measure_label_retention(results.with_controls(controls("step", 0.1, 0.001))).defined


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
    labels = Labels.of_run(run, "sim.tool_y")
    train_probes(run, labels=labels, permutations=39, controls=("step", "instruction"))
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
    assert "--rule is for sides" in " ".join(done.stderr.split())
    done = CliRunner().invoke(app, ["retention", place, "--target", "sim.tool_y", "--html", "report.html"])
    assert done.exit_code == 2
    assert "--html" in done.stderr
    done = CliRunner().invoke(app, ["retention", place, "--target", "sim.tool_z"])
    assert done.exit_code == 2
    assert "'sim.tool_z'" in done.stderr


def test_runs_whose_labels_differ_are_not_put_into_one_table(trained: Run, tmp_path: Path) -> None:
    shutil.copytree(trained.path, tmp_path / "other")
    other = open_run(tmp_path / "other")
    frame = pd.DataFrame({"episode_id": other.episodes["episode_id"], "y": np.arange(len(other.episodes)) / 7})
    for run, values in ((trained, frame), (other, frame.assign(y=frame["y"] + 1))):
        train_probes(run, labels=Labels.read(values, "y", task="continuous"), permutations=9, controls=())
    with pytest.raises(UsageError, match="sha256"):
        label_retention_table([trained, other], "y")
