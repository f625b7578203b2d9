"""The diffs and calls of CONTRIBUTING do what they say: each is applied to a copy of the package and used."""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from probe_kit.train import ArrayRun
from tests.test_names import fillers, first_words, parameters_in_prose

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
USE = """
from pathlib import Path
import pandas as pd
from probe_kit.retention import retention_table
from probe_kit.train import ArrayRun

episodes = pd.read_json({episodes!r})
table = retention_table([ArrayRun(Path("run"), "pi0", "suite@1#0123456789ab", episodes, {{}})])
"""


def block(heading: str, language: str) -> str:
    """The first block of a section in a language."""
    match = re.search(rf"```{language}\n(.*?)```", PAGE.partition(f"## {heading}")[2], re.DOTALL)
    assert match, heading
    return match[1]


def apply(diff: str, package: Path) -> None:
    """Apply hunks that name no lines: each begins at the only place where its own lines stand."""
    for part in re.split(r"^--- .*\n", diff, flags=re.MULTILINE)[1:]:
        name, _, hunks = part.partition("\n")
        file = package / name.removeprefix("+++ b/")
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        for hunk in filter(str.strip, re.split(r"^@@.*\n", hunks, flags=re.MULTILINE)):
            lines = hunk.splitlines()
            old = "".join(f"{line[1:]}\n" for line in lines if line[0] in " -")
            new = "".join(f"{line[1:]}\n" for line in lines if line[0] in " +")
            assert text.count(old) == 1 or not old, (
                f"{file.name} has no such lines; change CONTRIBUTING's diff:\n{old}"
            )
            text = text.replace(old, new) if old else new
        file.write_text(text, encoding="utf-8")


@pytest.fixture
def use(tmp_path: Path, outcome_table: Callable[..., pd.DataFrame]) -> Callable[[str, str], str]:
    """Runs Python with a table of a run, in a copy of the package to which a section's diff was applied."""
    weights = shutil.ignore_patterns("*.safetensors")
    shutil.copytree(ROOT / "probe_kit", tmp_path / "probe_kit", ignore=weights)
    data = tmp_path / "episodes.json"
    outcome_table(6, 4, 2).assign(distance_correct=0.125).to_json(data)

    def run(heading: str, code: str) -> str:
        apply(block(heading, "diff"), tmp_path)
        script = USE.format(episodes=str(data)) + code
        completed = subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, encoding="utf-8", check=False
        )
        assert completed.returncode == 0, completed.stderr
        return completed.stdout

    return run


@pytest.mark.slow
def test_a_column_is_two_files_and_stands_in_every_format(use: Callable[[str, str], str]) -> None:
    diff = block("To add a column to the tables", "diff")
    assert diff.count("\n+++ ") == 2
    code = "print(table.to_markdown(), table.to_latex('all'), table.to_json(), table.to_frame().columns.tolist())"
    printed = use("To add a column to the tables", code)
    assert printed.count("distance m") == 2
    assert "| 0.12 |" in printed
    assert '"median_distance": 0.125' in printed
    assert "success.median_distance" in printed


@pytest.mark.slow
def test_a_format_is_one_file(use: Callable[[str, str], str]) -> None:
    assert block("To add a format of tables", "diff").count("+++ ") == 1
    code = """
from probe_kit._tables import formats
print(formats.names(), table.to_text("dokuwiki", "all"))
from probe_kit._tables.printing import Format
"""
    printed = use("To add a format of tables", code)
    assert "('dokuwiki', 'latex', 'markdown')" in printed
    assert "^ %%category%% ^ %%success %%% ^" in printed
    assert "| %%Color%% |" in printed


@pytest.mark.slow
def test_a_rule_is_a_class_and_its_name_from_the_option_to_the_verdict(use: Callable[[str, str], str]) -> None:
    code = """
import numpy as np
from typer.testing import CliRunner
from probe_kit.cli import app
from probe_kit.env.scoring import RULES, rule_of
from probe_kit.env.scoring import CHANNELS, Trajectory
from probe_kit.env.spec import SceneSpec

frames = np.zeros((2, len(CHANNELS)), np.float32)
frames[:, [CHANNELS.index("tile_left.y"), CHANNELS.index("tile_right.y")]] = 0.0, -0.3
rule = rule_of("released-disc", SceneSpec().to_json())
for held in (False, True):
    frames[:, [name.startswith("held") for name in CHANNELS]] = held
    episode = Trajectory.of_frames(frames)
    inside = [rule.inside(episode, side).tolist() for side in ("left", "right")]
    print(held, episode.held.tolist(), *inside)
print(rule.name in RULES, rule.words)
print(CliRunner().invoke(app, ["retention", "--help-all"]).output)
"""
    printed = use("To add an outcome rule", code)
    assert "False [False, False] [True, True] [False, False]" in printed
    assert "True [True, True] [False, False] [False, False]" in printed
    assert "True let go within 6.5 cm" in printed
    assert "released-disc" in printed.partition("seen from above")[2]


@pytest.mark.slow
def test_a_control_is_its_features_and_its_words(use: Callable[[str, str], str]) -> None:
    code = """
from types import SimpleNamespace
from probe_kit.train import CONTROLS
from probe_kit.train.control_features import ControlInputs

run = SimpleNamespace(episodes=episodes.assign(instruction="put the cube"), control_features={}, location="run")
samples = SimpleNamespace(rows=np.arange(3))
print(CONTROLS["length"], ControlInputs(run, samples, False, None).features("length").ravel().tolist())
"""
    printed = use("To add a control", "import numpy as np" + code)
    assert "the number of words of the instruction [3.0, 3.0, 3.0]" in printed


def test_a_comparison_is_one_call(tmp_path: Path, outcome_table: Callable[..., pd.DataFrame]) -> None:
    runs: dict[str, Any] = {
        name: ArrayRun(tmp_path / name, name, "suite@1#0123456789ab", outcome_table(right, 24 - right, 0), {})
        for name, right in (("before", 12), ("after", 18))
    }
    code = block("To add a comparison", "python")
    assert code.count("compare(") == 1
    exec(code, runs)
    color, mean = runs["differences"]
    assert (color.group, color.minus, color.sr, mean.category) == ("after", "before", 0.25, "mean")
    assert 0 < color.p == color.p_holm <= 1


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda code: code.split("\n")[0])
def test_an_example_follows_the_rules_of_the_house(example: str) -> None:
    # The text around an example leaves docstrings of methods and names from outside to the reader.
    for command in (["check", "--extend-ignore", "D1,F821"], ["format", "--diff"]):
        ruff = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--no-cache", "--stdin-filename", "probe_kit/new.py", "-"],
            cwd=ROOT, input=example, capture_output=True, encoding="utf-8", check=False,
        )  # fmt: skip
        assert ruff.returncode == 0, ruff.stdout + ruff.stderr
    tree = ast.parse(example)
    assert not [*fillers(tree), *first_words(tree), *parameters_in_prose(tree)]
