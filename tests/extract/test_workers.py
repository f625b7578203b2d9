"""Batches, environment processes and worker processes change how fast a run comes, not what is in it."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import EpisodesFailedError, RunIncompleteError, StageDiedError, UsageError
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.extract.rollout import calibration
from probe_kit.extract.rollout.calibration import _infer, choose, inference_times, largest_batch
from probe_kit.extract.rollout.controllers import PolicyController
from probe_kit.extract.sources.player import ProcessPlayer, reusing_processes
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.hooks.checkpoints.third_party import while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs import open_run
from probe_kit.runs.plan import Row
from probe_kit.suite import Suite, build_suite

SHORT = SceneSpec(max_steps=2)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    """Six items; runs of the policy play four of them."""
    return build_suite(tmp_path_factory.mktemp("suite") / "six", ["color"], 6)


def settings(suite: Suite, **changes: object) -> ExtractSettings:
    return ExtractSettings("pi0-tiny", suite=suite.folder, items=4, scene=SHORT, **changes)


def commits(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in run.glob("commits/*.json")}


@pytest.fixture(scope="module")
def plain(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything in this process, one observation at a time."""
    return extract_run(settings(suite, env_workers=0), tmp_path_factory.mktemp("plain") / "run").path


@pytest.mark.slow
def test_environment_processes_give_the_same_bytes(suite: Suite, plain: Path, tmp_path: Path) -> None:
    run = extract_run(settings(suite, env_workers=2), tmp_path / "run")
    assert commits(run.path) == commits(plain)


@pytest.mark.slow
def test_a_batch_gives_the_same_numbers_up_to_float_rounding(suite: Suite, plain: Path, tmp_path: Path) -> None:
    run, unbatched = extract_run(settings(suite, batch=3, env_workers=0), tmp_path / "run"), open_run(plain)
    for stream in run.streams:
        for site in run.sites(stream):
            np.testing.assert_allclose(run.column(site), unbatched.column(site), rtol=1e-4, atol=1e-4)
    assert run.settings_sha256 == unbatched.settings_sha256
    assert run.episodes["outcome"].tolist() == unbatched.episodes["outcome"].tolist()


def test_a_simulating_process_starts_without_the_array_store_and_torch() -> None:
    """Two are started for every run of some length; the array store alone would double their start."""
    code = (
        "import sys, probe_kit.extract.sources.player; "
        "print([m for m in ('zarr', 'torch', 'pandas', 'xarray') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8").stdout == "[]\n"


@pytest.mark.slow
def test_a_simulator_that_dies_costs_its_episode_and_is_replaced(suite: Suite) -> None:
    planned = prepare(ExtractSettings("expert", suite=suite.folder)).plan.episodes[0]
    stage = ProcessPlayer(partial(ScenePlayer, SHORT))
    try:
        os.kill(stage._child.pid, signal.SIGKILL)
        stage.ask("begin", planned, False)
        with pytest.raises(StageDiedError, match="code -9"):
            stage.answer()
        stage.ask("begin", planned, False)
        assert isinstance(stage.answer(), Observation)
    finally:
        stage.close()


def pictures_of(stage: ProcessPlayer, rows: Sequence[Row]) -> list[NDArray[np.uint8]]:
    """The picture with which each episode begins, and the one after an action."""
    pictures = []
    for row in rows:
        stage.ask("begin", row, False)
        pictures.append(stage.answer().image)
        stage.ask("advance", np.full((1, 7), 0.02, np.float32))
        pictures.append(stage.answer().image)
    return pictures


@pytest.mark.slow
def test_a_player_in_a_process_that_another_one_left_shows_the_same_pictures(suite: Suite) -> None:
    rows = prepare(ExtractSettings("expert", suite=suite.folder)).plan.episodes[:3]
    opens = partial(ScenePlayer, SHORT)
    alone = ProcessPlayer(opens)
    expected = pictures_of(alone, rows)
    alone.close()
    assert alone._child.close() == 0, "outside of the body a process ends with its player"
    with reusing_processes():
        before = ProcessPlayer(partial(ScenePlayer, SceneSpec.preset("act2answer", max_steps=3)))
        pictures_of(before, rows[:1])
        busy = ProcessPlayer(opens)
        busy.ask("begin", rows[0], False)
        busy.close()
        before.close()
        following = ProcessPlayer(opens)
        assert following._child.pid == before._child.pid != busy._child.pid, "one that still works is ended"
        np.testing.assert_array_equal(pictures_of(following, rows), expected)
        following.close()
    assert following._child.close() == 0


