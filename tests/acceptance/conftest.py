"""What several acceptance tests share: one played run of the embedded policy, made once for all processes."""

from pathlib import Path

import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit
from tests.support.made_once import made_once

PLAYED = (
    *("--model", "pi0-tiny", "--categories", "color", "--items", "12", "--max-steps", "6", "--execute", "3"),
    *("--captured-calls", "2", "--tokens", "all", "--env-workers", "0"),
)
"""Settings of the shared run: 24 episodes in six groups, two inferences each, every token stored."""


@pytest.fixture(scope="session")
def _played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(
        tmp_path_factory, "accepted", lambda folder: probe_kit("extract", *PLAYED, "--out", folder / "played")
    )


@pytest.fixture(scope="session")
def played(_played: Path) -> Path:
    """Folder of a complete run of `pi0-tiny` with the settings `PLAYED`; a process of tests has a copy of its own."""
    return _played / "played"


@pytest.fixture
def run(played: Path) -> pk.Run:
    """The shared run, opened."""
    return pk.open_run(played)
