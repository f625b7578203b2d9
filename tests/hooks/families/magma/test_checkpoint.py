import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.hooks import Observation
from probe_kit.hooks.families.magma.adapter import load_magma
from probe_kit.models.magma import UNUSED_WEIGHTS, shipped_statistics
from tests.support.magma_checkpoints import (
    LAYER_SCALE,
    config_values,
    small_network,
    weights,
    write_checkpoint,
)


def renamed(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """As a loader that renames every gamma to weight saves it."""
    return {name.replace(".gamma", ".weight"): tensor for name, tensor in tensors.items()}


def test_a_head_that_is_tied_may_be_left_out_and_has_no_other_numbers(tmp_path: Path) -> None:
    tied = {**config_values()["text_config"], "tie_word_embeddings": True}
    network, head = small_network(text_config=tied), "language_model.lm_head.weight"
    tensors = {name: tensor.clone() for name, tensor in weights(network).items()}
    for name, stored in (
        ("both", tensors),
        ("one", {key: tensor for key, tensor in tensors.items() if key != head}),
    ):
        folder = write_checkpoint(tmp_path / name, tensors=stored, text_config=tied)
        loaded = load_magma(str(folder), unnorm_key="bridge_orig").loaded.network.state_dict()
        assert torch.equal(loaded[head], tensors[head])
    other = write_checkpoint(tmp_path / "other", tensors={**tensors, head: tensors[head] + 1}, text_config=tied)
    with pytest.raises(WeightsError, match=f"{head} differs from the tensor that config.json ties it to"):
        load_magma(str(other), unnorm_key="bridge_orig")


@pytest.mark.parametrize("shards", [1, 3])
def test_every_weight_comes_from_the_file(tmp_path: Path, shards: int) -> None:
    loaded = load_magma(str(write_checkpoint(tmp_path, shards=shards)), unnorm_key="bridge_orig").loaded
    expected = small_network(steered=True).state_dict()
    ours = loaded.network.state_dict()
    assert ours.keys() == expected.keys()
    assert all(torch.equal(ours[name], expected[name]) for name in expected)
    assert loaded.audit.tensors == len(expected)
    assert any("contrastive head" in note for note in loaded.notes)


def test_the_unread_head_may_be_missing_and_nothing_else(tmp_path: Path) -> None:
    tensors = weights(small_network(), head=False)
    assert not load_magma(
        str(write_checkpoint(tmp_path / "without", tensors=tensors)), unnorm_key="bridge_orig"
    ).loaded.notes
    for name in ("multi_modal_projector.row_seperator", "language_model.lm_head.weight", LAYER_SCALE):
        lacking = {other: tensor for other, tensor in tensors.items() if other != name}
        with pytest.raises(WeightsError, match=name):
            load_magma(str(write_checkpoint(tmp_path / name, tensors=lacking)), unnorm_key="bridge_orig")


def test_the_index_may_leave_the_unread_head_out_and_nothing_else(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path)
    index = folder / "model.safetensors.index.json"
    listed = json.loads(index.read_text(encoding="utf-8"))["weight_map"]
    pruned = {name: file for name, file in listed.items() if name not in UNUSED_WEIGHTS}
    index.write_text(json.dumps({"weight_map": pruned}), encoding="utf-8")
    load_magma(str(folder), unnorm_key="bridge_orig")
    index.write_text(
        json.dumps({"weight_map": {n: f for n, f in pruned.items() if n != LAYER_SCALE}}), encoding="utf-8"
    )
    with pytest.raises(WeightsError, match=LAYER_SCALE):
        load_magma(str(folder), unnorm_key="bridge_orig")


def test_layer_scales_named_weight_are_the_released_files_and_the_card_says_so(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path, tensors=renamed(weights(small_network())))
    loaded = load_magma(str(folder), unnorm_key="bridge_orig")
    assert torch.equal(loaded.network.state_dict()[LAYER_SCALE], small_network().state_dict()[LAYER_SCALE])
    assert "5 layer scales taken from tensors stored as .weight" in loaded.card.notes
    assert loaded.card.settings["layer_scale"] == "weight"
    with pytest.raises(WeightsError, match=r"5 layer scales .* as \.weight instead of .*layer_scale=gamma"):
        load_magma(str(folder), layer_scale="gamma", unnorm_key="bridge_orig")


def test_the_actions_of_a_file_do_not_depend_on_how_it_names_its_layer_scales(
    tmp_path: Path, observation: Observation
) -> None:
    tensors = weights(small_network(steered=True))
    folders = [
        write_checkpoint(tmp_path / name, tensors=stored)
        for name, stored in (("gamma", tensors), ("weight", renamed(tensors)))
    ]
    seen = [observation] * 2
    one, other = (
        load_magma(str(folder), prompt="act2answer", temperature=0.7, unnorm_key="bridge_orig").act(seen, [1, 2])
        for folder in folders
    )
    np.testing.assert_array_equal(one, other)


def test_a_layer_scale_under_both_names_is_damage(tmp_path: Path) -> None:
    tensors = weights(small_network())
    tensors[LAYER_SCALE.replace(".gamma", ".weight")] = tensors[LAYER_SCALE] * 2
    with pytest.raises(WeightsError, match="1 layer scales twice"):
        load_magma(str(write_checkpoint(tmp_path, tensors=tensors)), unnorm_key="bridge_orig")


@pytest.mark.parametrize("rename", [dict, renamed])
def test_one_constant_layer_scale_is_damage_under_either_name(
    tmp_path: Path, rename: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]
) -> None:
    tensors = weights(small_network())
    tensors[LAYER_SCALE] = torch.full_like(tensors[LAYER_SCALE], 1e-6)
    with pytest.raises(WeightsError, match=r"damaged checkpoint: .* 1 layer scales .*stages\.2\.blocks\.1"):
        load_magma(str(write_checkpoint(tmp_path, tensors=rename(tensors))), unnorm_key="bridge_orig")


