"""Runs that several files read: a trained and an untrained policy, a VLM, scripted policies. Made once."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.acceptance.product import probe_kit
from tests.support.made_once import made_once


@dataclass(frozen=True)
class StoredRuns:
    """Folders of runs on the same items, of seed 0.

    trained: the embedded policy on Color and State, with probes and a swap of pictures. untrained: its network
    with random weights on Color, with probes. asked: the embedded VLM on both. expert,
    mirrored, idle: scripted policies on four items of Color.
    """

    folder: Path

    @property
    def trained(self) -> Path:
        return self.folder / "trained"

    @property
    def untrained(self) -> Path:
        return self.folder / "untrained"

    @property
    def asked(self) -> Path:
        return next(self.folder.glob("asked/*/run.json")).parent

    @property
    def expert(self) -> Path:
        return self.folder / "expert"

    @property
    def mirrored(self) -> Path:
        return self.folder / "expert-mirrored"

    @property
    def idle(self) -> Path:
        return self.folder / "idle"


def play(folder: Path) -> None:
    """Play, ask and fit all of `StoredRuns`."""
    runs = StoredRuns(folder)
    both, color = ("--categories", "color,state"), ("--categories", "color")
    policy = ("--model", "pi0-tiny", "--items", "12", "--batch", "8", "--env-workers", "0", "--max-steps", "3")
    policy += ("--execute", "3")
    probes = ("--permutations", "3", "--controls", "none", "--views", "mean")
    probe_kit("extract", *policy, *both, "--out", runs.trained, "--label", "trained")
    probe_kit("train", runs.trained, *probes)
    probe_kit("intervene", runs.trained, *color)
    other = ("--random-weights", "--label", "untrained")
    probe_kit("extract", *policy, *color, *other, "--out", runs.untrained)
    probe_kit("train", runs.untrained, *probes)
    probe_kit("ask", "--model", "vlm-tiny", "--items", "12", *both, "--prompt", "p1", "--out", folder / "asked")
    for scripted in (runs.expert, runs.mirrored, runs.idle):
        settings = (*color, "--items", "4", "--max-steps", "30", "--env-workers", "0")
        probe_kit("extract", "--model", scripted.name, *settings, "--out", scripted)


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> StoredRuns:
    """The shared runs. A process of tests has copies of its own; no test changes them."""
    return StoredRuns(made_once(tmp_path_factory, "stored", play))
