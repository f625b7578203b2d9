"""A diagnosis of a network that is shown two cameras: each is an input of its own."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.diagnose.diagnosis import check_base, check_base_files, diagnose_run
from probe_kit.diagnose.inputs import names_of
from probe_kit.errors import UsageError
from probe_kit.extract import EnvironmentSettings, ExtractSettings, extract_run
from probe_kit.hooks.contract.card import shown_cameras
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import Run
from probe_kit.runs.run_source import Origin
from probe_kit.suite import Suite
from tests.hooks.families.smolvla.checkpoints import write_smolvla
from tests.support.acting_checkpoints import FAMILIES
from tests.support.organisms import ORGANISMS, edited

ENVIRONMENT = "tests.support.reach_env:TwoCameras"
PICTURES = ("picture.top", "picture.wrist")


@pytest.fixture(scope="module")
def checkpoint(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> str | None:
    return FAMILIES["smolvla"].prepare_checkpoint(small_suite, tmp_path_factory.mktemp("two") / "smolvla")


@pytest.fixture(scope="module")
def run(checkpoint: str, tmp_path_factory: pytest.TempPathFactory) -> Run:
    source = EnvironmentSettings(ENVIRONMENT, max_steps=1)
    settings = ExtractSettings("smolvla", checkpoint, source=source, execute=1, env_workers=0, accept_units=True)
    return extract_run(settings, tmp_path_factory.mktemp("played") / "run")


def test_a_camera_that_gets_no_picture_is_no_input() -> None:
    assert shown_cameras(("top", "wrist"), ["camera.wrist", "state"]) == ("top", "wrist")
    assert names_of(shown_cameras(("top", "wrist"), [])) == ("instruction", "picture", "state")


@pytest.mark.slow
def test_a_mistyped_camera_of_a_new_run_is_refused_before_the_model_is_loaded(
    checkpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("no model is loaded")

    monkeypatch.setattr("probe_kit.hooks.load_policy", never)
    new = ["diagnose", "smolvla", "--checkpoint", checkpoint, "--env", ENVIRONMENT, "--env-workers", "0"]
    answer = CliRunner().invoke(app, [*new, "--out", str(tmp_path / "run"), "--require", "picture.side"])
    assert answer.exit_code == 2, answer.output
    assert "there are instruction, picture.top, picture.wrist, state" in " ".join(answer.output.split())


@pytest.mark.slow
def test_both_cameras_of_a_network_arrive(run: Run) -> None:
    diagnosis = diagnose_run(run, frames=6, inside=False)
    assert [diagnosed.name for diagnosed in diagnosis.inputs] == ["instruction", *PICTURES, "state"]
    cameras = [diagnosed for diagnosed in diagnosis.inputs if diagnosed.name in PICTURES]
    assert all(diagnosed.arrives and diagnosed.n_pairs for diagnosed in cameras)


@pytest.mark.slow
def test_a_second_camera_that_is_masked_does_not_arrive_and_ends_behind_the_backbone(run: Run) -> None:
    organism = ORGANISMS["second camera"]
    diagnosis = diagnose_run(run, frames=6, inputs=PICTURES, load=edited(organism.edit), seed=1)
    top, wrist = diagnosis.inputs
    assert top.arrives
    assert wrist.verdict == "does not arrive"
    assert organism.where["picture.wrist"] in wrist.where
    assert {site.stream for site in wrist.passage if site.differs} <= {"vision", "backbone", "kv"}
    assert (diagnosis.exit_code(["picture.wrist"]), run.certificate["policy"]["cameras"]) == (1, ["top", "wrist"])


@pytest.mark.slow
def test_a_base_of_other_cameras_is_refused_by_its_configuration_alone(tmp_path: Path) -> None:
    tuned = str(write_smolvla(tmp_path / "tuned", ("top", "wrist")))
    same, other = (str(write_smolvla(tmp_path / name, (name, "wrist"))) for name in ("top", "front"))
    for folder in (tuned, same, other):
        for weights in Path(folder).glob("*.safetensors"):
            weights.write_bytes(b"no weights are read")
    check_base_files("smolvla", tuned, same, {}, ("top", "wrist"))
    with pytest.raises(UsageError, match=r"other inputs: its cameras are .*front.*, those of .*tuned .*top"):
        check_base_files("smolvla", tuned, other, {}, ("top", "wrist"))
    # A run names its own checkpoint, and no --checkpoint is given: the run's is the one that is compared.
    run = cast(
        "Run",
        SimpleNamespace(
            model="smolvla",
            origins=(Origin(checkpoint=tuned),),
            certificate={"policy": {"cameras": ["top", "wrist"], "needs": ["camera.wrist"]}},
        ),
    )
    check_base(run, ReplayFiles(), same, ("top", "wrist"))
    with pytest.raises(UsageError, match=r"other inputs: its cameras are .*front.*, those of .*tuned .*top"):
        check_base(run, ReplayFiles(), other, ("top", "wrist"))
    with pytest.raises(UsageError, match=f"those of {re.escape(same)} "):
        check_base(
            run, ReplayFiles(checkpoint=same), other, ("top", "wrist")
        )  # where a checkpoint is given, it is that one
