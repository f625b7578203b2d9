"""A checkpoint of the hub is named with its commit, and a refusal of the hub keeps its reason."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.extract.settings import ExtractSettings, run_label
from probe_kit.hooks import load_model
from probe_kit.hooks.checkpoints.checkpoint import (
    cached_folder,
    hub_files,
    pin_revision,
    pinned_commits,
    without_revision,
)
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from tests.hooks.families.pi0.checkpoints import write_intact
from tests.support.every_checkpoint import WRITERS
from tests.support.hub_stand_in import Hub, hub

OLD, NEW = "a" * 40, "b" * 40
REPO, PART = "lab/tiny", "lab/part"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """A hub with two commits of one model, an empty cache and no token."""
    with hub() as endpoint:
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", endpoint.address)
        monkeypatch.setattr(
            "huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE",
            endpoint.address + "/{repo_id}/resolve/{revision}/{filename}",
        )
        monkeypatch.setattr("huggingface_hub.hf_api.api.endpoint", endpoint.address)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr("huggingface_hub.get_token", lambda: None)
        endpoint.models[REPO] = {OLD: {"config.json": b'{"age": 1}'}, NEW: {"config.json": b'{"age": 2}'}}
        endpoint.names[REPO] = {"main": NEW, "v1": OLD, "refs/pr/1": OLD}
        yield endpoint


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
    assert pin_revision(f"{REPO}{revision}") == f"{REPO}@{NEW if age == 2 else OLD}"
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


@pytest.mark.slow
def test_the_card_and_a_repetition_have_the_commit(
    server: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = write_intact(tmp_path / "made")
    files = {path.name: path.read_bytes() for path in checkpoint.iterdir() if path.is_file()}
    server.models[REPO] = {OLD: files, NEW: {"config.json": b"{}"}}
    server.names[REPO] = {"main": OLD}
    card = load_model("pi0", REPO).card
    assert card.checkpoint == f"{REPO}@{OLD}"
    server.names[REPO]["main"] = NEW
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "offline mode")
    again = load_model("pi0", card.checkpoint).card
    assert (again.checkpoint, again.weights_sha256) == (card.checkpoint, card.weights_sha256)


def vlm_of(folder: Path, field: str, part: str) -> dict[str, bytes]:
    """A checkpoint that names a part of its folder as a repository; returns the part's files, which it loses."""
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    (folder / "config.json").write_text(json.dumps(config | {field: PART}), encoding="utf-8")
    part_folder = folder / part
    names = [path for path in part_folder.rglob("*") if path.is_file() and path.suffix != ".safetensors"]
    files = {path.relative_to(part_folder).as_posix(): path.read_bytes() for path in names}
    shutil.rmtree(part_folder)
    return files


def tokenizer_of(folder: Path, field: str, _: str) -> dict[str, bytes]:
    """The same of a tokenizer beside the configuration; no field names PaliGemma's."""
    if field:
        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        (folder / "config.json").write_text(json.dumps(config | {field: PART}), encoding="utf-8")
    files = {path.name: path.read_bytes() for path in folder.glob("tokenizer*")}
    for name in files:
        (folder / name).unlink()
    return files


def base_of(folder: Path, *_: str) -> dict[str, bytes]:
    """The same of an adapter, whose base is a repository; the folder then holds the adapter alone."""
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    tensors = load_file(folder / "model.safetensors")
    name = next(
        tensor_name
        for tensor_name, tensor in tensors.items()
        if tensor_name.endswith("q_proj.weight") and tensor.ndim == 2
    )
    up, down = torch.zeros(len(tensors[name]), 2), torch.zeros(2, tensors[name].shape[1])
    module = f"base_model.model.{name.removesuffix('.weight')}"
    shutil.rmtree(folder)
    folder.mkdir()
    factors = {f"{module}.lora_A.weight": down, f"{module}.lora_B.weight": up}
    save_file(factors, folder / "adapter_model.safetensors")
    settings = {"peft_type": "LORA", "r": 2, "lora_alpha": 2, "base_model_name_or_path": PART}
    (folder / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    return files


PARTS: dict[str, tuple[str, Callable[..., dict[str, bytes]], str, str, str]] = {
    "vision-language model": ("smolvla", vlm_of, "vlm_model_name", "vlm", "config.json"),
    "checkpoint of the network": ("molmoact2", vlm_of, "checkpoint_path", "vlm", "config.json"),
    "base of a policy": ("groot", vlm_of, "base_model_path", "base", "statistics.json"),
    "action tokenizer": ("pi0-fast", vlm_of, "action_tokenizer_name", "fast", "processor_config.json"),
    "a step's tokenizer": ("xvla", tokenizer_of, "", "", "tokenizer.json"),
    "default tokenizer": ("pi0", tokenizer_of, "", "", "tokenizer.json"),
    "base of an adapter": ("pi05", base_of, "", "", "config.json"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(PARTS))
def test_the_card_has_the_commits_of_the_repositories_that_a_checkpoint_names_and_a_repetition_reads_them(
    kind: str, server: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    family, build, field, part, changed = PARTS[kind]
    write, options = WRITERS[family]
    folder = write(tmp_path / "model")
    files = build(folder, field, part)
    repo = {"default tokenizer": "google/paligemma-3b-pt-224", "a step's tokenizer": "facebook/bart-large"}.get(
        kind, PART
    )
    server.models[repo] = {OLD: files, NEW: {**files, changed: files[changed] + b"\n"}}
    server.names[repo] = {"main": OLD}
    card = load_model(family, str(folder), **options).card
    assert card.repositories == {repo: OLD}
    server.names[repo]["main"] = NEW
    with pinned_commits(card.repositories):
        again = load_model(family, str(folder), **options).card
    assert (again.repositories, again.settings) == (card.repositories, card.settings)
    assert load_model(family, str(folder), **options).card.repositories == {repo: NEW}
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "offline mode")
    with pinned_commits(card.repositories):
        assert load_model(family, str(folder), **options).card.repositories == {repo: OLD}


def test_a_local_folder_with_an_at_sign_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lab/tiny@v1").mkdir(parents=True)
    assert checkpoint_folder("lab/tiny@v1") == Path("lab/tiny@v1")
    assert pin_revision("lab/tiny@v1") == "lab/tiny@v1"


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
    checkpoint = write_intact(tmp_path / "made")
    index = b'{"weight_map": {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"}}'
    shutil.copy(checkpoint / "model.safetensors", checkpoint / "model-00001-of-00002.safetensors")
    (checkpoint / "model.safetensors").unlink()
    files = {path.name: path.read_bytes() for path in checkpoint.iterdir() if path.is_file()}
    server.models[REPO][NEW] = {**files, "model.safetensors.index.json": index}
    with pytest.raises(
        WeightsError, match=r"model-00002-of-00002\.safetensors .*are missing.*repository lacks them"
    ):
        load_model("pi0", REPO)


def test_a_folder_called_snapshots_is_not_taken_for_the_cache(tmp_path: Path) -> None:
    checkpoint = write_intact(tmp_path / "snapshots" / "step-100")
    (checkpoint / "model.safetensors").unlink()
    with pytest.raises(WeightsError, match=r"no weights in .*step-100.*Download the checkpoint again"):
        load_model("pi0", str(checkpoint))
