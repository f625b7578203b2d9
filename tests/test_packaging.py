"""What lies beside the code for others' machines: citation, workflow, image."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from probe_kit.version import __version__

ROOT = Path(__file__).parents[1]
STEPS = re.findall(r"^RUN (.+)$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)


def test_the_citation_names_this_version_and_licence() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == __version__
    assert f'license = "{citation["license"]}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert {"cff-version", "title", "message", "authors"} <= citation.keys()


def test_the_workflow_runs_what_any_machine_runs() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8"))
    steps = workflow["jobs"]["tests"]["steps"]
    assert [step["run"] for step in steps if "run" in step] == [".ci/run"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_the_image_installs_by_the_readmes_own_script() -> None:
    apt, install, look = STEPS
    assert apt.startswith("apt-get update")
    assert install == "./with-uv probe-kit --version"
    assert look.startswith(".venv/bin/probe-kit")


@pytest.mark.slow
def test_the_steps_of_the_image_work_as_plain_commands(tmp_path: Path) -> None:
    """Slow: a real installation. The image itself is not built here."""
    clone = tmp_path / "probe-kit"
    ignored = shutil.ignore_patterns(
        *(ROOT / ".dockerignore").read_text(encoding="utf-8").replace("**/", "").split()
    )
    shutil.copytree(ROOT, clone, ignore=ignored)
    plain = {name: value for name, value in os.environ.items() if name not in ("VIRTUAL_ENV", "PYTHONPATH")}
    for step in STEPS[1:]:
        ran = subprocess.run(
            ["sh", "-c", step], cwd=clone, env=plain, capture_output=True, encoding="utf-8", check=False
        )
        assert ran.returncode == 0, ran.stderr
