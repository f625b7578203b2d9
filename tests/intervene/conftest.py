"""A real run of the untrained network, with which interventions may be stored, and what they are made with."""

import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from probe_kit.intervene import ReplayFiles
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


@pytest.fixture(scope="session")
def twin() -> "Policy":
    from probe_kit.hooks import load_policy

    return load_policy("pi0-tiny", random_weights=True)


@pytest.fixture(scope="module")
def copy(recorded_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Of the recorded run, one for every file."""
    return open_run(shutil.copytree(recorded_run.path, tmp_path_factory.mktemp("intervened") / "run"))


@pytest.fixture(scope="session")
def source(small_suite: Suite) -> ReplayFiles:
    return ReplayFiles(small_suite.folder)


@pytest.fixture(scope="module")
def session(copy: Run, source: ReplayFiles, twin: "Policy") -> Iterator[ReplaySession]:
    with open_session(copy, source, lambda *_: twin) as opened, opened.ready():
        yield opened
