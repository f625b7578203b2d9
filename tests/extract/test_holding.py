"""Every writer of a run holds a lock, the owner and each worker, so that no process clears its files."""

import fcntl
from pathlib import Path
from typing import Any

import pytest

from probe_kit.env import SceneSpec
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.extract.extraction import play_episodes
from probe_kit.runs.folder import Folder
from probe_kit.runs.layout import RUN_FILE
from probe_kit.suite import Suite

EPISODES = [0, 1]


@pytest.fixture
def settings(small_suite: Suite) -> ExtractSettings:
    scene = SceneSpec(max_steps=1)
    return ExtractSettings(
        "expert", suite=small_suite.folder, categories=("color",), items=2, scene=scene, env_workers=0
    )


@pytest.fixture
def unheld(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys that were written without a lock on their run; the beginning of a run does not count."""
    found: list[str] = []
    for name in ("create", "write"):
        _watch(monkeypatch, name, found)
    return found


def _watch(monkeypatch: pytest.MonkeyPatch, name: str, found: list[str]) -> None:
    original = getattr(Folder, name)

    def watched(self: Folder, key: str, content: bytes) -> Any:
        with (self.path / RUN_FILE).open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                pass
            else:
                found.append(key)
        return original(self, key, content)

    monkeypatch.setattr(Folder, name, watched)


def begun(settings: ExtractSettings, run: Path) -> str:
    """A run whose owner was killed."""
    return prepare(settings).writer(Folder(run)).location.address


def test_an_extraction_in_one_process_holds_its_run(
    settings: ExtractSettings, tmp_path: Path, unheld: list[str]
) -> None:
    extract_run(settings, tmp_path / "run")
    assert unheld == []


def test_a_worker_holds_the_run_itself(settings: ExtractSettings, tmp_path: Path, unheld: list[str]) -> None:
    address = begun(settings, tmp_path / "run")
    left, done = list(EPISODES), list[int]()

    def take() -> int | None:
        if len(done) == len(EPISODES):
            raise EOFError  # the executor hung up
        return left.pop(0) if left else None

    with pytest.raises(EOFError):
        play_episodes((settings, address), take, lambda event: done.append(event.number))
    assert done == EPISODES
    assert (tmp_path / "run" / "certificate.json").is_file()
    assert unheld == []


def test_a_worker_that_joins_forgets_no_failure(settings: ExtractSettings, tmp_path: Path) -> None:
    writer = prepare(settings).writer(Folder(tmp_path / "run"))
    with writer.owned():
        writer.give_up(3, "it fell over")
        with writer.joined():
            pass
    with writer.joined():
        assert list(writer.location.read_all("failed", ".json"))
    with writer.owned():
        assert not list(writer.location.read_all("failed", ".json"))
