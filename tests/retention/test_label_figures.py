"""Figures of labels and their page: numbers as pandas and scikit-learn have them, nothing clipped."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from sklearn.metrics import balanced_accuracy_score
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownCategoryError, UnknownSiteError, UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.displays import (
    ClassConfusionDisplay,
    IterationMapDisplay,
    LayerCurveDisplay,
    ModelDepthDisplay,
    PredictedValuesDisplay,
    StepScoresDisplay,
    collect_figures,
    layer_curve,
    step_scores,
)
from probe_kit.retention.displays.display import PARTS
from probe_kit.retention.displays.report_figure import file_names
from probe_kit.retention.report import report_html
from probe_kit.runs import Run, open_run
from probe_kit.train import ProbeResults, Target, load_results, train_probes
from tests.support.recorded_run import write_recorded_run


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def run(labelled_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Probes of a quantity, of classes per inference, and of classes per episode with a name fit for no file."""
    folder = tmp_path_factory.mktemp("labels") / "run"
    shutil.copytree(labelled_run, folder)
    run = open_run(folder)
    for target, permutations in (("sim.tool_y", 39), ("sim.phase", 0)):  # every episode has the same phases
        labels = Target.of_run(run, target)
        train_probes(run, target=labels, permutations=permutations, controls=("step", "state", "instruction"))
    train_probes(run, target=kinds(run), permutations=39, controls=("instruction",))
    return run


def kinds(run: Run) -> Target:
    """Three classes, the same for both layouts of an item."""
    frame = pd.DataFrame({"episode_id": run.episodes["episode_id"]})
    values = [f"kind {number // 2 % 3}" for number in range(len(frame))]
    return Target.read(frame.assign(**{"a/b: <i>": values}), "a/b: <i>")


def test_the_layer_curve_has_the_best_site_of_a_layer_its_own_null_and_the_best_control(run: Run) -> None:
    results = load_results(run, target="sim.tool_y")
    curve = results.curves["all", "mean"]
    display = LayerCurveDisplay.from_results(results, iterations="best")
    backbone, expert = display.streams
    ground = display.grounds[1]
    excess = curve.metric - curve.null.mean(axis=1)
    rows = [row for row, site in enumerate(curve.sites) if site.stream == "expert"]
    best = max(rows, key=lambda row: excess[row])
    assert (expert.layers.tolist(), expert.sites) == ([0], (str(curve.sites[best]),))
    assert expert.score == pytest.approx(curve.metric[best])
    assert ground.chance == pytest.approx(curve.null[best].mean())
    assert ground.null_band is not None
    assert [end[0] for end in ground.null_band] == pytest.approx(np.percentile(curve.null[best], [2.5, 97.5]))
    state = max(results.controls.scores, key=lambda control_score: control_score.score)
    assert ground.control == (state.name, state.score) == ("state", pytest.approx(1.0, abs=0.01))
    table = results.scores.set_index("site")
    assert backbone.low[1] == table.loc["backbone.01.residual", "ci_low"]
    assert not backbone.significant.any(), "the state has it too"
    with pytest.raises(UnknownCategoryError, match="probed: all"):
        LayerCurveDisplay.from_results(results, "color")
    with pytest.raises(UnknownSiteError, match="probed: mean"):
        LayerCurveDisplay.from_results(results, view="last")


@pytest.mark.slow
def test_without_enough_permutations_there_is_no_band_and_without_any_no_chance(run: Run) -> None:
    for permutations, chance in ((9, True), (0, False)):
        train_probes(run, target=Target.of_run(run, "sim.tool_z"), permutations=permutations, controls=())
        figure = layer_curve(load_results(run, target="sim.tool_z"))
        names = {name for axes in figure.axes for name in axes.get_legend_handles_labels()[1]}
        assert "95 % of probes of permuted labels" not in names
        assert ("chance" in names) == chance
        assert "best control" not in names


