import shutil
from pathlib import Path

import pytest
import torch

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.families.spatialvla.adapter import LoadedSpatialVLA, load_checkpoint
from tests.support.spatialvla_checkpoints import FIRST_ACTION, write_checkpoint


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("spatialvla"), shards=3)


def load(folder: Path, dtype: str | None = None, random_weights: bool = False, seed: int = 0) -> LoadedSpatialVLA:
    return load_checkpoint(str(folder), "cpu", dtype, random_weights, seed)


def test_every_tensor_of_every_shard_arrives_and_names_the_files(folder: Path) -> None:
    loaded = load(folder)
    stored = read_weights(folder)
    assert loaded.audit.tensors == len(stored.tensors) == len(loaded.network.state_dict())
    assert loaded.audit.sha256 == stored.sha256()
    state = loaded.network.state_dict()
    table = "language_model.model.embed_tokens.weight"
    assert all(torch.equal(state[name], tensor) for name, tensor in stored.tensors.items() if name != table)
    assert torch.equal(state[table][:FIRST_ACTION], stored.tensors[table][:FIRST_ACTION])


def test_the_stale_rows_of_action_ids_are_overwritten_and_the_output_layer_stays(folder: Path) -> None:
    stored, network = read_weights(folder).tensors, load(folder).network
    rows = network.language_model.model.embed_tokens.weight[FIRST_ACTION:]
    assert torch.equal(rows, stored["spatial_embed_tokens.weight"])
    assert not torch.equal(rows, stored["language_model.model.embed_tokens.weight"][FIRST_ACTION:])
    head = network.language_model.lm_head.weight
    assert torch.equal(head, stored["language_model.lm_head.weight"])
    assert head.data_ptr() != network.language_model.model.embed_tokens.weight.data_ptr()


def test_files_that_are_missing_or_of_another_kind_are_named(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "bare"))
    (copy / "processor_config.json").unlink()
    with pytest.raises(CheckpointError, match=r"processor_config\.json is missing: it holds the action bins"):
        load(copy)
