"""The stored facts besides numbers: content of items, control steps of inferences, seconds, and a label."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.runs import Run, label_run, open_run, verify_run
from probe_kit.suite import Suite, load_suite
from probe_kit.train import load_results, train_probes
from tests.support.little_run import probe_little_run, write_little_run
from tests.support.plans import make_plan

IN_EVERY_RUN_OTHERWISE = ("times", "certificates", "label.json")


def files_of(run: Path, *, but: tuple[str, ...] = IN_EVERY_RUN_OTHERWISE) -> dict[str, bytes]:
    files = {path.relative_to(run): path.read_bytes() for path in run.rglob("*") if path.is_file()}
    return {str(name): content for name, content in files.items() if name.parts[0] not in but}


def tiny(suite: Suite, **more: Any) -> ExtractSettings:
    scene = SceneSpec(max_steps=more.pop("max_steps", 8))
    return ExtractSettings(
        "pi0-tiny", random_weights=True, suite=suite.folder, categories=("color",), items=2, scene=scene,
        frames="none", **more,
    )  # fmt: skip


def scripted(suite: Suite, **more: Any) -> ExtractSettings:
    return ExtractSettings(
        "idle", suite=suite.folder, categories=("color",), items=2, scene=SceneSpec(max_steps=2), frames="none",
        env_workers=0, **more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def acted(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Four episodes of eight actions, three of each chunk."""
    return extract_run(tiny(small_suite, execute=3, captured_calls=2), tmp_path_factory.mktemp("format") / "run")


# -- items and the suite's parent ---------------------------------------------------------------------------


@pytest.mark.slow
def test_a_plan_names_the_content_of_every_item_and_the_suite_it_was_selected_from(
    acted: Run, small_suite: Suite
) -> None:
    own = {item.item_id: item.content_sha256 for item in small_suite.items}
    assert acted.items["content_sha256"].tolist() == [own[one] for one in acted.items["item_id"]]
    assert len(acted.items) == 2
    assert acted.episodes["item_content_sha256"].tolist() == [own[one] for one in acted.episodes["item_id"]]
    assert acted.suite_parent == small_suite.content_sha256
    assert acted.suite_parent != acted.settings["suite"]["content_sha256"]


