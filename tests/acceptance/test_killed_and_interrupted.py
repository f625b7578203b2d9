"""Commands that are killed or interrupted: the same command resumes, and gives what an undisturbed one gives."""

import json
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import probe_kit as pk
from tests.acceptance.conftest import PLAYED
from tests.acceptance.product import Answer, console_script, environment, probe_kit

LONGEST_S = 300
PROCESSES_OWN = ("certificates", "times", "certificate.json", "probes", "interventions")
"""Files of a run that tell of its processes and their seconds, and results that other tests may add."""


def begin(*words: object) -> subprocess.Popen[str]:
    """Start a command in a process of its own that Ctrl-C reaches, even where the tests run in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [str(console_script()), *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            env=environment(OMP_NUM_THREADS="1"),
        )
    finally:
        signal.signal(signal.SIGINT, before)


def end(process: subprocess.Popen[str], signal_: signal.Signals, when: Callable[[], bool]) -> Answer:
    """Send a signal as soon as `when()`, and wait."""
    until = time.monotonic() + LONGEST_S
    while not when() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)
    process.send_signal(signal_)
    out, err = process.communicate(timeout=LONGEST_S)
    return Answer("the interrupted command", process.returncode, out, err)


def content(folder: Path, *without: str) -> dict[str, bytes]:
    """Files of a folder by name, without those below the top-level names `without`."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {str(file): (folder / file).read_bytes() for file in files if file.parts[0] not in without}


def committed(run: Path) -> int:
    return len(list(run.glob("commits/*.json")))


@pytest.mark.slow
def test_a_killed_extract_resumes_to_the_bytes_of_an_undisturbed_one(played: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    typed = ("extract", *PLAYED, "--out", run)
    assert end(begin(*typed), signal.SIGKILL, lambda: committed(run) >= 3).code == -signal.SIGKILL
    stored = content(run / "commits")
    assert 3 <= len(stored) < 24
    assert len(pk.open_run(run, allow_partial=True).episodes) >= 3
    assert not probe_kit("run", "verify", run, "--json", "--deep", code=None).json()["finished"]
    assert "RunIncompleteError" in probe_kit("train", run, code=1).err
    probe_kit(*typed)
    assert stored.items() <= content(run / "commits").items(), "a committed episode was played again"
    assert content(run, *PROCESSES_OWN) == content(played, *PROCESSES_OWN)
    assert probe_kit("run", "verify", run, "--deep", "--json").json()["ok"]


def test_ctrl_c_is_exit_code_130_and_one_line_and_keeps_what_is_done(tmp_path: Path) -> None:
    run = tmp_path / "run"
    settings = ("--model", "expert", "--categories", "color", "--items", "6", "--max-steps", "8")
    typed = ("extract", *settings, "--env-workers", "0", "--out", run)
    answer = end(begin(*typed), signal.SIGINT, lambda: committed(run) >= 1)
    assert answer.code == 130, answer.text
    assert "Traceback" not in answer.text
    assert "resume" in answer.text
    stored = content(run / "commits")
    assert 1 <= len(stored) < 12
    probe_kit(*typed)
    assert stored.items() <= content(run / "commits").items()
    assert len(pk.open_run(run).episodes) == 12


def results(run: Path, kind: str) -> dict[str, bytes]:
    """Stored results of a kind, without the records of times."""
    return {name: held for name, held in content(run / kind).items() if not name.endswith("times.json")}


COMMANDS = {
    "probes": ("train", "--permutations", "19", "--controls", "none"),
    "interventions": ("intervene", "--kind", "interchange", "--sites", "backbone.*"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", COMMANDS)
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_a_killed_analysis_gives_the_bytes_of_an_undisturbed_one(
    kind: str, share: float, played: Path, tmp_path: Path
) -> None:
    copies = [Path(shutil.copytree(played, tmp_path / name)) for name in ("whole", "killed")]
    for copy in copies:
        shutil.rmtree(copy / kind, ignore_errors=True)
    command, *options = COMMANDS[kind]
    began = time.monotonic()
    assert end(begin(command, copies[0], *options), signal.SIGTERM, lambda: False).code == 0
    usual, began = time.monotonic() - began, time.monotonic()
    end(begin(command, copies[1], *options), signal.SIGKILL, lambda: time.monotonic() > began + share * usual)
    assert probe_kit("run", "verify", copies[1], "--deep", "--json").json()["ok"]
    probe_kit(command, copies[1], *options)
    assert results(copies[0], kind)
    assert results(copies[1], kind) == results(copies[0], kind)
    tables = [probe_kit("retention", copy, "--format", "json", code=None) for copy in copies]
    assert tables[0].code == tables[1].code
    if tables[0].code == 0:
        both = [json.loads(table.out.replace(str(copy), "")) for table, copy in zip(tables, copies, strict=True)]
        assert both[0] == both[1]


@pytest.mark.slow
def test_ctrl_c_of_an_intervention_is_exit_code_130_and_the_command_resumes(played: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(played, tmp_path / "run"))
    shutil.rmtree(copy / "interventions", ignore_errors=True)
    typed = ("intervene", copy, *COMMANDS["interventions"][1:])
    process = begin(*typed)
    answer = end(process, signal.SIGINT, lambda: any((copy / "interventions").glob("**/*")))
    assert answer.code == 130, answer.text
    assert "Traceback" not in answer.text
    probe_kit(*typed)
    assert results(copy, "interventions")
