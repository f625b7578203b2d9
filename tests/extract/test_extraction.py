"""The stored facts besides numbers: content of items, control steps of inferences, seconds, and a label."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import nn
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec, ScriptedExpert
from probe_kit.errors import (
    DiskSpaceError,
    EpisodesFailedError,
    RunDamagedError,
    RunIncompleteError,
    SettingsMismatchError,
    SiteNeverFiredError,
    SuiteError,
    UnknownCategoryError,
    UnknownModelError,
    UsageError,
)
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run, prepare
from probe_kit.extract.rollout.tasks import task_of
from probe_kit.hooks import Site, Tap
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs import Run, label_run, open_run, verify_run
from probe_kit.suite import Suite, build_suite, load_suite
from probe_kit.train import load_results, train_probes
from tests.support.begun_runs import play_first_episodes
from tests.support.killed_commands import run_files
from tests.support.little_run import probe_little_run, write_little_run
from tests.support.plans import make_plan

SHORT = SceneSpec(max_steps=2)
IN_HAND = SceneSpec(start_grasped=True)


class CrashError(Exception):
    """Stands for a crash between two episodes."""


def _crash(*_: object) -> None:
    raise CrashError


def stop_after(count: int):
    def progress(finished: int, _total: int, _outcome: str) -> None:
        if finished == count:
            raise CrashError

    return progress


def test_an_unfinished_run_does_not_read_as_whole(suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, scene=SHORT)
    with pytest.raises(CrashError):
        extract_run(settings, tmp_path / "run", stop_after(1))
    with pytest.raises(RunIncompleteError, match="of 4 episodes"):
        open_run(tmp_path / "run")


def test_other_settings_in_the_same_folder_are_refused_by_name(suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, scene=SHORT)
    extract_run(settings, tmp_path / "run")
    before = run_files(tmp_path / "run")
    other = ExtractSettings("expert", suite=suite.folder, scene=SceneSpec(max_steps=3), seed=1)
    with pytest.raises(
        SettingsMismatchError, match=r"scene\.max_steps: stored 2, asked 3\n  seed: stored 0, asked 1"
    ):
        extract_run(other, tmp_path / "run")
    assert run_files(tmp_path / "run") == before


def test_a_folder_that_is_no_run_is_left_alone(suite: Suite, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("do not touch", encoding="utf-8")
    with pytest.raises(SettingsMismatchError, match="is not a run"):
        extract_run(ExtractSettings("expert", suite=suite.folder), tmp_path)
    assert (tmp_path / "thesis.txt").read_text(encoding="utf-8") == "do not touch"


@pytest.mark.slow
def test_a_crash_while_the_folder_was_made_leaves_nothing_in_the_way(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, scene=SHORT)
    monkeypatch.setattr("probe_kit.runs.writer.create_arrays", _crash)
    with pytest.raises(CrashError):
        extract_run(settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    monkeypatch.undo()
    assert len(extract_run(settings, tmp_path / "run").episodes) == 4


def test_a_nan_action_stops_the_run_and_commits_nothing(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedExpert, "act", lambda _self: np.full(7, np.nan, np.float32))
    with pytest.raises(EpisodesFailedError) as caught:
        extract_run(ExtractSettings("expert", suite=suite.folder), tmp_path / "run")
    assert "a2a-embedded-color" in caught.value.__notes__[0]
    assert "ActionError" in caught.value.__notes__[0]
    assert caught.value.exit_code == 1
    assert open_run(tmp_path / "run", allow_partial=True).episodes.empty


@pytest.mark.slow
def test_a_policy_that_does_nothing_leaves_a_run_in_which_nothing_was_moved(suite: Suite, tmp_path: Path) -> None:
    scene = SceneSpec.preset("act2answer", arm="panda", rendering="raw", max_steps=3)
    run = extract_run(ExtractSettings("idle", suite=suite.folder, scene=scene), tmp_path / "run")
    assert (run.episodes["outcome"] == "oob").all()
    assert run.episodes["never_moved"].all()
    assert run.episodes["is_grasped"].all()


@pytest.mark.slow
def test_sixty_expert_episodes_prove_environment_and_scoring(tmp_path: Path) -> None:
    suite = build_suite(tmp_path / "suite", ["color"], 30)
    for model, rate in (("expert", 1.0), ("expert-mirrored", 0.0)):
        run = extract_run(ExtractSettings(model, suite=suite.folder), tmp_path / model)
        assert len(run.episodes) == 60
        assert (run.episodes["outcome"] == "correct").mean() == rate


def test_both_layouts_of_an_item_start_from_the_same_scene_with_their_own_noise(suite: Suite) -> None:
    plan = prepare(ExtractSettings("expert", suite=suite.folder)).plan
    first, second = plan.episodes[:2]
    assert first.content.item == second.content.item
    assert first.columns["scene_seed"] == second.columns["scene_seed"]
    assert first.policy_seed != second.policy_seed


@pytest.mark.slow
def test_seeds_do_not_depend_on_which_other_episodes_are_run(small_suite: Suite) -> None:
    full_plan = prepare(ExtractSettings("expert", suite=small_suite.folder)).plan.episodes
    part = prepare(ExtractSettings("expert", suite=small_suite.folder, categories=("shape",))).plan.episodes
    seeds = {planned.episode_id: planned.policy_seed for planned in full_plan}
    assert all(seeds[planned.episode_id] == planned.policy_seed for planned in part)


@pytest.mark.slow
def test_runs_that_share_a_policy_hold_the_same_bytes_as_runs_that_load_their_own(
    suite: Suite, tmp_path: Path
) -> None:
    settings = ExtractSettings("pi0-tiny", random_weights=True, suite=suite.folder, scene=SHORT)
    policy = task_of(settings).load(settings)
    shared = [
        prepare(settings.changed(seed=seed), model=policy).run(tmp_path / f"shared-{seed}") for seed in (1, 0)
    ]
    alone = prepare(settings).run(tmp_path / "alone")
    assert (alone.stamp, alone.settings_sha256) == (shared[1].stamp, shared[1].settings_sha256)
    assert shared[0].stamp != alone.stamp
    with pytest.raises(UsageError, match="the loaded policy has random_weights True instead of False"):
        prepare(settings.changed(random_weights=False), model=policy)
    with pytest.raises(UsageError, match="model 'pi0-tiny' instead of 'pi0-tiny-state'"):
        prepare(settings.changed(model="pi0-tiny-state"), model=policy)


def test_the_certificate_names_weights_fires_and_versions(recorded_run) -> None:
    certificate = recorded_run.certificate
    assert certificate["policy"]["weights_sha256"] == recorded_run.settings["weights_sha256"]
    assert certificate["policy"]["random_weights"] is recorded_run.random_weights
    assert certificate["hooks_on_equals_hooks_off"] is True
    assert certificate["fires_per_inference"][str(recorded_run.sites("backbone")[-1])] == 1
    assert certificate["fires_per_inference"]["expert.00.residual"] == 10
    assert certificate["versions"]["lerobot"]


def test_a_machine_path_is_in_no_stored_setting(recorded_run) -> None:
    assert str(Path.home()) not in json.dumps(recorded_run.settings)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"model": "pi0-tyni"}, UnknownModelError, "Did you mean 'pi0-tiny'"),
        ({"model": "expert", "categories": ("colour",)}, UnknownCategoryError, "Did you mean 'color'"),
        ({"model": "expert", "items": 3}, UsageError, "3"),
        ({"model": "expert", "items": 1000}, UsageError, "1000"),
    ],
)
def test_extract_refuses_impossible_settings_before_it_writes(
    small_suite: Suite, tmp_path: Path, settings: dict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        extract_run(ExtractSettings(suite=small_suite.folder, **settings), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_picture_that_changed_on_disk_stops_everything(suite: Suite, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(suite.folder, tmp_path / "suite"))
    next(copy.rglob("*.png")).write_bytes(b"not a picture")
    with pytest.raises(SuiteError, match="changed"):
        extract_run(ExtractSettings("expert", suite=copy), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_that_does_not_fit_the_disk_is_refused_unless_forced(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extraction = prepare(ExtractSettings("pi0-tiny", suite=suite.folder, scene=SHORT))
    full = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: full)
    with pytest.raises(
        DiskSpaceError, match=r"activations .* columns .* probes .* report .* 1.0 kB free.* --force"
    ):
        extraction.run(tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert len(extraction.run(tmp_path / "run", force=True).episodes) == 4


@pytest.mark.slow
def test_the_first_episode_can_be_filmed(suite: Suite, tmp_path: Path) -> None:
    from PIL import Image

    settings = ExtractSettings("expert", suite=suite.folder, scene=IN_HAND, video="first")
    run = extract_run(settings, tmp_path / "run")
    (film,) = (run.path / "videos").glob("*.gif")
    assert "color-correct" in film.name
    with Image.open(film) as gif:
        assert gif.n_frames > 10


def test_a_broken_hook_stops_the_run_at_the_first_episode_with_the_sites_name(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A layer the model never calls: the run must not store something else instead."""
    sound = Pi0.tap

    def broken(policy: Pi0, site: Site) -> Tap:
        tap = sound(policy, site)
        return replace(tap, module=nn.Identity()) if site == Site("backbone", 2) else tap

    monkeypatch.setattr(Pi0, "tap", broken)
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, scene=SHORT)
    with pytest.raises(SiteNeverFiredError, match=r"backbone\.02\.residual"):
        extract_run(settings, tmp_path / "run")
    assert open_run(tmp_path / "run", allow_partial=True).episodes.empty


