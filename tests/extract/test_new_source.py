"""The source that CONTRIBUTING adds: one file, and one name in the settings."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import probe_kit as pk
from probe_kit.extract import ExtractSettings, prepare, settings
from probe_kit.hooks import Policy

PAGE = Path(__file__).parents[2] / "CONTRIBUTING.md"


@pytest.fixture
def noise(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The module of the diff; its settings are among the sources of `extract`."""
    diff = PAGE.read_text(encoding="utf-8").partition("+++ b/probe_kit/extract/sources/noise.py\n")[2]
    lines = diff.partition("\n```")[0].splitlines()
    assert all(line.startswith("+") for line in lines), "the source is one new file"
    (tmp_path / "noise_source.py").write_text("\n".join(line[1:] for line in lines), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("noise_source")
    monkeypatch.setattr(settings, "SOURCES", (*settings.SOURCES, module.NoisePictures))
    monkeypatch.setattr(ExtractSettings, "sources", settings.SOURCES)
    yield module
    sys.modules.pop("noise_source", None)


def test_a_source_is_one_file_from_its_option_to_its_run(noise: Any, pi0_tiny: Policy, tmp_path: Path) -> None:
    typed = ExtractSettings.of_command({"model": "pi0-tiny", "noise": 3, "env_workers": 0})
    assert typed.source == noise.NoisePictures(count=3)
    assert ExtractSettings(**typed.config()) == typed
    run = prepare(typed, policy=pi0_tiny).run(tmp_path / "run")
    assert len(run.episodes) == 3
    column = run.column(pk.Site("backbone", 3), "mean")
    assert np.isfinite(column).all()
    assert len(np.unique(column, axis=0)) == 3
