"""The source that CONTRIBUTING adds: one file, and an entry point of its package."""

import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import probe_kit as pk
from probe_kit.extract.sources import kinds

PAGE = Path(__file__).parents[2] / "CONTRIBUTING.md"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder of the import path with the new file and what an installer makes of the entry point."""
    page = PAGE.read_text(encoding="utf-8")
    file = page.partition("## To add a source\n")[2].partition("```python\n")[2].partition("```")[0]
    (tmp_path / "noise_source.py").write_text(file, encoding="utf-8")
    (entry,) = [line for line in page.splitlines() if line.startswith("noise = ")]
    about = tmp_path / "noise_source-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: noise-source\nVersion: 1\n", encoding="utf-8")
    points = f"[{kinds.ENTRY_POINTS}]\n{entry.replace(chr(34), '')}\n"
    (about / "entry_points.txt").write_text(points, encoding="utf-8")
    return tmp_path


def typed(package: Path, *line: str) -> None:
    """Type a line of probe-kit where the package is installed."""
    path = os.pathsep.join([str(package), *sys.path])
    ended = subprocess.run(
        [sys.executable, "-m", "probe_kit", *line],
        capture_output=True, encoding="utf-8", check=False, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr


@pytest.mark.slow
def test_a_source_is_one_file_from_its_option_to_its_run(package: Path, tmp_path: Path) -> None:
    line = ("extract", "--model", "pi0-tiny", "--noise", "3", "--env-workers", "0")
    typed(package, *line, "--out", str(tmp_path / "run"))
    run = pk.open_run(tmp_path / "run")
    assert len(run.episodes) == 3
    column = run.column(pk.Site("backbone", 3), "mean")
    assert np.isfinite(column).all()
    assert len(np.unique(column, axis=0)) == 3


@pytest.mark.slow
def test_a_model_that_answers_is_asked_about_the_same_source(package: Path, tmp_path: Path) -> None:
    """It predicts no actions, so that the run declares none."""
    typed(
        package, "ask", "--model", "vlm-tiny", "--noise", "3", "--tokens", "pooled", "--out", str(tmp_path / "run")
    )
    assert len(pk.open_run(tmp_path / "run" / "instruction").episodes) == 3


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("json:loads", "no class derived from SourceSettings"),
        ("no_such_module_here:Noise", "ModuleNotFoundError"),
        ("probe_kit.extract.sources.pictures:PictureFolder", "its kind is 'pictures'"),
        ("probe_kit.extract.sources.source:SourceSettings", "its kind is"),
    ],
)
def test_a_source_that_cannot_be_used_is_left_out_by_name(
    value: str, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = EntryPoint("noise", value, kinds.ENTRY_POINTS)
    monkeypatch.setattr(kinds, "entry_points", lambda **_: [entry])
    with pytest.warns(kinds.BrokenSourceWarning, match="noise") as said:
        assert list(kinds._third_party()) == []
    assert problem in str(said[0].message)
