"""An error of a whole run keeps its class, exit code and words with every kind of worker."""

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit._execution.ray_pool import RayWorker
from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import CaptureChangedActionError, ProbeKitError, SceneError, SuiteError, UsageError
from probe_kit.extract import Extraction, ExtractSettings, extract_run, prepare
from probe_kit.extract.extraction import play_episodes
from probe_kit.extract.sources.player import LocalPlayer, ProcessPlayer
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.hooks import Observation
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs import open_run
from probe_kit.runs.folder import Folder
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.provenance import provenance_here, write_certificate
from probe_kit.runs.store import locate
from probe_kit.suite import Suite

SHORT = SceneSpec(max_steps=2)


@pytest.mark.parametrize("stage_kind", [pytest.param(LocalPlayer, marks=pytest.mark.slow), ProcessPlayer])
def test_a_stage_raises_the_same_error_wherever_it_stands(
    stage_kind: type[LocalPlayer | ProcessPlayer], suite: Suite, tmp_path: Path
) -> None:
    """A picture that changed on disk is no dead process."""
    copy = Path(shutil.copytree(suite.folder, tmp_path / "suite"))
    planned = prepare(ExtractSettings("expert", suite=copy)).plan.episodes[0]
    for picture in copy.rglob("*.png"):
        picture.write_bytes(b"not a picture")
    stage = stage_kind(partial(ScenePlayer, SHORT))
    try:
        stage.ask("begin", planned, False)
        with pytest.raises(SuiteError) as caught:
            stage.answer()
    finally:
        stage.close()
    assert any(planned.episode_id in note for note in caught.value.__notes__)


def test_an_arm_without_its_extra_is_said_before_anything_is_played(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("probe_kit.env.arm.find_spec", lambda _name: None)
    settings = ExtractSettings("expert", suite=suite.folder, scene=SceneSpec(arm="widowx"), env_workers=0)
    with pytest.raises(SceneError, match=r"Install `rtb-data") as caught:
        extract_run(settings, tmp_path / "run")
    assert caught.value.exit_code == 2
    assert not (tmp_path / "run").exists()


def spoiled_after_planning(suite: Suite, tmp_path: Path, **how: object) -> Extraction:
    """An extraction that is planned and begun, of a suite whose pictures then change: workers will find out."""
    copy = Path(shutil.copytree(suite.folder, tmp_path / "suite"))
    extraction = prepare(ExtractSettings("expert", suite=copy, scene=SHORT, env_workers=0, **how))
    extraction.writer(locate(tmp_path / "run"))
    for picture in copy.rglob("*.png"):
        picture.write_bytes(b"not a picture")
    return extraction


@pytest.mark.slow
def test_a_worker_process_hands_its_error_on(suite: Suite, tmp_path: Path) -> None:
    extraction = spoiled_after_planning(suite, tmp_path, workers=1)
    with pytest.raises(SuiteError, match="changed"):
        extraction.run(tmp_path / "run")


def test_a_worker_on_a_cluster_answers_with_its_error_instead_of_dying(suite: Suite, tmp_path: Path) -> None:
    """Raised, it would come back as one of Ray's, or as that of a dead actor, and cost episodes."""
    extraction = spoiled_after_planning(suite, tmp_path)
    actor = RayWorker((play_episodes, (extraction.settings, str(tmp_path / "run"), None)))
    actor.work()
    answer = actor._reports.get()
    assert isinstance(answer, SuiteError)
    assert "changed" in str(answer)


WITHOUT_MESHES = """
import importlib.util as util
found = util.find_spec
util.find_spec = lambda name, *rest: None if name == "rtbdata" else found(name, *rest)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "workers",
    [("--workers", "1"), *(pytest.param(other, marks=pytest.mark.slow) for other in [(), ("--env-workers", "2")])],
)
def test_the_exit_code_of_a_missing_extra_is_that_of_a_wrong_usage(
    workers: tuple[str, ...], suite: Suite, tmp_path: Path
) -> None:
    blocked = tmp_path / "blocked"
    blocked.mkdir()
    (blocked / "sitecustomize.py").write_text(WITHOUT_MESHES, encoding="utf-8")
    command = [sys.executable, "-m", "probe_kit", "extract", "--model", "expert", "--suite", str(suite.folder)]
    ran = subprocess.run(
        [*command, "--arm", "widowx", "--out", str(tmp_path / "run"), *workers],
        capture_output=True, encoding="utf-8", check=False, env={**os.environ, "PYTHONPATH": str(blocked)},
    )  # fmt: skip
    assert (ran.returncode, "SceneError" in ran.stderr) == (2, True), ran.stderr


@pytest.mark.slow
def test_a_scene_in_which_no_episode_can_start_is_refused_at_once(suite: Suite, tmp_path: Path) -> None:
    spec = SceneSpec(home=(0.49, 0.29, 0.39))
    with pytest.raises(SceneError):
        extract_run(ExtractSettings("expert", suite=suite.folder, scene=spec), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_adapter_that_acts_otherwise_under_capture_stops_the_run(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It keeps state between calls: every inference adds a little more to its actions."""
    sound, calls = Pi0.act, count(1)

    def drifting(policy: Pi0, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        return sound(policy, observations, seeds) + np.float32(1e-6 * next(calls))

    monkeypatch.setattr(Pi0, "act", drifting)
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, scene=SHORT, env_workers=0)
    with pytest.raises(CaptureChangedActionError, match="must be equal"):
        extract_run(settings, tmp_path / "run")
    assert open_run(tmp_path / "run", allow_partial=True).episodes.empty
    assert not (tmp_path / "run" / "certificate.json").exists()


@pytest.mark.slow
def test_the_certificate_holds_what_was_measured_in_every_process(suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, scene=SHORT, env_workers=0)
    run = extract_run(settings, tmp_path / "run")
    (process,) = run.certificate["processes"]
    check = process["capture_check"]
    assert check["actions_with_hooks_sha256"] == check["actions_without_hooks_sha256"]
    assert len(check["actions_with_hooks_sha256"]) == 64
    assert run.certificate["hooks_on_equals_hooks_off"] is True
    differing = {"actions_with_hooks_sha256": "a", "actions_without_hooks_sha256": "b"}
    write_certificate(run.root, {"capture_check": differing}, provenance_here())
    assert open_run(run.path).certificate["hooks_on_equals_hooks_off"] is False


@pytest.mark.parametrize(
    "change",
    [
        {"random_weights": True},
        {"execute": 2},
        {"checkpoint": "somewhere"},
        {"tokens": "all"},
        {"captured_calls": 2},
        {"dtype": "bfloat16"},
        {"options": {"bits": 8}},
    ],
)
def test_an_option_without_effect_on_a_scripted_policy_is_refused(suite: Suite, change: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="is scripted"):
        prepare(ExtractSettings("expert", suite=suite.folder, **change))


@pytest.mark.slow
def test_more_actions_than_a_chunk_has_are_refused(suite: Suite) -> None:
    with pytest.raises(UsageError, match="gives 16 actions per inference"):
        prepare(ExtractSettings("pi0-tiny", suite=suite.folder, execute=17))


def test_errors_survive_the_way_through_a_pipe() -> None:
    import pickle

    error = SuiteError("seen, expected, do")
    error.add_note("in episode 3")
    back: ProbeKitError = pickle.loads(pickle.dumps(error))
    assert (type(back), str(back), back.exit_code, back.__notes__) == (SuiteError, str(error), 1, error.__notes__)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("items", "command"), [(4, "retention"), pytest.param(10, "train", marks=pytest.mark.slow)]
)
def test_probes_are_only_the_next_step_of_as_many_groups_as_they_have_folds(
    items: int, command: str, small_suite: Suite, tmp_path: Path
) -> None:
    few = ("--categories", "color", "--items", str(items), "--suite", str(small_suite.folder))
    fast = ("--no-act", "--env-workers", "0", "--out", str(tmp_path / "run"))
    result = CliRunner().invoke(app, ["extract", "--model", "pi0-tiny", *few, *fast])
    assert result.exit_code == 0, result.output
    assert f"next: probe-kit {command} {tmp_path / 'run'}" in " ".join(result.stderr.split())