def test_layer_scales_left_at_their_initial_value_are_damage(tmp_path: Path) -> None:
    """What the loader that dropped them saves under the right name."""
    tensors = weights(small_network())
    initial = {n: torch.full_like(t, 1e-6) if n.endswith(".gamma") else t for n, t in tensors.items()}
    with pytest.raises(WeightsError, match=r"damaged checkpoint: .* 5 layer scales .* 1e-06 in every feature"):
        load_magma(str(write_checkpoint(tmp_path, tensors=initial)), unnorm_key="bridge_orig")


def test_the_trunk_of_a_network_with_random_weights_does_something(tmp_path: Path) -> None:
    folder = str(write_checkpoint(tmp_path))
    twin = load_magma(folder, random_weights=True, unnorm_key="bridge_orig")
    assert float(twin.network.state_dict()[LAYER_SCALE].min()) == 1


def test_weights_are_as_the_file_says_or_as_asked(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path, torch_dtype="bfloat16")
    assert load_magma(str(folder), unnorm_key="bridge_orig").card.dtype == "bfloat16"
    wide = load_magma(str(folder), dtype="float32", unnorm_key="bridge_orig")
    assert {parameter.dtype for parameter in wide.network.parameters()} == {torch.float32}
    with pytest.raises(UsageError, match="float16"):
        load_magma(str(folder), dtype="float16", unnorm_key="bridge_orig")


def entry(scale: float) -> dict[str, list[float]]:
    return {"q01": [-scale] * 7, "q99": [scale] * 7, "mask": [True] * 6 + [False]}


def test_statistics_come_from_the_package_the_checkpoint_or_a_file_and_the_last_alone_counts(
    tmp_path: Path,
) -> None:
    folder = write_checkpoint(tmp_path / "model")
    ours = load_magma(str(folder), unnorm_key="bridge_orig").statistics
    assert ours.low.tolist() == shipped_statistics()["bridge_orig"]["action"]["q01"]
    (folder / "dataset_statistics.json").write_text(
        json.dumps({"bridge_orig": {"action": entry(2)}}), encoding="utf-8"
    )
    assert load_magma(str(folder), unnorm_key="bridge_orig").statistics.high[0] == 2
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"norm_stats": {"bridge_orig": entry(3), "mine": entry(4)}}), encoding="utf-8")
    assert load_magma(str(folder), statistics=str(file), unnorm_key="bridge_orig").statistics.high[0] == 3
    mine = load_magma(str(folder), statistics=str(file), unnorm_key="mine")
    assert (mine.statistics.key, mine.statistics.high[0]) == ("mine", 4)
    with pytest.raises(UsageError, match="Choose"):
        load_magma(str(folder), unnorm_key="fractal")
    with pytest.raises(CheckpointError, match="is missing"):
        load_magma(str(folder), statistics=str(tmp_path / "nowhere.json"), unnorm_key="bridge_orig")
