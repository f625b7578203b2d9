import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import WeightsError
from probe_kit.hooks import Observation
from probe_kit.hooks.checkpoints.weights import INDEX_FILE, SINGLE_FILE, read_weights
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.embedded import embedded_checkpoint

NAME = "model.state_proj.weight"
RANDOM = {"probe_kit.weights": "random, seed 0"}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A copy of the embedded checkpoint that a test may damage."""
    return Path(shutil.copytree(embedded_checkpoint("pi0-tiny"), tmp_path / "checkpoint"))


def rewrite(checkpoint: Path, change: dict[str, torch.Tensor | None]) -> None:
    tensors = load_file(checkpoint / SINGLE_FILE)
    for name, tensor in change.items():
        tensors.pop(name, None)
        if tensor is not None:
            tensors[name] = tensor
    save_file(tensors, checkpoint / SINGLE_FILE, metadata=RANDOM)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({NAME: None}, "1 tensors missing: model.state_proj.weight"),
        ({"model.extra": torch.zeros(2)}, "not part of the model: model.extra"),
        ({NAME: torch.zeros(64, 9)}, r"of another shape: model.state_proj.weight \(64, 9\) instead of \(64, 8\)"),
        ({NAME: torch.full((64, 8), torch.nan)}, "NaN or infinite: model.state_proj.weight"),
        ({NAME: None, "model.state_prjo.weight": torch.zeros(64, 8)}, "missing: model.state_proj.weight"),
    ],
    ids=["deleted", "added", "mis-shaped", "nan", "renamed"],
)
def test_a_changed_file_is_refused_by_tensor_name(checkpoint: Path, change, complaint: str) -> None:
    rewrite(checkpoint, change)
    with pytest.raises(WeightsError, match=complaint) as caught:
        Pi0.load(str(checkpoint))
    assert caught.value.exit_code == 3


def test_missing_weights_are_refused_and_not_replaced_by_random_ones(checkpoint: Path) -> None:
    (checkpoint / SINGLE_FILE).unlink()
    with pytest.raises(WeightsError, match="no weights in"):
        Pi0.load(str(checkpoint))


def test_a_truncated_file_is_refused(checkpoint: Path) -> None:
    file = checkpoint / SINGLE_FILE
    file.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(WeightsError, match="cannot be read"):
        Pi0.load(str(checkpoint))


def test_a_dead_output_head_may_be_absent_and_is_listed(checkpoint: Path) -> None:
    head = "model.paligemma_with_expert.gemma_expert.lm_head.weight"
    rewrite(checkpoint, {head: None})
    assert Pi0.load(str(checkpoint)).card.audit["allowed_missing"] == (head,)


def test_shards_load_like_one_file(checkpoint: Path) -> None:
    whole = Pi0.load(str(checkpoint)).card
    shard(checkpoint)
    assert Pi0.load(str(checkpoint)).card.weights_sha256 == whole.weights_sha256


def test_a_missing_shard_is_named(checkpoint: Path) -> None:
    shard(checkpoint)
    (checkpoint / "model-00002-of-00002.safetensors").unlink()
    with pytest.raises(WeightsError, match=r"model-00002-of-00002\.safetensors is missing"):
        Pi0.load(str(checkpoint))


def test_an_index_that_contradicts_its_shards_is_refused(checkpoint: Path) -> None:
    shard(checkpoint)
    index = json.loads((checkpoint / INDEX_FILE).read_text(encoding="utf-8"))
    del index["weight_map"][NAME]
    (checkpoint / INDEX_FILE).write_text(json.dumps(index), encoding="utf-8")
    with pytest.raises(WeightsError, match=f"disagree about {NAME}"):
        Pi0.load(str(checkpoint))


def test_the_hash_names_every_bit(checkpoint: Path) -> None:
    before = read_weights(checkpoint).sha256()
    tensor = load_file(checkpoint / SINGLE_FILE)[NAME]
    tensor[0, 0] = torch.nextafter(tensor[0, 0], torch.tensor(torch.inf))
    rewrite(checkpoint, {NAME: tensor})
    assert read_weights(checkpoint).sha256() != before


def test_the_random_mark_travels_in_the_weights_file(checkpoint: Path) -> None:
    save_file(load_file(checkpoint / SINGLE_FILE), checkpoint / SINGLE_FILE, metadata=RANDOM)
    assert Pi0.load(str(checkpoint)).card.random_weights
    save_file(load_file(checkpoint / SINGLE_FILE), checkpoint / SINGLE_FILE)
    assert not Pi0.load(str(checkpoint)).card.random_weights
    assert Pi0.load(str(checkpoint), random_weights=True).card.random_weights


def shard(checkpoint: Path) -> None:
    """Split the single file in two, as large checkpoints are."""
    tensors = load_file(checkpoint / SINGLE_FILE)
    names = sorted(tensors)
    halves = {"model-00001-of-00002.safetensors": names[::2], "model-00002-of-00002.safetensors": names[1::2]}
    for file, half in halves.items():
        save_file({name: tensors[name] for name in half}, checkpoint / file, metadata=RANDOM)
    weight_map = {name: file for file, half in halves.items() for name in half}
    (checkpoint / INDEX_FILE).write_text(json.dumps({"weight_map": weight_map}), encoding="utf-8")
    (checkpoint / SINGLE_FILE).unlink()


def test_a_checkpoint_in_the_layout_of_early_2025_acts_like_todays(
    checkpoint: Path, pi0_tiny: Pi0, observation: Observation
) -> None:
    """lerobot's own loader returns a random backbone for such a file."""
    vlm = "model.paligemma_with_expert.paligemma"
    tensors = load_file(checkpoint / SINGLE_FILE)
    old = {
        name.replace(f"{vlm}.model.language_model.", f"{vlm}.language_model.model.").replace(
            f"{vlm}.model.vision_tower.", f"{vlm}.vision_tower."
        ): tensor
        for name, tensor in tensors.items()
    }
    assert old.keys() != tensors.keys()
    save_file(old, checkpoint / SINGLE_FILE, metadata=RANDOM)
    np.testing.assert_array_equal(
        Pi0.load(str(checkpoint)).act([observation], [1]), pi0_tiny.act([observation], [1])
    )