@pytest.mark.slow
def test_an_episode_that_fails_twice_is_named_and_all_others_are_kept(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from probe_kit.extract.rollout.controllers import PolicyController

    poison = prepare(ExtractSettings("expert", suite=suite.folder, items=4)).plan.episodes[5]
    infer = PolicyController.infer

    def infer_badly(self, turns):
        bad = [np.float32(np.nan if turn.row.policy_seed == poison.policy_seed else 1) for turn in turns]
        inferences = infer(self, turns)
        return [
            replace(inference, actions=inference.actions * bad[row]) for row, inference in enumerate(inferences)
        ]

    monkeypatch.setattr(PolicyController, "infer", infer_badly)
    with pytest.raises(EpisodesFailedError, match="1 episode failed twice") as caught:
        extract_run(settings(suite, env_workers=0), tmp_path / "run")
    assert poison.episode_id in caught.value.__notes__[0]
    assert caught.value.exit_code == 1
    run = open_run(tmp_path / "run", allow_partial=True)
    assert (len(run.episodes), list(run.failed), run.sealed) == (7, [poison.episode_id], True)
    with pytest.raises(RunIncompleteError, match="1 failed"):
        open_run(tmp_path / "run")
    monkeypatch.undo()
    assert len(extract_run(settings(suite), tmp_path / "run").episodes) == 8
    assert not (tmp_path / "run/failed").exists()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["expert", "pi0-tiny"])
def test_two_workers_one_of_them_killed_give_the_same_bytes(model: str, suite: Suite, tmp_path: Path) -> None:
    alone = ExtractSettings(model, suite=suite.folder, scene=SHORT, env_workers=0)
    plain = extract_run(alone, tmp_path / "plain").path
    command = [sys.executable, "-m", "probe_kit", "extract", "--model", model, "--suite", str(suite.folder)]
    command += ["--scene", "bridge", "--max-steps", "2", "--workers", "2", "--env-workers", "0", "--out"]
    for attempt in range(5):  # on a busy machine a run may end before its worker is killed
        run = tmp_path / f"run-{attempt}"
        process = subprocess.Popen([*command, str(run)], stderr=subprocess.PIPE, encoding="utf-8")
        killed = _kill_a_worker(process.pid, run)
        _, messages = process.communicate(timeout=120)
        assert process.returncode == 0, messages
        assert commits(run) == commits(plain)
        if killed:
            assert "ended with code -9; " in messages
            return
    pytest.fail("no worker could be killed in time")


def _kill_a_worker(driver: int, run: Path) -> bool:
    """Kill one child of the driver as soon as something is committed; whether there was one to kill."""
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        if list(run.glob("commits/*.json")):
            try:
                children = Path(f"/proc/{driver}/task/{driver}/children").read_text(encoding="utf-8").split()
                os.kill(int(children[0]), signal.SIGKILL)
            except (FileNotFoundError, IndexError, ProcessLookupError):
                return False
            return True
        time.sleep(0.02)
    return False


BRIEF = SceneSpec(max_steps=2)


@pytest.mark.parametrize(
    ("inference", "turn", "cores", "batch", "waits"),
    [
        ({1: 0.1, 2: 0.1, 4: 0.1, 8: 0.2}, 0.01, 16, 4, 0),  # free up to four
        ({1: 0.1, 2: 0.2, 4: 0.4}, 0.01, 16, 1, 0),  # a batch brings nothing
        ({1: 0.1, 2: 0.102}, 0.1, 2, 1, 0),  # one core simulates: no batch helps it
        ({1: 0.01, 2: 0.01, 4: 0.01}, 0.1, 5, 4, 0.9),  # four simulators for one quick model
        ({1: 0.1}, 0.1, 1, 1, 0.5),  # one core does both
    ],
)
def test_the_smallest_batch_near_the_best_rate_is_chosen(
    inference: dict[int, float], turn: float, cores: int, batch: int, waits: float
) -> None:
    choice = choose(inference, turn, cores)
    assert choice.batch == batch
    assert choice.waits == pytest.approx(waits)
    assert choice.env_workers == (2 * batch if cores > 1 else 0)
    assert f"batch {batch}" in choice.words


