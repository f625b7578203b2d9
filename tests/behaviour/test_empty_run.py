"""A run in which no episode is finished yet: every command says so, and none ends in a traceback."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.runs import open_run
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from tests.support.little_run import little_plan, little_settings


@pytest.fixture(scope="module")
def run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("empty") / "run"
    settings = {**little_settings(), "scene": SceneSpec(max_steps=2).to_json()}
    RunWriter(locate(place), little_plan(small_suite.select(["color"])), settings)
    return place


def test_it_opens_as_a_table_of_no_episodes(run: Path) -> None:
    opened = open_run(run, allow_partial=True)
    assert {"episode", "category", "side_correct"} <= set(opened.episodes.columns)
    assert len(opened.episodes) == 0
    assert "0 of 24" in repr(opened)


@pytest.mark.filterwarnings("ignore:.*is not sealed")
@pytest.mark.parametrize(
    "command",
    [
        "run show",
        "run verify",
        "run verify --seal",
        "train --partial",
        "retention --partial",
        "run export --format safetensors",
    ],
)
def test_no_command_ends_in_a_traceback(run: Path, command: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    answer = CliRunner().invoke(app, [*command.split(), str(run)])
    assert "InternalError" not in answer.output, answer.output
    assert answer.output.strip()
