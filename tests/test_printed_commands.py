"""The commands that probe_kit prints run as they were printed; the commands that its texts name exist.

The commands of the docs are run by `test_documented_commands.py`.
"""

import ast
import html
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import probe_kit
from probe_kit.cli import app
from probe_kit.hooks import Observation
from tests.support.lerobot_recordings import write_recording
from tests.test_documented_commands import leaf_of, options_of

PACKAGE = Path(probe_kit.__file__).parent
A_COMMAND = re.compile(r"(?:`|<code>)(probe-kit [a-z][^`<]*)(?:`|</code>)")


def texts_of(file: Path) -> Iterator[str]:
    """Every text of a file; what a text leaves open is `X`."""
    content = file.read_text(encoding="utf-8")
    if file.suffix != ".py" or "probe-kit " not in content:
        yield content
        return
    for node in ast.walk(ast.parse(content)):
        if isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else "X" for part in node.values)
            yield "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_commands_and_options_that_the_texts_of_the_package_name_exist() -> None:
    files = [file for ending in ("py", "js", "jinja", "html") for file in PACKAGE.rglob(f"*.{ending}")]
    mentioned_commands = {
        (file.relative_to(PACKAGE).as_posix(), " ".join(match[1].split()))
        for file in files
        for text in texts_of(file)
        for match in A_COMMAND.finditer(text)
    }
    assert {name.rpartition(".")[2] for name, _ in mentioned_commands} >= {"py", "js"}
    for file, command in sorted(mentioned_commands):
        words = [word for word in command.replace("'", "").split()[1:] if word != "…"]
        if words in (["suite"], ["run"], ["study"], ["dataset"]):
            continue
        leaf, arguments = leaf_of(words)
        assert {word for word in arguments if word.startswith("--")} <= options_of(leaf), f"{file}: {command}"


# -- as typed ----------------------------------------------------------------------------------------------------

TASK = "Put the cube on the red shape"
STARTS: dict[str, list[str]] = {
    "questions": [
        "extract --model pi0-tiny --categories color --items 12 --max-steps 3 --out 'a run'",
        "retention 'a run' --html 'a report.html'",
    ],
    "remedies": [
        "extract --model pi0-tiny --categories color --items 12 --no-act --out '-captured only'",
        "retention './-captured only' --target item.named",
        "retention './-captured only' --target side.chosen",
        "retention './-captured only' --target nothing",
        "intervene './-captured only'",
        "train './-captured only' --target item.nothing",
    ],
    "script": ["extract --model expert --categories color --items 2 --out 'an expert'"],
    "recordings": [
        "dataset show 'a recording' --model pi0-tiny",
        "extract --model pi0-tiny --dataset 'a recording' --accept-units --out 'of recordings'",
        "intervene 'of recordings'",
        "retention 'of recordings'",
        "retention 'of recordings' --target dataset.nothing",
    ],
    "diagnosis": ["diagnose pi0-tiny --dataset 'a recording' --accept-units --out 'of it' --html 'a page.html'"],
    "asked": ["ask --model vlm-tiny --categories color --items 6 --out 'asked of it'"],
    "suite": ["suite from-csv 'my questions.csv' --out 'my suite' --license CC0-1.0"],
    "environment": ["check-environment tests.support.reach_env:ReachEnv --env-option 'count=12'"],
    "doctor": ["doctor"],
}
NOT_RUN = ("view", "demo", "study run")
"""Commands that do not end, or take minutes: that their options exist is checked."""
PLACEHOLDERS = re.compile(r"\b[A-Z][A-Z_]{1,}\b|…")
"""Words such as FILE and COLUMN that a user replaces."""
SILENT = ("diagnosis",)
"""Starts whose output and page suggest no command; they may come to do so."""
MOST = 12


def printed_commands(text: str) -> list[str]:
    """The commands of ours that a text or a page shows: behind `next:` and `then:`, and between backticks.

    A command's name alone, as in "a run of `probe-kit extract`", says which command is meant and is not typed. A
    page that is passed on names the last folder of a path alone.
    """
    text = text.replace("--model NAME", "--model pi0-tiny")
    steps = re.findall(r"^(?:next|then): (probe-kit .*)$", text, re.MULTILINE)
    quoted = [html.unescape(" ".join(match[1].split())) for match in A_COMMAND.finditer(text)]  # lines are wrapped
    # Two blanks part a command from what it is for; a semicolon parts two commands.
    steps = [part for step in steps for part in re.split(r"  |; ", step) if part.startswith("probe-kit ")]
    quoted = [command for command in quoted if leaf_of(shlex.split(command)[1:])[1]]
    return [command for command in (*steps, *quoted) if not PLACEHOLDERS.search(command)]


def run_as_typed(command: str) -> tuple[int, str]:
    """The exit code of a command, and what it printed and what the page that it wrote shows."""
    words = shlex.split(command)[1:]
    if " ".join(words).startswith(NOT_RUN):
        leaf, arguments = leaf_of(words)
        unknown = {word for word in arguments if word.startswith("--")} - options_of(leaf)
        return (2, f"no such option: {unknown}") if unknown else (0, "")
    result = CliRunner().invoke(app, words)
    pages = [Path(words[position + 1]) for position, word in enumerate(words) if word == "--html"]
    return result.exit_code, "\n".join([result.output, *(page.read_text(encoding="utf-8") for page in pages)])


def write_inputs() -> None:
    """Write a recording of six episodes and a table of questions into the working folder."""
    draw = np.random.default_rng(0)
    pictures = draw.integers(0, 255, (6, 3, 96, 96, 3), np.uint8)
    state = np.array([0.39, 0.02, 0.08, 0, 0.06, -0.02, 0, 0.64], np.float32)
    write_recording(
        Path("a recording"),
        [[Observation(picture, state, TASK) for picture in episode_pictures] for episode_pictures in pictures],
    )
    lines = ["instruction,correct,wrong,group,category"]
    for number in range(6):
        for name in ("correct", "wrong"):
            Image.fromarray(draw.integers(0, 255, (64, 64, 3), np.uint8)).save(f"{name} {number}.png")
        lines.append(f"{TASK},correct {number}.png,wrong {number}.png,{number},colours")
    Path("my questions.csv").write_text("\n".join(lines), encoding="utf-8")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("start", STARTS)
def test_every_command_that_is_printed_runs_as_typed(
    start: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first commands of a start may be refused; what they print may not."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    write_inputs()
    typed = [f"probe-kit {command}" for command in STARTS[start]]
    waiting, ran = [*typed], dict[str, tuple[int, str]]()
    while waiting and len(ran) < MOST:
        command = waiting.pop(0)
        ran[command] = run_as_typed(command)
        waiting += [each for each in printed_commands(ran[command][1]) if each not in (*ran, *waiting)]
    assert (ran.keys() > {*typed}) or start in SILENT, f"nothing is suggested: {[*ran]}"
    # 1 says that something was found; 2 and above refuse what was typed, or fail.
    refused = {
        command: output.partition("<!doctype")[0][-600:]
        for command, (code, output) in ran.items()
        if code > 1 and (command not in typed or command == typed[0])
    }
    assert not refused
