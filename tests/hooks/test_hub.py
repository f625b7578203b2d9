"""Without a network the hub is given up within seconds, and what the cache holds is used."""

import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints import checkpoint
from probe_kit.hooks.checkpoints.folders import checkpoint_folder


@pytest.fixture
def silent() -> Iterator[str]:
    """An address that takes connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture(autouse=True)
def _online(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(checkpoint, "PATIENCE", 0.3)


@pytest.mark.parametrize("address", ["http://127.0.0.1:9", "http://nowhere.invalid", "no address"])
def test_a_hub_out_of_reach_is_said_within_seconds(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", address)
    started = time.monotonic()
    with pytest.raises(
        CheckpointError,
        match=r"folder 'some/model' does not exist in /.*cannot be fetched \(.*the cache has no copy\)",
    ):
        checkpoint_folder("some/model")
    assert (
        time.monotonic() - started < 20
    )  # of a busy machine; the hub's own client takes that long when it is idle


def test_a_hub_that_says_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch, silent: str) -> None:
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", silent)
    assert checkpoint.unreachable() == f"{silent} did not answer within 0.3 s"  # whichever clock runs out first


def test_offline_mode_sends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr(checkpoint, "urlopen", lambda *_, **__: pytest.fail("it was asked"))
    assert "offline mode" in checkpoint.unreachable()


@pytest.mark.parametrize("name", ["checkpoint", "./runs/checkpoint", "runs/mine/checkpoints/last"])
def test_a_relative_folder_that_is_not_here_is_named_with_the_folder_it_was_looked_for_in(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=f"folder '{name}' does not exist in {tmp_path}. Give the folder"):
        checkpoint_folder(name)
    with pytest.raises(CheckpointError, match=f"folder '{tmp_path}/nothing' does not exist. Give the folder"):
        checkpoint_folder(str(tmp_path / "nothing"))


@pytest.mark.parametrize("name", ["some/[bold]", "some/..", "some/" + "a" * 200, "~nobody/x", "some/\x1b[31m"])
def test_names_that_no_hub_has_are_refused_as_checkpoints(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(checkpoint, "urlopen", lambda *_, **__: (_ for _ in ()).throw(OSError("no network")))
    with pytest.raises(CheckpointError):
        checkpoint_folder(name)
