"""The doctor: what it says is true of this machine, and what is broken it names with a way out."""

import json
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from probe_kit import doctor
from probe_kit._system.imports import install_command
from probe_kit.cli import app
from probe_kit.doctor import CheckResult, State

Usage = namedtuple("Usage", "total used free")


@pytest.mark.slow
def test_the_command_agrees_with_what_it_found() -> None:
    answer = subprocess.run(
        [sys.executable, "-m", "probe_kit", "doctor", "--json"], capture_output=True, encoding="utf-8", check=False
    )
    findings = {row["subject"]: row for row in json.loads(answer.stdout)}
    subjects = "python processor memory disk simulator renderer policy gpu hub tokenizer"
    assert set(subjects.split()) <= set(findings), answer.stdout + answer.stderr
    assert {"extra ray", "extra remote", "extra export"} <= set(findings)
    assert all(row["state"] == "ok" or row["advice"] for row in findings.values())
    assert answer.returncode == 0, "the tests run here, so the demo does"


@pytest.mark.parametrize(("state", "code"), [("ok", 0), ("note", 0), ("missing", 1)])
def test_only_what_stops_the_demo_makes_the_command_fail(
    state: State, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    findings = [CheckResult("python", "ok", "3.12"), CheckResult("disk", state, "1 GB [here]", "Clear it")]
    monkeypatch.setattr(doctor, "examine", lambda: findings)
    answer = CliRunner().invoke(app, ["doctor"])
    assert answer.exit_code == code
    assert "1 GB [here]" in answer.stdout
    assert "Clear it" in answer.stdout
    printed = CliRunner().invoke(app, ["doctor", "--json"])
    assert json.loads(printed.stdout)[1] == findings[1].to_json()


def test_the_scene_that_is_tried_is_one_an_episode_shows() -> None:
    drawn = doctor.draw_scene()
    assert drawn["size"] == "640 × 480"
    assert drawn["numpy"]


@pytest.mark.slow
def test_the_policy_that_is_tried_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.hooks.families.pi0.adapter import Pi0

    act, shapes = Pi0.act, []

    def spy(policy: Pi0, observations: list[Any], seeds: list[int]) -> Any:
        chunk = act(policy, observations, seeds)
        shapes.append(chunk.shape)
        return chunk

    monkeypatch.setattr(Pi0, "act", spy)
    facts = doctor.let_policy_act()
    assert shapes == [(1, 16, 7)]
    assert facts["torch"] == __import__("torch").__version__


def test_a_trial_that_crashes_is_a_finding_with_its_last_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    (finding,) = doctor._scene()
    assert finding.state == "missing"
    assert "code 1" in finding.result
    assert "C++ compiler" in finding.advice


@pytest.mark.parametrize("trial", [doctor._scene, doctor._policy])
def test_a_trial_without_an_answer_in_time_says_that_the_machine_is_busy_and_not_to_install_again(
    trial: Callable[[], list[CheckResult]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "PATIENCE", 0.01)
    (finding,) = trial()
    assert finding.state == "note"
    assert finding.result.startswith("not known: no answer within 0.01 s")
    assert "busy" in finding.advice
    assert "nstall" not in finding.advice


@pytest.mark.parametrize(("free", "state"), [(1e6, "missing"), (1e9, "note"), (1e12, "ok")])
def test_a_full_disk_stops_the_demo_and_a_small_one_is_noted(
    free: float, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage(free, 0, free))
    assert doctor._disk().state == state


@pytest.mark.parametrize(
    ("release", "state"), [((3, 11, 9), "missing"), ((3, 12, 0), "ok"), ((3, 14, 0), "missing")]
)
def test_another_python_is_named(release: tuple[int, ...], state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", release)
    assert doctor._python().state == state


def test_a_hub_that_does_not_answer_is_a_note_and_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    finding = doctor._hub()
    assert finding.state == "note"
    assert "127.0.0.1:9 does not answer" in finding.result


def test_offline_mode_is_respected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert "offline" in doctor._hub().result


def test_a_machine_without_a_gpu_is_noted_and_one_with_is_described() -> None:
    assert doctor._gpu([]).state == "note"
    assert doctor._gpu([{"name": "H200", "gigabytes": 141.2}]).result == "H200 with 141 GB"


def test_an_extra_lacks_what_is_not_installed() -> None:
    assert doctor._extra("demo", ["numpy"]).state == "ok"
    lacking = doctor._extra("demo", ["numpy", "no-such-distribution"])
    assert lacking == CheckResult(
        "extra demo", "note", "without no-such-distribution", f"`{install_command('demo')}`"
    )


def test_available_memory_is_that_of_the_system() -> None:
    available = doctor._available_memory()
    assert available is not None
    total = next(
        line
        for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        if line.startswith("MemTotal")
    )
    assert 0 < available <= 1024 * int(total.split()[1])
