import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch import nn

from probe_kit.env import SceneSpec, ScriptedExpert
from probe_kit.errors import (
    DiskSpaceError,
    EpisodesFailedError,
    RunIncompleteError,
    SettingsMismatchError,
    SiteNeverFiredError,
    SuiteError,
    UnknownCategoryError,
    UnknownModelError,
    UsageError,
)
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.extract.rollout.tasks import task_of
from probe_kit.hooks import Site, Tap
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs import open_run
from probe_kit.suite import Suite, build_suite
from tests.support.killed_commands import run_files

SHORT = SceneSpec(max_steps=2)
IN_HAND = SceneSpec(start_grasped=True)


@pytest.fixture(scope="module")
def two_items(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "two", ["color"], 2)


class CrashError(Exception):
    """Stands for a crash between two episodes."""


def _crash(*_: object) -> None:
    raise CrashError


def stop_after(count: int):
    def progress(done: int, _total: int, _outcome: str) -> None:
        if done == count:
            raise CrashError

    return progress


def test_an_unfinished_run_does_not_read_as_whole(two_items: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("expert", suite=two_items.folder)
    with pytest.raises(CrashError):
        extract_run(settings, tmp_path / "run", stop_after(1))
    with pytest.raises(RunIncompleteError, match="of 4 episodes"):
        open_run(tmp_path / "run")


def test_other_settings_in_the_same_folder_are_refused_by_name(two_items: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("expert", suite=two_items.folder, scene=SHORT)
    extract_run(settings, tmp_path / "run")
    before = run_files(tmp_path / "run")
    other = ExtractSettings("expert", suite=two_items.folder, scene=SceneSpec(max_steps=3), seed=1)
    with pytest.raises(
        SettingsMismatchError, match=r"scene\.max_steps: stored 2, asked 3\n  seed: stored 0, asked 1"
    ):
        extract_run(other, tmp_path / "run")
    assert run_files(tmp_path / "run") == before


def test_a_folder_that_is_no_run_is_left_alone(two_items: Suite, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("do not touch", encoding="utf-8")
    with pytest.raises(SettingsMismatchError, match="is not a run"):
        extract_run(ExtractSettings("expert", suite=two_items.folder), tmp_path)
    assert (tmp_path / "thesis.txt").read_text(encoding="utf-8") == "do not touch"


def test_a_crash_while_the_folder_was_made_leaves_nothing_in_the_way(
    two_items: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ExtractSettings("expert", suite=two_items.folder, scene=SHORT)
    monkeypatch.setattr("probe_kit.runs.writer.create_arrays", _crash)
    with pytest.raises(CrashError):
        extract_run(settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    monkeypatch.undo()
    assert len(extract_run(settings, tmp_path / "run").episodes) == 4


def test_a_nan_action_stops_the_run_and_commits_nothing(
    two_items: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedExpert, "act", lambda _self: np.full(7, np.nan, np.float32))
    with pytest.raises(EpisodesFailedError) as caught:
        extract_run(ExtractSettings("expert", suite=two_items.folder), tmp_path / "run")
    assert "a2a-embedded-color" in caught.value.__notes__[0]
    assert "ActionError" in caught.value.__notes__[0]
    assert caught.value.exit_code == 1
    assert open_run(tmp_path / "run", allow_partial=True).episodes.empty


def test_a_policy_that_does_nothing_leaves_a_run_in_which_nothing_was_moved(
    two_items: Suite, tmp_path: Path
) -> None:
    scene = SceneSpec.preset("act2answer", arm="panda", rendering="raw", max_steps=3)
    run = extract_run(ExtractSettings("idle", suite=two_items.folder, scene=scene), tmp_path / "run")
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


def test_both_layouts_of_an_item_start_from_the_same_scene_with_their_own_noise(two_items: Suite) -> None:
    plan = prepare(ExtractSettings("expert", suite=two_items.folder)).plan
    first, second = plan.episodes[:2]
    assert first.content.item == second.content.item
    assert first.columns["scene_seed"] == second.columns["scene_seed"]
    assert first.policy_seed != second.policy_seed


def test_seeds_do_not_depend_on_which_other_episodes_are_run(small_suite: Suite) -> None:
    whole = prepare(ExtractSettings("expert", suite=small_suite.folder)).plan.episodes
    part = prepare(ExtractSettings("expert", suite=small_suite.folder, categories=("shape",))).plan.episodes
    seeds = {planned.episode_id: planned.policy_seed for planned in whole}
    assert all(seeds[planned.episode_id] == planned.policy_seed for planned in part)


@pytest.mark.slow
def test_runs_that_share_a_policy_hold_the_same_bytes_as_runs_that_load_their_own(
    two_items: Suite, tmp_path: Path
) -> None:
    settings = ExtractSettings("pi0-tiny", random_weights=True, suite=two_items.folder, scene=SHORT)
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
def test_what_cannot_be_run_is_refused_before_anything_is_written(
    small_suite: Suite, tmp_path: Path, settings: dict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        extract_run(ExtractSettings(suite=small_suite.folder, **settings), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_picture_that_changed_on_disk_stops_everything(two_items: Suite, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(two_items.folder, tmp_path / "suite"))
    next(copy.rglob("*.png")).write_bytes(b"not a picture")
    with pytest.raises(SuiteError, match="changed"):
        extract_run(ExtractSettings("expert", suite=copy), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_that_does_not_fit_the_disk_is_refused_unless_forced(
    two_items: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extraction = prepare(ExtractSettings("pi0-tiny", suite=two_items.folder, scene=SHORT))
    full = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: full)
    with pytest.raises(
        DiskSpaceError, match=r"activations .* columns .* probes .* report .* 1.0 kB free.* --force"
    ):
        extraction.run(tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert len(extraction.run(tmp_path / "run", force=True).episodes) == 4


@pytest.mark.slow
def test_the_first_episode_can_be_filmed(two_items: Suite, tmp_path: Path) -> None:
    from PIL import Image

    settings = ExtractSettings("expert", suite=two_items.folder, scene=IN_HAND, video="first")
    run = extract_run(settings, tmp_path / "run")
    (film,) = (run.path / "videos").glob("*.gif")
    assert "color-correct" in film.name
    with Image.open(film) as gif:
        assert gif.n_frames > 10


def test_a_broken_hook_stops_the_run_at_the_first_episode_with_the_sites_name(
    two_items: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A layer the model never calls: the run must not store something else instead."""
    sound = Pi0.tap

    def broken(policy: Pi0, site: Site) -> Tap:
        tap = sound(policy, site)
        return replace(tap, module=nn.Identity()) if site == Site("backbone", 2) else tap

    monkeypatch.setattr(Pi0, "tap", broken)
    settings = ExtractSettings("pi0-tiny", suite=two_items.folder, scene=SHORT)
    with pytest.raises(SiteNeverFiredError, match=r"backbone\.02\.residual"):
        extract_run(settings, tmp_path / "run")
    assert open_run(tmp_path / "run", allow_partial=True).episodes.empty


@pytest.mark.slow
def test_a_device_changes_nothing_in_a_run_but_roundings(two_items: Suite, tmp_path: Path, device: str) -> None:
    """Through pooling on the device, page-locked buffers and the bits of tokens."""
    settings = ExtractSettings("pi0-tiny", suite=two_items.folder, scene=SHORT, tokens="all", env_workers=0)
    here = extract_run(settings, tmp_path / "here")
    there = extract_run(settings.changed(device=device), tmp_path / "there")
    for stream in here.streams:
        for site in here.sites(stream):
            expected = here.column(site)
            np.testing.assert_allclose(there.column(site), expected, rtol=0, atol=1e-2 * np.abs(expected).max())
    site = here.sites("backbone")[-1]
    for ours, theirs in zip(there.tokens(site), here.tokens(site), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-2 * np.abs(theirs).max())
