"""A checkpoint of the hub is named with its commit, and a refusal of the hub keeps its reason."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.extract.settings import ExtractSettings, run_label
from probe_kit.hooks import load_model
from probe_kit.hooks.checkpoints.checkpoint import (
    cached_folder,
    checkpoint_folder,
    hub_files,
    pinned,
    without_revision,
)
from tests.support.hub_stand_in import Hub, hub
from tests.support.pi0_checkpoints import write_intact

OLD, NEW = "a" * 40, "b" * 40
REPO = "lab/tiny"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """A hub with two commits of one model, an empty cache and no token."""
    with hub() as found:
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", found.address)
        monkeypatch.setattr(
            "huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE",
            found.address + "/{repo_id}/resolve/{revision}/{filename}",
        )
        monkeypatch.setattr("huggingface_hub.hf_api.api.endpoint", found.address)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr("huggingface_hub.get_token", lambda: None)
        found.models[REPO] = {OLD: {"config.json": b'{"age": 1}'}, NEW: {"config.json": b'{"age": 2}'}}
        found.names[REPO] = {"main": NEW, "v1": OLD, "refs/pr/1": OLD}
        yield found


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch, server: Hub) -> Hub:
    """Call `.names` and the cache first; afterwards nothing answers."""
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "offline mode")
    return server


@pytest.mark.parametrize(("revision", "age"), [("", 2), ("@main", 2), ("@v1", 1), (f"@{OLD}", 1)])
@pytest.mark.usefixtures("server")
def test_a_revision_names_the_commit_that_is_read(revision: str, age: int) -> None:
    folder = checkpoint_folder(f"{REPO}{revision}")
    assert (folder / "config.json").read_text(encoding="utf-8") == f'{{"age": {age}}}'
    assert pinned(f"{REPO}{revision}") == f"{REPO}@{NEW if age == 2 else OLD}"
    assert cached_folder(f"{REPO}{revision}") == folder
    assert without_revision(f"{REPO}{revision}") == REPO
    assert hub_files(f"{REPO}{revision}") == ["config.json"]


@pytest.mark.usefixtures("server")
def test_a_commit_is_read_again_without_the_network_although_the_branch_went_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checkpoint_folder(f"{REPO}@v1")
    checkpoint_folder(REPO)
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "offline mode")
    folder = checkpoint_folder(f"{REPO}@{OLD}")
    assert (folder / "config.json").read_text(encoding="utf-8") == '{"age": 1}'
    with pytest.raises(CheckpointError, match=r"offline mode; the cache has no copy.*Connect to the network"):
        checkpoint_folder(f"{REPO}@{'c' * 40}")


def test_the_card_and_a_repetition_have_the_commit(
    server: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = write_intact(tmp_path / "made")
    files = {path.name: path.read_bytes() for path in made.iterdir() if path.is_file()}
    server.models[REPO] = {OLD: files, NEW: {"config.json": b"{}"}}
    server.names[REPO] = {"main": OLD}
    card = load_model("pi0", REPO).card
    assert card.checkpoint == f"{REPO}@{OLD}"
    server.names[REPO]["main"] = NEW
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "offline mode")
    again = load_model("pi0", card.checkpoint).card
    assert (again.checkpoint, again.weights_sha256) == (card.checkpoint, card.weights_sha256)


def test_a_local_folder_with_an_at_sign_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lab/tiny@v1").mkdir(parents=True)
    assert checkpoint_folder("lab/tiny@v1") == Path("lab/tiny@v1")
    assert pinned("lab/tiny@v1") == "lab/tiny@v1"


def test_labels_name_the_revision_also_one_with_slashes() -> None:
    assert run_label(ExtractSettings("pi0", checkpoint="lab/tiny@refs/pr/1")) == "pi0 · tiny@refs-pr-1"


@pytest.mark.parametrize(
    ("checkpoint", "refusal", "token", "message"),
    [
        ("lab/tinny", None, None, "no such repository, or it is private and no token is set.*Check the name"),
        ("lab/tinny", None, "hf_x", "no such repository, or it is private and your token does not open it"),
        (f"{REPO}@v9", None, None, "no such revision.*v9.*Look the branches"),
        (REPO, (403, "GatedRepo"), None, "access on request.*Run `hf auth login`"),
        (REPO, (403, "GatedRepo"), "hf_x", "access on request.*Ask for access"),
        (REPO, (401, ""), "hf_x", r"refuses your token \(401\).*new token"),
        (REPO, (503, ""), None, "answers 503"),
    ],
)
def test_a_refusal_of_the_hub_keeps_its_reason(
    server: Hub,
    monkeypatch: pytest.MonkeyPatch,
    checkpoint: str,
    refusal: tuple[int, str] | None,
    token: str | None,
    message: str,
) -> None:
    monkeypatch.setattr("huggingface_hub.get_token", lambda: token)
    if refusal is not None:
        server.refusals[REPO] = refusal
    with pytest.raises(CheckpointError, match=message):
        checkpoint_folder(checkpoint)


def test_a_shard_that_the_repository_lacks_is_named(server: Hub, tmp_path: Path) -> None:
    made = write_intact(tmp_path / "made")
    index = b'{"weight_map": {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"}}'
    shutil.copy(made / "model.safetensors", made / "model-00001-of-00002.safetensors")
    (made / "model.safetensors").unlink()
    files = {path.name: path.read_bytes() for path in made.iterdir() if path.is_file()}
    server.models[REPO][NEW] = {**files, "model.safetensors.index.json": index}
    with pytest.raises(
        WeightsError, match=r"model-00002-of-00002\.safetensors .*are missing.*repository lacks them"
    ):
        load_model("pi0", REPO)
