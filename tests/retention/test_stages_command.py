"""`retention VLM_RUN RUN --stages` counts items that a VLM answers and a policy acts on, and refuses other use."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.extract.prompts import TEMPLATES
from probe_kit.retention.behaviour import scored
from probe_kit.retention.compare.known_used import match_runs
from probe_kit.runs import Run
from probe_kit.suite import Suite

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it


@pytest.fixture(scope="module")
def runs(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """An untrained VLM that was asked, and a scripted expert that acted, on the same frames."""
    folder = tmp_path_factory.mktemp("stages")
    scene = SceneSpec(max_steps=4)
    subset = {"suite": small_suite.folder, "categories": ("color",), "items": 4, "scene": scene}
    asked = ask_run(
        AskSettings("vlm-tiny", random_weights=True, prompt=TEMPLATES["p1"], **subset), folder / "asked"
    )
    acted = extract_run(ExtractSettings("expert", **subset), folder / "acted")
    return asked, acted


def test_it_prints_the_counts_of_match_runs_and_draws_their_figure(runs: tuple[Run, Run], tmp_path: Path) -> None:
    asked, acted = runs
    command = ["retention", str(asked.path), str(acted.path), "--compare", "stages"]
    answer = CliRunner().invoke(app, [*command, "--format", "json"])
    assert answer.exit_code == 0, answer.output
    assert json.loads(answer.stdout) == json.loads(
        json.dumps(match_runs(scored(asked, "text", False), acted).to_json())
    )
    drawn = CliRunner().invoke(app, [*command, "--figures", str(tmp_path / "figures")])
    assert "Answer, probe, success" in drawn.stdout
    assert list((tmp_path / "figures").glob("*.png"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--format", "csv"], "--format csv is not for --compare stages"),
        (["--rule", "box"], "--rule is not for --compare stages"),
        (["--as-paper"], "--as-paper is not for --compare stages"),
        (["--views", "mean,last"], "--compare stages reads probes of one view; --views mean,last has 2. Give one"),
        (["--views", "mean"], "has no probes. Run `probe-kit train"),
    ],
)
def test_options_of_other_tables_are_refused(options: list[str], words: str, runs: tuple[Run, Run]) -> None:
    answer = CliRunner().invoke(
        app, ["retention", *(str(run.path) for run in runs), "--compare", "stages", *options]
    )
    assert answer.exit_code == 2
    assert words in " ".join(answer.stderr.split())


def test_it_needs_two_runs(runs: tuple[Run, Run]) -> None:
    answer = CliRunner().invoke(app, ["retention", str(runs[0].path), "--compare", "stages"])
    assert answer.exit_code == 2
    assert "expected VLM_RUN RUN" in answer.stderr
