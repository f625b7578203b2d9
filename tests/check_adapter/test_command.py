"""`probe-kit check-adapter` on a third party's family: a line per check, exit codes, advice; without pytest."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.distributions import install, install_encoder_vla
from tests.support.encoder_vla.policy import write_checkpoint

WITHOUT_PYTEST = "import sys\nsys.modules['pytest'] = None\n"
HEAVY = """
import torch
from probe_kit.hooks import Family, Requirements

NEEDED = Requirements(needs_checkpoint=True)
FAMILY = Family("heavy-vla", "imports torch", None, "heavy_vla:load", requirements=NEEDED)


def load(checkpoint, device="cpu", dtype=None, random_weights=False):
    return torch.load(checkpoint + "/weights.pt")
"""


def ran(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in a process in which pytest cannot be imported."""
    (folder / "sitecustomize.py").write_text(WITHOUT_PYTEST, encoding="utf-8")
    paths = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, "-m", "probe_kit", "check-adapter", *arguments],
        capture_output=True, encoding="utf-8", check=False, timeout=300, cwd=folder,
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip


@pytest.mark.slow
def test_a_sound_adapter_passes_every_check_and_plays_two_episodes(tmp_path: Path) -> None:
    install_encoder_vla(tmp_path / "theirs")
    write_checkpoint(tmp_path / "checkpoint")
    completed = ran(tmp_path / "theirs", "encoder-vla", "--checkpoint", str(tmp_path / "checkpoint"))
    lines = completed.stdout.splitlines()
    assert completed.returncode == 0, completed.stdout + completed.stderr
    assert {line.split()[0] for line in lines[:-1]} == {"passed", "skipped"}
    assert lines[0] == "passed   Naming the family imports no torch, so that commands without a model stay fast."
    assert lines[-2] == "passed   Two episodes are extracted, and every stored site is loaded again."
    assert "0 failed" in lines[-1]
    assert "next: probe-kit extract --model encoder-vla" in completed.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("model", "play"), [("pi0-tiny", "extract"), ("vlm-tiny", "ask")])
def test_the_embedded_models_pass(model: str, play: str, tmp_path: Path) -> None:
    """Also those that answer; what needs a checkpoint to copy is skipped with the reason."""
    completed = ran(tmp_path, model)
    assert completed.returncode == 0, completed.stdout + completed.stderr
    assert "skipped  Every option reaches the card. (the family brings its own weights" in completed.stdout
    assert f"next: probe-kit {play} --model {model} --items 24" in completed.stderr


@pytest.mark.slow
def test_a_broken_adapter_is_told_what_to_change(tmp_path: Path) -> None:
    folder = install_encoder_vla(tmp_path / "theirs")
    write_checkpoint(tmp_path / "checkpoint")
    source = folder / "encoder_vla" / "policy.py"
    text = source.read_text(encoding="utf-8")
    assert "Tap(block.norm1, fires)" in text
    source.write_text(text.replace("Tap(block.norm1, fires)", "Tap(block.norm1, fires + 1)"), encoding="utf-8")
    completed = ran(folder, "encoder-vla", "--checkpoint", str(tmp_path / "checkpoint"), "--json")
    assert completed.returncode == 1, completed.stderr
    answer = json.loads(completed.stdout)
    failed = {check["name"]: check for check in answer["checks"] if check["state"] == "failed"}
    assert not answer["passed"]
    first = failed["every_site_of_every_quantity_fires_as_often_as_promised"]
    assert first["actual"].startswith("SiteNeverFiredError")
    assert "correct `fires`" in first["change"]
    assert "two_episodes_are_extracted" in failed


@pytest.mark.slow
def test_a_loader_that_fails_and_a_module_that_imports_torch_are_named(tmp_path: Path) -> None:
    """Without a model nothing else can be checked, and the line of the adapter is named."""
    folder = install(tmp_path / "theirs", "heavy-vla", "heavy_vla:FAMILY")
    (folder / "heavy_vla.py").write_text(HEAVY, encoding="utf-8")
    (tmp_path / "checkpoint").mkdir()
    completed = ran(folder, "heavy-vla", "--checkpoint", str(tmp_path / "checkpoint"))
    lines = completed.stdout.splitlines()
    assert completed.returncode == 1, completed.stderr
    assert lines[0].startswith("failed   Naming the family imports no torch")
    assert "`import heavy_vla` imports torch" in lines[1]
    assert lines[4].startswith("failed   The model loads")
    assert "FileNotFoundError" in lines[5]
    assert "heavy_vla.py:" in lines[5]
    assert lines[-1] == "0 passed, 2 failed, 0 skipped"
    assert "next: Keep `FAMILY` in a module" in completed.stderr
