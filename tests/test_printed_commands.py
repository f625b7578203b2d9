"""The commands that probe_kit prints, next steps and remedies, are run as they were printed, until none is new."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.hooks import Observation
from tests.support.lerobot_recordings import write_recording

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

STARTS = {
    "questions": "extract --model pi0-tiny --categories color --items 12 --max-steps 3 --out 'my runs/of color'",
    "captured": "extract --model pi0-tiny --categories color --items 6 --no-act --out 'captured only'",
    "script": "extract --model expert --categories color --items 2 --out 'an expert'",
    "recordings": "extract --model pi0-tiny --dataset 'a recording' --accept-units --out 'of recordings'",
    "asked": "ask --model vlm-tiny --categories color --items 6 --out 'asked of it'",
    "suite": "suite build 'my suite' --categories color --items 2",
    "doctor": "doctor",
}
SERVERS = ("view", "demo")
"""Commands that do not end, or take minutes: that their options exist is checked."""
PLACEHOLDERS = re.compile(r"\b[A-Z][A-Z_]{2,}\b|…")
"""Words such as FILE and COLUMN that a user replaces."""
MOST = 12


def printed_commands(text: str) -> list[str]:
    """The commands of ours that a text shows: behind `next:` and `then:`, and between backticks."""
    steps = re.findall(r"^(?:next|then): (probe-kit .*)$", text, re.MULTILINE)
    quoted = re.findall(r"`(probe-kit [^`]+)`", text)
    # Two blanks part a command from what it is for; a semicolon parts two commands.
    steps = [part for step in steps for part in re.split(r"  |; ", step) if part.startswith("probe-kit ")]
    return [command for command in (*steps, *quoted) if not PLACEHOLDERS.search(command)]


def run_as_typed(command: str) -> tuple[int, str]:
    words = shlex.split(command)[1:]
    if words[0] in SERVERS:
        words = [words[0], "--help"]
    result = CliRunner().invoke(app, words)
    return result.exit_code, result.output


@pytest.mark.parametrize("start", STARTS)
def test_every_command_that_is_printed_runs_as_typed(
    start: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    if start == "recordings":
        draw = np.random.default_rng(0)
        pictures = draw.integers(0, 255, (6, 3, 96, 96, 3), np.uint8)
        state = np.array([0.39, 0.02, 0.08, 0, 0.06, -0.02, 0, 0.64], np.float32)
        words = "Put the cube on the red shape"
        episodes = [[Observation(picture, state, words) for picture in episode] for episode in pictures]
        write_recording(Path("a recording"), episodes)
    waiting, ran = [f"probe-kit {STARTS[start]}"], dict[str, tuple[int, str]]()
    while waiting and len(ran) < MOST:
        command = waiting.pop(0)
        ran[command] = run_as_typed(command)
        waiting += [each for each in printed_commands(ran[command][1]) if each not in (*ran, *waiting)]
    assert len(ran) > 1, f"nothing is suggested: {ran}"
    # 1 says that something was found; 2 and above refuse what was typed, or fail.
    refused = {command: output[-600:] for command, (code, output) in ran.items() if code > 1}
    assert not refused
