"""`run verify --deep` refuses whatever a reader of the run would refuse."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import ProbeKitError
from probe_kit.runs import open_run, verify_run
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from tests.support.little_run import little_plan, little_settings
from tests.support.reading import readings
from tests.support.rehashing import write_record

Change = Callable[[Path], object]


def move(source: str, target: str) -> Change:
    """Move the first bundle of a home into another."""

    def change(run: Path) -> None:
        bundle = next(path for path in sorted((run / source).iterdir()) if not path.name.startswith("."))
        (run / target).mkdir(exist_ok=True)
        bundle.rename(run / target / bundle.name)

    return change


def edited(home: str, name: str, value: object) -> Change:
    """Change one setting of the first bundle of a home, under a right hash."""

    def change(run: Path) -> None:
        head = next(path for path in sorted((run / home).glob("*/settings.json")))
        content = json.loads(head.read_text(encoding="utf-8"))
        content["settings"][name] = value
        write_record(head, content)

    return change


@pytest.fixture(scope="module")
def sound(little_runs: Path) -> Path:
    assert verify_run(little_runs / "run", deep=True).problems == ()
    return little_runs / "run"


@pytest.mark.parametrize(
    "change",
    [
        move("probes", "interventions"),
        pytest.param(move("interventions", "probes"), marks=pytest.mark.slow),
        edited("probes", "format", 99),
        pytest.param(edited("probes", "seed", 17), marks=pytest.mark.slow),
        pytest.param(edited("probes", "run_settings", "0" * 64), marks=pytest.mark.slow),
        pytest.param(edited("interventions", "format", 99), marks=pytest.mark.slow),
        pytest.param(edited("interventions", "kind", "no-such-kind"), marks=pytest.mark.slow),
        pytest.param(edited("interventions", "seed", 17), marks=pytest.mark.slow),
    ],
    ids=[
        "probes among interventions", "interventions among probes", "format of probes", "key of probes",
        "probes of another run", "format of an intervention", "kind of an intervention", "key of an intervention",
    ],
)  # fmt: skip
def test_a_result_that_no_reader_takes_is_a_problem(sound: Path, tmp_path: Path, change: Change) -> None:
    run = Path(shutil.copytree(sound, tmp_path / "run"))
    change(run)
    with pytest.raises(ProbeKitError):
        readings(run)
    assert verify_run(run, deep=True).problems


@pytest.fixture(scope="module")
def run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_folder = tmp_path_factory.mktemp("empty") / "run"
    settings = {**little_settings(), "scene": SceneSpec(max_steps=2).to_json()}
    RunWriter(locate(run_folder), little_plan(small_suite.select(["color"])), settings)
    return run_folder


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