def test_a_file_that_holds_the_embedding_only_as_lm_head_loads_it_from_there(checkpoint: Path) -> None:
    vlm = "model.paligemma_with_expert.paligemma"
    embedding = f"{vlm}.model.language_model.embed_tokens.weight"
    head = load_file(checkpoint / SINGLE_FILE)[f"{vlm}.lm_head.weight"]
    rewrite(checkpoint, {embedding: None})
    assert torch.equal(Pi0.load(str(checkpoint)).network.state_dict()[embedding], head)


def test_a_loaded_policy_is_in_eval_mode(checkpoint: Path) -> None:
    assert not Pi0.load(str(checkpoint)).network.training


def test_a_pickled_state_dict_is_read_without_running_code(checkpoint: Path, tmp_path: Path) -> None:
    whole = Pi0.load(str(checkpoint)).card.weights_sha256
    tensors = load_file(checkpoint / SINGLE_FILE)
    (checkpoint / SINGLE_FILE).unlink()
    torch.save(tensors, checkpoint / "model.pt")
    assert Pi0.load(str(checkpoint)).card.weights_sha256 == whole
    torch.save({"trap": Path(tmp_path)}, checkpoint / "model.pt")
    with pytest.raises(WeightsError, match="plain tensors"):
        Pi0.load(str(checkpoint))


@pytest.mark.parametrize(
    ("before", "told"),
    [
        ("_orig_mod.", "_orig_mod."),
        ("module.", "module."),
        ("module._orig_mod.", "module._orig_mod."),
        ("policy.", "policy."),
        ("agent.policy.", "agent.policy."),
    ],
)
def test_a_name_in_front_of_all_tensors_is_told(checkpoint: Path, before: str, told: str) -> None:
    tensors = {before + name: tensor for name, tensor in load_file(checkpoint / SINGLE_FILE).items()}
    save_file(tensors, checkpoint / SINGLE_FILE)
    with pytest.raises(WeightsError, match=f"names hold '{told}'.*save its tensors again without") as caught:
        Pi0.load(str(checkpoint))
    assert "missing" not in str(caught.value)


def test_a_wrapper_inside_the_names_is_told(checkpoint: Path) -> None:
    tensors = {name.replace("layers.0.", "layers.0._checkpoint_wrapped_module."): tensor
               for name, tensor in load_file(checkpoint / SINGLE_FILE).items()}  # fmt: skip
    save_file(tensors, checkpoint / SINGLE_FILE)
    with pytest.raises(WeightsError, match="_checkpoint_wrapped_module"):
        Pi0.load(str(checkpoint))


def write_index(checkpoint: Path, shard: str) -> None:
    names = dict.fromkeys(load_file(checkpoint / SINGLE_FILE), shard)
    (checkpoint / INDEX_FILE).write_text(json.dumps({"weight_map": names}), encoding="utf-8")


def test_two_sets_of_weights_are_refused_because_nothing_says_which_is_meant(checkpoint: Path) -> None:
    write_index(checkpoint, "model-00001-of-00001.safetensors")
    shutil.copy(checkpoint / SINGLE_FILE, checkpoint / "model-00001-of-00001.safetensors")
    for load in (read_weights, lambda folder: Pi0.load(str(folder))):
        with pytest.raises(WeightsError, match="two sets of weights"):
            load(checkpoint)


def test_an_index_that_lists_the_one_file_is_no_second_set(checkpoint: Path) -> None:
    write_index(checkpoint, SINGLE_FILE)
    assert read_weights(checkpoint).tensors