EPISODES = [0, 1]


@pytest.fixture
def settings(small_suite: Suite) -> ExtractSettings:
    scene = SceneSpec(max_steps=1)
    return ExtractSettings(
        "expert", suite=small_suite.folder, categories=("color",), items=2, scene=scene, env_workers=0
    )


@pytest.fixture
def unheld(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys that were written without a lock on their run; the beginning of a run does not count."""
    keys: list[str] = []
    for name in ("create", "write"):
        _watch(monkeypatch, name, keys)
    return keys


def _watch(monkeypatch: pytest.MonkeyPatch, name: str, keys: list[str]) -> None:
    original = getattr(Folder, name)

    def watched(self: Folder, key: str, content: bytes, **options: bool) -> Any:
        if not (file_of_run := self.path / RUN_FILE).is_file():
            assert self.path.name == "run", "the folder of the run itself, which begins with its other files"
            return original(self, key, content, **options)
        with file_of_run.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                pass
            else:
                keys.append(key)
        return original(self, key, content, **options)

    monkeypatch.setattr(Folder, name, watched)


def begun(settings: ExtractSettings, run: Path) -> str:
    """A run whose owner was killed."""
    return prepare(settings).writer(Folder(run)).location.address


@pytest.mark.slow
def test_an_extraction_in_one_process_holds_its_run(
    settings: ExtractSettings, tmp_path: Path, unheld: list[str]
) -> None:
    extract_run(settings, tmp_path / "run")
    assert unheld == []


@pytest.mark.slow
def test_a_worker_holds_the_run_itself(settings: ExtractSettings, tmp_path: Path, unheld: list[str]) -> None:
    address = begun(settings, tmp_path / "run")
    remaining, played = list(EPISODES), list[int]()

    def take() -> int | None:
        if len(played) == len(EPISODES):
            raise EOFError  # the executor hung up
        return remaining.pop(0) if remaining else None

    with pytest.raises(EOFError):
        play_episodes((settings, address, None), take, lambda event: played.append(event.number))
    assert played == EPISODES
    assert (tmp_path / "run" / "certificate.json").is_file()
    assert unheld == []


def test_a_worker_that_joins_forgets_no_failure(settings: ExtractSettings, tmp_path: Path) -> None:
    writer = prepare(settings).writer(Folder(tmp_path / "run"))
    with writer.claim():
        writer.give_up(3, "it fell over")
        with writer.take_part():
            pass
    with writer.take_part():
        assert list(writer.location.read_all("failed", ".json"))
    with writer.claim():
        assert not list(writer.location.read_all("failed", ".json"))
