"""The weekly check of the newest lerobot and transformers runs tests that exist, and reports every failure."""

import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / ".ci" / "upstream"


def test_the_workflow_installs_the_newest_and_runs_a_script_over_tests_that_exist() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "upstream.yml").read_text(encoding="utf-8"))
    commands = [step["run"] for step in workflow["jobs"]["conformance"]["steps"] if "run" in step]
    assert any("--upgrade" in command and "lerobot" in command for command in commands)
    # lerobot bounds transformers, so that a newer one is only installed without it
    assert any("--upgrade-package transformers" in command and "lerobot" not in command for command in commands)
    conditions = [step["if"] for step in workflow["jobs"]["conformance"]["steps"] if "if" in step]
    (releases,) = workflow["jobs"]["conformance"]["strategy"]["matrix"].values()
    assert all(any(f"'{value}'" in condition for value in releases) for condition in conditions)
    assert (ROOT / commands[-1].split()[0]) == SCRIPT
    assert os.access(SCRIPT, os.X_OK)
    test_paths = re.findall(r"tests/[\w/.]+", SCRIPT.read_text(encoding="utf-8"))
    assert test_paths
    assert all((ROOT / test_path).exists() for test_path in test_paths)


@pytest.mark.parametrize(
    ("output", "code", "expected"),
    [
        ("1 passed", 0, "Nothing broke."),
        (
            "FAILED tests/x.py::test_y - AssertionError\n1 failed",
            1,
            "- FAILED tests/x.py::test_y - AssertionError",
        ),
        ("ERROR tests/x.py - ImportError\n1 error", 2, "- ERROR tests/x.py - ImportError"),
        ("INTERNALERROR> torch is gone", 3, "pytest ended with code 3, and no test failed"),
    ],
)
def test_the_report_says_what_broke(tmp_path: Path, output: str, code: int, expected: str) -> None:
    """With an interpreter that ends as pytest would."""
    python, report = tmp_path / "python", tmp_path / "summary.md"
    python.write_text(
        f"#!/bin/sh\n[ \"$1\" = -c ] && echo '- lerobot 9.9' && exit 0\nprintf '%s\\n' '{output}'\nexit {code}\n",
        encoding="utf-8",
    )
    python.chmod(0o755)
    variables = {**os.environ, "PYTHON": str(python), "GITHUB_STEP_SUMMARY": str(report)}
    ended = subprocess.run([str(SCRIPT)], env=variables, capture_output=True, text=True, encoding="utf-8")
    text = report.read_text(encoding="utf-8")
    assert ended.returncode == code
    assert expected in text
    assert "- lerobot 9.9" in text
    assert ("Nothing broke." in text) == (code == 0)


def test_the_report_comes_first_where_the_output_is_a_file(tmp_path: Path) -> None:
    """The end of pytest's output does not overwrite it."""
    python, out = tmp_path / "python", tmp_path / "out.txt"
    python.write_text('#!/bin/sh\necho "FAILED tests/x.py::test_y - width $COLUMNS"\nexit 1\n', encoding="utf-8")
    python.chmod(0o755)
    variables = {name: value for name, value in os.environ.items() if name != "GITHUB_STEP_SUMMARY"}
    with out.open("w", encoding="utf-8") as file:
        ended = subprocess.run([str(SCRIPT)], env={**variables, "PYTHON": str(python)}, stdout=file)
    assert ended.returncode == 1
    text = out.read_text(encoding="utf-8")
    assert text.startswith("### Adapters on the newest lerobot and transformers")
    assert "- FAILED tests/x.py::test_y - width 300" in text
