"""Runs of models that are captured and do not act: the same activations, and no success rate anywhere."""

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from probe_kit.env import SceneSpec
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour import TableRun, success_rate
from probe_kit.retention.compare.compare import Side, compare
from probe_kit.retention.displays.bars import PairedLayoutsDisplay
from probe_kit.retention.displays.report_figure import collect_figures
from probe_kit.retention.report import write_report
from probe_kit.retention.rows.build import RowSettings, run_rows
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from tests.hooks.families.pi0.checkpoints import write_intact

pytestmark = pytest.mark.slow

ACTING = ExtractSettings(
    "pi0-tiny", random_weights=True, categories=("color",), scene=SceneSpec(max_steps=4), env_workers=0
)


@pytest.fixture(scope="module")
def capture_run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The untrained network again, as in `recorded_run`, but only captured, of one category; then probed."""
    settings = ACTING.changed(suite=small_suite.folder, capture_only=True)
    run = extract_run(settings, tmp_path_factory.mktemp("capture_only") / "run")
    train_probes(run, views=["mean"], permutations=5, controls=())
    return open_run(run.path)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pi0 of 32 unnamed dimensions, as its base model."""
    folder = write_intact(tmp_path_factory.mktemp("base") / "pi0")
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    config["input_features"]["observation.state"]["shape"] = [32]
    config["output_features"]["action"]["shape"] = [32]
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    return folder


def test_capture_without_acting_equals_the_first_inference_of_an_acting_run(
    capture_run: Run, recorded_run: Run
) -> None:
    """The same scenes, seeds and weights: bit for bit the first inference of the run that acted."""
    alike = (recorded_run.episodes["category"] == "color").to_numpy()
    acted = capture_run.episodes["episode_id"].isin(recorded_run.episodes["episode_id"]).to_numpy()
    assert list(capture_run.episodes["episode_id"][acted]) == list(recorded_run.episodes["episode_id"][alike])
    assert capture_run.streams == recorded_run.streams
    for stream in capture_run.streams:
        for site in capture_run.sites(stream):
            np.testing.assert_array_equal(
                capture_run.column(site)[acted], recorded_run.column(site)[alike], err_msg=str(site)
            )


def test_nothing_moved_and_the_run_says_so(capture_run: Run) -> None:
    assert set(capture_run.episodes["outcome"]) == {"capture_only"}
    assert not {"cube_x", "never_moved", "side_placed", "distance_correct"} & set(capture_run.episodes)
    assert capture_run.capture_only
    assert not capture_run.has_trajectories
    assert "CAPTURE ONLY" in repr(capture_run)
    assert capture_run.settings["capture_only"] is True
    assert verify_run(capture_run.path, deep=True).ok
    assert capture_run.certificate["hooks_on_equals_hooks_off"]


def test_success_rates_are_not_there_in_any_table(capture_run: Run, recorded_run: Run, tmp_path: Path) -> None:
    table = retention_table([capture_run, recorded_run])
    rows = [row for row in json.loads(table.to_json()) if row["run"]["capture_only"]]
    assert {row["category"] for row in rows} == {"color", "mean"}
    for row in rows:
        nothing = ("sr", "ci", "regime", "share_outside", "normalised_score")
        assert [row["success"][name] for name in nothing] == [None] * 5
        assert row["controls"]["probe_minus_sr"] is None
        assert row["backbone"]["score"] is not None
    acting = [row for row in json.loads(table.to_json()) if not row["run"]["capture_only"]]
    assert all(row["success"]["sr"] is not None for row in acting)
    screen = StringIO()
    Console(file=screen, width=240).print(table.to_rich("all"))
    for text in (table.to_markdown(), table.to_latex("all"), screen.getvalue()):
        assert "n/a" in text
        assert "captured" in text
    assert table.to_frame()["success.sr"].isna().sum() == 2
    assert any("captured activations only and did not act" in note for note in table.notes)
    page = write_report([capture_run, recorded_run], tmp_path / "report.html", table).read_text(encoding="utf-8")
    assert "did not act" in page


def test_groups_of_which_one_did_not_act_are_compared_in_what_both_have(
    capture_run: Run, recorded_run: Run
) -> None:
    both = retention_table({"capture_run": [capture_run], "acting": [recorded_run]})
    assert both.differences == []  # the acting run was not probed, and the other has no success rate
    rows = run_rows(TableRun.of(capture_run), load_results(capture_run), RowSettings(None, "all", ()))
    same = compare(Side("one", (capture_run,), rows), Side("other", (capture_run,), rows))
    assert {row.category for row in same} == {"color", "mean"}
    assert all(row.sr is None and row.paired and row.backbone == 0 for row in same)


def test_questions_about_acting_are_refused(capture_run: Run) -> None:
    with pytest.raises(UsageError, match="was captured"):
        success_rate(capture_run.episodes)
    with pytest.raises(UsageError, match="was captured"):
        PairedLayoutsDisplay.from_run(capture_run)


def test_a_checkpoint_of_another_arm_is_refused_for_acting_with_the_way_out(
    base: Path, small_suite: Suite
) -> None:
    settings = ExtractSettings("pi0", str(base), suite=small_suite.folder, items=2)
    with pytest.raises(CheckpointError, match=r"acts in 32 dimensions.*add --no-act"):
        prepare(settings)


def test_a_checkpoint_of_another_arm_is_captured(base: Path, small_suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings(
        "pi0", str(base), suite=small_suite.folder, categories=("color",), items=2, capture_only=True, batch=3
    )
    run = extract_run(settings, tmp_path / "run")
    assert run.settings["zeros_for"] == ["state"]
    assert len(run.episodes) == 4
    assert np.isfinite(run.column(run.sites("backbone")[-1])).all()


def test_a_run_that_acts_is_another_run(capture_run: Run, small_suite: Suite) -> None:
    acting = prepare(ACTING.changed(suite=small_suite.folder)).identity()
    assert acting["capture_only"] is False
    stored_settings = capture_run.root.own_settings
    assert stored_settings == json.loads(json.dumps(acting)) | {"capture_only": True}


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (ExtractSettings("pi0-tiny", capture_only=True, execute=2), "--execute does not apply"),
        (
            ExtractSettings("pi0-tiny", capture_only=True, captured_calls=2, video="first"),
            "--captured-calls, --video",
        ),
        (ExtractSettings("expert", capture_only=True), "--no-act does not apply"),
    ],
)
def test_options_that_mean_nothing_without_acting_are_refused(settings: ExtractSettings, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        prepare(settings)


def test_a_report_of_a_capture_only_run_alone_draws_probes_and_no_behaviour(capture_run: Run) -> None:
    subjects = [exhibit.subject for exhibit in collect_figures([capture_run], retention_table([capture_run]))]
    assert "probes" in subjects
    assert "behaviour" not in subjects