@pytest.mark.slow
def test_a_device_changes_nothing_in_a_run_but_roundings(suite: Suite, tmp_path: Path, device: str) -> None:
    """Through pooling on the device, page-locked buffers and the bits of tokens."""
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, scene=SHORT, tokens="all", env_workers=0)
    on_cpu = extract_run(settings, tmp_path / "here")
    on_device = extract_run(settings.changed(device=device), tmp_path / "there")
    for stream in on_cpu.streams:
        for site in on_cpu.sites(stream):
            expected = on_cpu.column(site)
            np.testing.assert_allclose(
                on_device.column(site), expected, rtol=0, atol=1e-2 * np.abs(expected).max()
            )
    site = on_cpu.sites("backbone")[-1]
    for ours, theirs in zip(on_device.tokens(site), on_cpu.tokens(site), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-2 * np.abs(theirs).max())


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
    content_hashes = {item.item_id: item.content_sha256 for item in small_suite.items}
    assert acted.items["content_sha256"].tolist() == [
        content_hashes[item_id] for item_id in acted.items["item_id"]
    ]
    assert len(acted.items) == 2
    assert acted.episodes["item_content_sha256"].tolist() == [
        content_hashes[item_id] for item_id in acted.episodes["item_id"]
    ]
    assert acted.suite_parent == small_suite.content_sha256
    assert acted.suite_parent != acted.settings["suite"]["content_sha256"]