def test_scores_by_step_are_means_of_the_samples_and_their_mean_is_the_metric(run: Run) -> None:
    results = load_results(run, target="sim.tool_y")
    curve = results.curves["all", "mean"]
    display = StepScoresDisplay.from_results(results, "backbone")
    row = [str(site) for site in curve.sites].index(display.site)
    frame = pd.DataFrame({"step": curve.inferences, "score": curve.scores[row]})
    expected = frame.groupby("step")["score"].mean()
    assert display.steps.tolist() == expected.index.tolist() == [0, 1, 2, 3]
    assert display.score == pytest.approx(expected.to_numpy())
    assert display.score.mean() == pytest.approx(curve.metric[row]), "as many samples at each step"
    table = results.scores[results.scores["view"] == "mean"].set_index("site")
    assert display.signal == table.loc[display.site, "signal"]
    for signal, colour in ((True, PARTS["backbone"].colour), (False, "white")):
        axes = replace(display, signal=signal).plot().ax_
        assert axes.get_lines()[0].get_markerfacecolor() == colour, "open markers where nothing is shown"
    assert list(display.controls) == ["state", "step"], "the best one, and the step"
    for name, scores in display.controls.items():
        (control,) = [control_score for control_score in results.controls.scores if control_score.name == name]
        assert scores.mean() == pytest.approx(control.score)
    assert (display.limits[0] < display.score).all()
    with pytest.raises(UsageError, match="has one step"):
        step_scores(load_results(run, target="a/b: <i>"))


def test_scores_of_classes_by_step_are_balanced_accuracies_of_the_step_and_within_their_interval(run: Run) -> None:
    results = load_results(run, target="sim.phase")
    display = StepScoresDisplay.from_results(results, "backbone")
    curve = results.curves["all", "mean"]
    row = [str(site) for site in curve.sites].index(display.site)
    right = curve.decisions[row] == curve.labels
    frame = pd.DataFrame({"step": curve.inferences, "phase": curve.labels, "right": right})
    of_phases = frame.groupby(["step", "phase"])["right"].mean()
    assert display.score == pytest.approx(of_phases.groupby("step").mean().to_numpy())
    assert curve.scores[row].max() > 1, "weights of the whole window exceed 1 at a rare phase"
    for score in (display.score, *display.controls.values()):
        assert ((score >= 0) & (score <= 1)).all()
    assert (display.limits[0] <= display.score + 1e-12).all()
    assert (display.score <= display.limits[1] + 1e-12).all()


def test_places_behind_an_event_are_stored_and_shown_as_such(run: Run) -> None:
    event = Target.of_run(run, "sim.phase").equal_to("holding")
    labels = Target.of_run(run, "sim.cube_x")
    results = train_probes(run, target=labels, permutations=0, controls=("step",), align_to=event)
    curve = results.curves["all", "mean"]
    assert curve.steps.tolist() == [0, 1]
    assert curve.inferences.min() == 2, "the grasp is seen at inference 2"
    display = StepScoresDisplay.from_results(results, "expert")
    assert display.from_event
    assert display.steps.tolist() == [0, 1]
    axes = display.plot().ax_
    assert axes is not None
    assert axes.get_xlabel() == "inferences from the event on"


def test_a_confusion_matrix_counts_held_out_predictions(run: Run) -> None:
    results = load_results(run, target="a/b: <i>")
    curve = results.curves["all", "mean"]
    display = ClassConfusionDisplay.from_results(results, "backbone")
    row = [str(site) for site in curve.sites].index(display.site)
    predicted = curve.decisions[row]
    expected = pd.crosstab(curve.labels, predicted).reindex(index=range(3), columns=range(3), fill_value=0)
    np.testing.assert_array_equal(display.counts, expected.to_numpy())
    balanced = balanced_accuracy_score(curve.labels, predicted)
    assert np.diag(display.shares).mean() == pytest.approx(balanced)
    assert curve.metric[row] == pytest.approx(balanced)
    axes = display.plot().ax_
    assert axes is not None
    assert [text.get_text() for text in axes.texts] == [f"{100 * share:.0f}" for share in display.shares.ravel()]
    with pytest.raises(UsageError, match="is continuous"):
        ClassConfusionDisplay.from_results(load_results(run, target="sim.tool_y"))


def test_predicted_values_are_held_out_and_coloured_by_group(run: Run) -> None:
    results = load_results(run, target="sim.tool_y")
    curve = results.curves["all", "mean"]
    display = PredictedValuesDisplay.from_results(results, "backbone")
    assert display.site == "backbone.01.residual"
    np.testing.assert_array_equal(display.true, curve.labels)
    assert np.corrcoef(display.true, display.predicted)[0, 1] > 0.9
    same = curve.groups[:, None] == curve.groups
    np.testing.assert_array_equal(display.groups[:, None] == display.groups, same)
    with pytest.raises(UsageError, match="is of classes"):
        PredictedValuesDisplay.from_results(load_results(run, target="sim.phase"))