def test_batches_are_tried_up_to_the_bound_and_no_further_than_memory() -> None:
    tried: list[int] = []
    assert set(inference_times(tried.append, 1)) == {1}
    assert set(tried) == {1}

    def small(batch: int) -> None:
        if batch > 1:
            raise MemoryError

    assert set(inference_times(small, 8)) == {1}
    with pytest.raises(MemoryError):
        inference_times(lambda batch: small(batch + 1), 8)


def test_a_batch_that_exceeds_a_gpu_ends_the_search_and_not_the_run() -> None:
    """A policy's error is one of its code, unless memory ended in it."""
    from torch.cuda import OutOfMemoryError

    def preflight(observations: Sequence[object], _seeds: object) -> None:
        with while_acting("pi0", "/models/mine"):
            if len(observations) > 2:
                raise OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    controller: Any = SimpleNamespace(run_preflight=preflight)
    example = Observation(np.zeros((4, 4, 3), np.uint8), np.zeros(8, np.float32), "push")
    assert set(inference_times(partial(_infer, controller, example), 8)) == {1, 2}


@pytest.mark.parametrize(
    ("of_card", "episodes", "most"),
    [(1, 3440, 1), (None, 3440, 64), (8, 3440, 8), (None, 6, 3), (None, 1, 1)],
)
def test_the_card_bounds_what_is_tried(of_card: int | None, episodes: int, most: int) -> None:
    assert largest_batch(of_card, episodes) == most


@pytest.mark.slow
def test_a_policy_that_takes_one_observation_is_calibrated_to_the_same_bytes(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its card says that batches change its numbers; whatever the times are, it gets single observations."""
    monkeypatch.setattr(calibration, "cores_here", lambda: 1)  # no processes: their start takes longer than this
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, scene=BRIEF, items=2, env_workers=0)
    plain = extract_run(settings, tmp_path / "plain")
    calibrated = settings.changed(env_workers=None, batch="auto")
    run_preflight, tried = PolicyController.run_preflight, set[int]()

    def counted(controller: PolicyController, observations: list, seeds: list) -> None:  # type: ignore[type-arg]
        tried.add(len(observations))
        run_preflight(controller, observations, seeds)

    monkeypatch.setattr(PolicyController, "run_preflight", counted)
    monkeypatch.setattr(calibration, "largest_batch", lambda _of_card, episodes: largest_batch(1, episodes))
    extraction = prepare(calibrated, tmp_path / "run")
    assert tried == {1}
    assert extraction.calibration is not None
    assert (extraction.settings.machine.batch, extraction.settings.machine.env_workers) == (1, 0)
    extraction.run(tmp_path / "run")
    for key in plain.location.keys("commits"):
        assert open_run(tmp_path / "run").location.read(key) == plain.location.read(key)


@pytest.mark.slow
def test_an_option_that_batch_auto_chooses_is_refused_beside_it(small_suite: Suite) -> None:
    command = [
        "extract",
        "--model",
        "pi0-tiny",
        "--suite",
        str(small_suite.folder),
        "--batch",
        "auto",
        "--dry-run",
    ]
    result = CliRunner().invoke(app, [*command, "--env-workers", "2"])
    assert (result.exit_code, "leave out --env-workers" in " ".join(result.output.split())) == (2, True)
    assert CliRunner().invoke(app, [*command[:-2], "many"]).exit_code == 2
    with pytest.raises(UsageError, match="scripted"):
        prepare(ExtractSettings("expert", suite=small_suite.folder, batch="auto"))