@pytest.mark.slow
def test_a_whole_suite_has_no_parent(small_suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("idle", suite=small_suite.folder, scene=SceneSpec(max_steps=1), env_workers=0)
    plan = make_plan(load_suite(small_suite.folder), [], 0, 1, False)
    assert plan.suite_parent is None
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
    rows = plan.columns
    assert {row["wording"] for row in rows} == {"knowledge", "side"}
    content_hashes = {item.item_id: item.content_sha256 for item in suite.items}
    assert all(row["item_content_sha256"] == content_hashes[row["item_id"]] for row in rows)


# -- control steps ------------------------------------------------------------------------------------------


@pytest.mark.slow
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


def test_seconds_of_inference_and_simulation_are_stored_per_episode(recorded_run: Run) -> None:
    seconds = recorded_run.episodes[["seconds_inference", "seconds_simulation"]]
    assert (seconds > 0).all(axis=None)
    assert (seconds.sum(axis=1) < 120).all()


@pytest.mark.slow
def test_runs_that_took_other_seconds_and_were_resumed_are_equal_in_every_other_byte(
    acted: Run, small_suite: Suite, tmp_path: Path
) -> None:
    settings = tiny(small_suite, execute=3, captured_calls=2)
    play_first_episodes(settings, tmp_path / "run", 2)
    begun = open_run(tmp_path / "run", allow_partial=True)
    assert len(begun.episodes) == 2
    before = begun.episodes["seconds_inference"].tolist()
    again = extract_run(settings, tmp_path / "run")
    assert files_of(again.path) == files_of(acted.path)
    assert again.episodes["seconds_inference"].tolist()[: len(before)] == before
    assert files_of(again.path, but=()) != files_of(acted.path, but=())


@pytest.mark.slow
def test_all_seconds_may_be_deleted_and_one_alone_is_damage(acted: Run, tmp_path: Path) -> None:
    run_folder = Path(shutil.copytree(acted.path, tmp_path / "run"))
    (run_folder / "times/00000002.json").unlink()
    with pytest.raises(RunDamagedError, match=r"times/00000002\.json is missing.*delete the folder times"):
        open_run(run_folder)
    assert any("times/00000002.json is missing" in problem for problem in verify_run(run_folder).problems)
    shutil.rmtree(run_folder / "times")
    assert verify_run(run_folder, deep=True).ok
    assert open_run(run_folder).episodes["seconds_inference"].isna().all()
    assert open_run(run_folder).stamp == acted.stamp


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
    relabelled = open_run(run.path)
    assert (relabelled.label, load_results(relabelled).label, load_results(relabelled).key) == (
        "π0 · mine",
        "π0 · mine",
        key,
    )
    assert train_probes(relabelled, permutations=2).key == key
    assert (relabelled.stamp, relabelled.settings_sha256, relabelled.root.identity) == (
        run.stamp, run.settings_sha256, run.root.identity,
    )  # fmt: skip
    assert {name for name, content in files_of(run.path).items() if before.get(name) != content} <= {
        name for name in before if name.endswith("times.json")
    }


@pytest.mark.parametrize("label", ["", "two\nlines", "x" * 201])
def test_a_label_that_no_table_can_print_is_refused(recorded_run: Run, label: str) -> None:
    with pytest.raises(UsageError, match="expected 1 to 200 printable characters"):
        label_run(recorded_run.path, label)


def test_a_lost_label_and_one_of_another_run_are_damage_that_a_new_label_repairs(
    recorded_run: Run, tmp_path: Path
) -> None:
    run_folder = Path(shutil.copytree(recorded_run.path, tmp_path / "run"))
    (run_folder / "label.json").unlink()
    with pytest.raises(RunDamagedError, match=r"label\.json is missing.*probe-kit run show .* --label"):
        open_run(run_folder)
    assert any("label.json is missing" in problem for problem in verify_run(run_folder).problems)
    result = CliRunner().invoke(app, ["run", "show", str(run_folder), "--label", "again"])
    assert result.exit_code == 0, result.output
    assert open_run(run_folder).label == "again"
    refused = CliRunner().invoke(app, ["run", "show", str(run_folder), "--partial"])
    assert refused.exit_code == 2
    assert "--partial is for --action-errors" in refused.stderr
    content = json.loads((run_folder / "label.json").read_text(encoding="utf-8"))
    (run_folder / "label.json").write_text(json.dumps({**content, "label": "forged"}), encoding="utf-8")
    with pytest.raises(RunDamagedError, match=r"label\.json was changed"):
        open_run(run_folder)


@pytest.mark.slow
def test_an_asked_run_has_all_of_it_too(small_suite: Suite, tmp_path: Path) -> None:
    settings = AskSettings(
        "vlm-tiny", random_weights=True, suite=small_suite.folder, categories=("color",), items=2
    )
    run = ask_run(settings, tmp_path / "run")
    assert run.control_steps.tolist() == [[0]] * 4
    assert (run.episodes[["seconds_inference", "seconds_simulation"]] > 0).all(axis=None)
    assert run.items["content_sha256"].str.fullmatch("[0-9a-f]{64}").all()
    assert run.label.startswith("vlm-tiny")