def test_a_whole_suite_has_no_parent(small_suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("idle", suite=small_suite.folder, scene=SceneSpec(max_steps=1), env_workers=0)
    plan = make_plan(load_suite(small_suite.folder), [], 0, 1, False)
    assert plan.to_json()["suite_parent"] is None
    with pytest.raises(RuntimeError, match="enough"):
        extract_run(settings, tmp_path / "run", _stop)
    assert open_run(tmp_path / "run", allow_partial=True).suite_parent is None


def _stop(*_: object) -> None:
    raise RuntimeError("enough")


@pytest.mark.parametrize(
    "field", ["instruction", "target_concept", "left_pixels_sha256", "group_id", "correct_side"]
)
def test_an_item_that_asks_or_shows_something_else_has_another_content(small_suite: Suite, field: str) -> None:
    item = small_suite.items[0]
    other = "left" if getattr(item, field) == "right" else "right"
    assert replace(item, **{field: other}).content_sha256 != item.content_sha256
    assert replace(item, license="other", left_file_name="x").content_sha256 == item.content_sha256


def test_an_item_has_one_content_in_all_of_its_wordings(small_suite: Suite) -> None:
    suite = small_suite.select(["color"], 2)
    plan = make_plan(suite, [], 0, 1, False, ("knowledge", "side"))
    rows = plan.to_json()["episodes"]
    assert {row["wording"] for row in rows} == {"knowledge", "side"}
    own = {item.item_id: item.content_sha256 for item in suite.items}
    assert all(row["item_content_sha256"] == own[row["item_id"]] for row in rows)


# -- control steps ------------------------------------------------------------------------------------------


def test_every_inference_has_the_control_step_it_was_made_at(acted: Run) -> None:
    assert acted.control_steps.dtype == np.int64
    assert acted.control_steps.tolist() == [[0, 3, 6]] * 4
    assert acted.episodes["steps"].tolist() == [8] * 4


def test_an_inference_per_action_has_a_control_step_per_action(recorded_run: Run) -> None:
    execute = recorded_run.settings["execute"]
    expected = list(range(0, 4, execute))
    assert recorded_run.control_steps.tolist() == [expected] * len(recorded_run.episodes)


@pytest.mark.slow
def test_who_does_not_act_infers_at_the_first_control_step_and_a_script_never(
    small_suite: Suite, tmp_path: Path
) -> None:
    captured = extract_run(tiny(small_suite, capture_only=True), tmp_path / "captured")
    assert captured.control_steps.tolist() == [[0]] * 4
    played = extract_run(scripted(small_suite), tmp_path / "played")
    assert played.control_steps.shape == (4, 0)
    assert (played.episodes["seconds_inference"] == 0).all()
    assert (played.episodes["seconds_simulation"] > 0).all()


# -- seconds ------------------------------------------------------------------------------------------------


def test_seconds_of_inference_and_simulation_are_stored_per_episode(acted: Run) -> None:
    seconds = acted.episodes[["seconds_inference", "seconds_simulation"]]
    assert (seconds > 0).all(axis=None)
    assert (seconds.sum(axis=1) < 120).all()


@pytest.mark.slow
def test_runs_that_took_other_seconds_and_were_resumed_are_equal_in_every_other_byte(
    acted: Run, small_suite: Suite, tmp_path: Path
) -> None:
    settings = tiny(small_suite, execute=3, captured_calls=2)
    with pytest.raises(RuntimeError, match="enough"):
        extract_run(settings, tmp_path / "run", _stop)
    begun = open_run(tmp_path / "run", allow_partial=True)
    assert 0 < len(begun.episodes) < 4
    before = begun.episodes["seconds_inference"].tolist()
    again = extract_run(settings, tmp_path / "run")
    assert files_of(again.path) == files_of(acted.path)
    assert again.episodes["seconds_inference"].tolist()[: len(before)] == before
    assert files_of(again.path, but=()) != files_of(acted.path, but=())


def test_all_seconds_may_be_deleted_and_one_alone_is_damage(acted: Run, tmp_path: Path) -> None:
    place = Path(shutil.copytree(acted.path, tmp_path / "run"))
    (place / "times/00000002.json").unlink()
    with pytest.raises(RunDamagedError, match=r"times/00000002\.json is missing.*delete the folder times"):
        open_run(place)
    assert any("times/00000002.json is missing" in problem for problem in verify_run(place).problems)
    shutil.rmtree(place / "times")
    assert verify_run(place, deep=True).ok
    assert open_run(place).episodes["seconds_inference"].isna().all()
    assert open_run(place).stamp == acted.stamp


# -- label --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_runs_that_differ_in_their_label_only_are_one_run(small_suite: Suite, tmp_path: Path) -> None:
    first = extract_run(scripted(small_suite, label="mine"), tmp_path / "run")
    before, label = files_of(first.path, but=("label.json",)), first.label
    again = extract_run(scripted(small_suite, label="yours"), tmp_path / "run")
    assert (label, again.label) == ("mine", "yours")
    assert files_of(again.path, but=("label.json",)) == before
    assert "label" not in again.settings
    assert extract_run(scripted(small_suite), tmp_path / "run").label == "yours"
    assert extract_run(scripted(small_suite), tmp_path / "other").label == "idle"
    assert files_of(tmp_path / "other") == files_of(tmp_path / "run")


@pytest.mark.slow
def test_a_label_is_changed_and_stored_probes_are_found_under_the_new_one(
    small_suite: Suite, tmp_path: Path
) -> None:
    run = write_little_run(tmp_path / "run", small_suite.select(["color"]))
    probe_little_run(run)
    before, key = files_of(run.path), load_results(run).key
    label_run(run.path, "π0 · mine")
    named = open_run(run.path)
    assert (named.label, load_results(named).label, load_results(named).key) == ("π0 · mine", "π0 · mine", key)
    assert train_probes(named, permutations=2).key == key
    assert (named.stamp, named.settings_sha256, named.root.identity) == (
        run.stamp, run.settings_sha256, run.root.identity,
    )  # fmt: skip
    assert {name for name, content in files_of(run.path).items() if before.get(name) != content} <= {
        name for name in before if name.endswith("times.json")
    }


@pytest.mark.parametrize("label", ["", "two\nlines", "x" * 201])
def test_what_no_table_can_print_is_no_label(acted: Run, label: str) -> None:
    with pytest.raises(UsageError, match="expected 1 to 200 printable characters"):
        label_run(acted.path, label)


def test_a_lost_label_and_one_of_another_run_are_damage_that_a_new_label_repairs(
    acted: Run, tmp_path: Path
) -> None:
    place = Path(shutil.copytree(acted.path, tmp_path / "run"))
    (place / "label.json").unlink()
    with pytest.raises(RunDamagedError, match=r"label\.json is missing.*probe-kit run show .* --label"):
        open_run(place)
    assert any("label.json is missing" in problem for problem in verify_run(place).problems)
    shown = CliRunner().invoke(app, ["run", "show", str(place), "--label", "again"])
    assert shown.exit_code == 0, shown.output
    assert open_run(place).label == "again"
    refused = CliRunner().invoke(app, ["run", "show", str(place), "--partial"])
    assert refused.exit_code == 2
    assert "--partial is for --action-errors" in refused.stderr
    content = json.loads((place / "label.json").read_text(encoding="utf-8"))
    (place / "label.json").write_text(json.dumps({**content, "label": "forged"}), encoding="utf-8")
    with pytest.raises(RunDamagedError, match=r"label\.json was changed"):
        open_run(place)


def test_an_asked_run_has_all_of_it_too(small_suite: Suite, tmp_path: Path) -> None:
    settings = AskSettings(
        "vlm-tiny", random_weights=True, suite=small_suite.folder, categories=("color",), items=2
    )
    run = ask_run(settings, tmp_path / "run")
    assert run.control_steps.tolist() == [[0]] * 4
    assert (run.episodes[["seconds_inference", "seconds_simulation"]] > 0).all(axis=None)
    assert run.items["content_sha256"].str.fullmatch("[0-9a-f]{64}").all()
    assert run.label.startswith("vlm-tiny")
