"""The small run that the viewer's tests share, and its export."""

from pathlib import Path

import pytest

from probe_kit.extract import Run, open_run
from probe_kit.view import write_viewer
from probe_kit.view.catalogue import Catalogue


@pytest.fixture(scope="module")
def little(little_runs: Path) -> Run:
    """24 episodes with trajectories, probes of two views, and frames of two episodes."""
    return open_run(little_runs / "run")


@pytest.fixture(scope="module")
def catalogue(little: Run) -> Catalogue:
    """Of the small run."""
    return Catalogue([little])


@pytest.fixture(scope="module")
def exported(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of both small runs."""
    runs = [open_run(little_runs / name) for name in ("run", "other")]
    return write_viewer(runs, tmp_path_factory.mktemp("viewer") / "page")