@pytest.mark.slow
def test_every_figure_of_a_table_is_drawn_unclipped_and_says_what_it_is_of(run: Run) -> None:
    table = retention_table([run], target=["sim.tool_y", "sim.phase", "a/b: <i>"])
    exhibits = collect_figures([run], table)
    assert [drawn_exhibit.name for drawn_exhibit in exhibits] == [
        "run-sim.tool_y-layer-curves", "run-sim.tool_y-steps", "run-sim.tool_y-predicted",
        "run-sim.phase-layer-curves", "run-sim.phase-steps", "run-sim.phase-confusion",
        "run-a-b-i-layer-curves", "run-a-b-i-confusion",
    ]  # fmt: skip
    for exhibit in exhibits:
        with exhibit.drawn() as figure:
            figure.draw_without_rendering()
            inked = figure.get_tightbbox()
            assert min(inked.x0, inked.y0) > -0.02, exhibit.name
            assert inked.x1 < figure.get_figwidth() + 0.02, exhibit.name
            assert inked.y1 < figure.get_figheight() + 0.02, exhibit.name
            assert f"target {exhibit.subject}" in figure.caption  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="has no rows of"):
        collect_figures([run], retention_table([run], target="sim.phase").of_target("nothing"))


def test_figures_of_accuracies_refuse_probes_of_a_label(run: Run) -> None:
    results = load_results(run, target="sim.tool_y")
    with pytest.raises(UsageError, match=r"is of a side; these probes are of 'sim\.tool_y'"):
        IterationMapDisplay.from_results(results, "all")
    with pytest.raises(UsageError, match=r"some probes are of 'sim\.tool_y'"):
        ModelDepthDisplay.from_results([results])


def test_names_of_files_differ_where_columns_do() -> None:
    assert file_names(["a b", "a-b", "A-b", "../x", "…"]) == ["a-b", "a-b-2", "A-b-3", "x", "label"]


@pytest.mark.slow
def test_the_command_writes_figures_and_a_page_of_several_labels(run: Run, tmp_path: Path) -> None:
    page, folder = tmp_path / "report.html", tmp_path / "figures"
    targets = ["--target", "sim.tool_y", "--target", "a/b: <i>"]
    result = CliRunner().invoke(
        app, ["retention", str(run.path), *targets, "--html", str(page), "--figures", str(folder)]
    )
    assert result.exit_code == 0, result.output
    assert {path.suffix for path in folder.iterdir()} == {".png", ".pdf"}
    assert len(list(folder.iterdir())) == 10
    text = page.read_text(encoding="utf-8")
    assert "a/b: &lt;i&gt;" in text
    assert "<i>" not in text, "a column's name is no markup"
    assert str(tmp_path) not in text, "no path of this machine"
    assert "http://" not in text.replace("http://www.w3.org", ""), "needs no network"
    assert text.count("data:image/svg+xml,") + text.count("data:image/webp") == 5
    assert "control state" in text
    summary = retention_table([run], target=["sim.tool_y", "a/b: <i>"]).summary_table
    assert summary.columns == ("label", "metric", "backbone above chance", "action above chance", "retention")
    assert [cells[-1] for cells in summary.texts] == ["n/a", "n/a"]
    for wrong, message in (
        (["--html", str(tmp_path)], "is a folder"),
        (["--figures", str(page)], "is a file"),
    ):
        result = CliRunner().invoke(app, ["retention", str(run.path), *targets, *wrong])
        assert result.exit_code == 2
        assert message in " ".join(result.stderr.split())


@pytest.mark.slow
def test_the_report_of_sides_has_a_section_of_stored_labels(run: Run) -> None:
    text = report_html([run])
    assert '<details class="part" id="labels">' in text
    assert "sim.tool_y" in text
    assert text.count('href="#labels"') == 1


@pytest.fixture
def results(run: Run) -> ProbeResults:
    return load_results(run, target="sim.tool_y")


@pytest.mark.slow
def test_a_run_without_an_action_stream_shows_what_its_backbone_holds_and_says_what_is_missing(
    tmp_path: Path,
) -> None:
    run = write_recorded_run(tmp_path / "run")
    train_probes(run, target=Target.of_run(run, "dataset.state.y"), permutations=0, controls=())
    table = retention_table([run], target="dataset.state.y")
    assert table.rows[0].retention.note == "n/a (one stream only)"
    assert "no site of the action was probed" in table.rows[0].retention.reason
    assert "no site of the action was probed" in report_html([run], table)
