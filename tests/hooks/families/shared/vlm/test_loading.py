"""What a checkpoint of a vision-language model may and may not be."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.hooks import Prompt, load_model
from probe_kit.hooks.registry import find_family
from probe_kit.hooks.testing import example_observations
from tests.support.vlm_checkpoints import (
    write_internvl,
    write_ovis2_5,
    write_paligemma,
    write_qwen2_5_vl,
    write_qwen3_vl,
)


def test_files_under_the_names_of_todays_transformers_load_too(tmp_path: Path) -> None:
    folder = write_qwen2_5_vl(tmp_path)
    before = load_model("qwen2.5-vl", str(folder))
    save_file(
        {name: tensor.clone() for name, tensor in before.network.state_dict().items()},
        folder / "model.safetensors",
    )
    after = load_model("qwen2.5-vl", str(folder))
    state, other = before.network.state_dict(), after.network.state_dict()
    assert all(torch.equal(state[name], other[name]) for name in state)


def test_nothing_stays_on_the_meta_device(tmp_path: Path) -> None:
    for family, write in (
        ("qwen2.5-vl", write_qwen2_5_vl), ("qwen3-vl", write_qwen3_vl), ("internvl", write_internvl),
        ("paligemma", write_paligemma), ("ovis2.5", write_ovis2_5),
    ):  # fmt: skip
        network = load_model(family, str(write(tmp_path / family)), dtype="bfloat16").network
        assert not any(tensor.is_meta for tensor in (*network.parameters(), *network.buffers()))
        frequencies = [tensor for name, tensor in network.named_buffers() if "inv_freq" in name]
        assert frequencies
        assert {tensor.dtype for tensor in frequencies} == {torch.float32}


def test_the_larger_internvl_has_another_tower(tmp_path: Path) -> None:
    vlm = load_model("internvl", str(write_internvl(tmp_path, large=True)))
    names = {name.rpartition("encoder.layer.0.")[2] for name in vlm.network.state_dict()}
    assert "attention.q_norm.weight" in names
    assert "attention.q_proj.bias" not in names
    seen = example_observations(["Why?"])[0]
    reading = vlm.read([Prompt(seen, "Why?", ("A", "B"))])
    other = vlm.read([Prompt(replace(seen, image=255 - seen.image), "Why?", ("A", "B"))])
    assert np.abs(reading.option_logits - other.option_logits).max() > 0


def test_a_tied_tensor_that_the_file_holds_twice_must_be_equal(tmp_path: Path) -> None:
    folder = write_qwen3_vl(tmp_path, tied=True)
    tensors = load_file(folder / "model.safetensors")
    assert "lm_head.weight" not in tensors
    tensors["lm_head.weight"] = tensors["model.language_model.embed_tokens.weight"].clone()
    save_file(tensors, folder / "model.safetensors")
    load_model("qwen3-vl", str(folder))
    tensors["lm_head.weight"][0, 0] += 1
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(WeightsError, match="ties it"):
        load_model("qwen3-vl", str(folder))


def test_untied_output_weights_may_not_be_missing(tmp_path: Path) -> None:
    folder = write_qwen2_5_vl(tmp_path)
    tensors = load_file(folder / "model.safetensors")
    del tensors["lm_head.weight"]
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(WeightsError, match=r"lm_head\.weight"):
        load_model("qwen2.5-vl", str(folder))


def test_the_layout_of_internvls_own_code_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "internvl_chat"}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="-HF"):
        load_model("internvl", str(tmp_path))


def test_a_configuration_that_describes_no_network_is_refused(tmp_path: Path) -> None:
    folder = write_paligemma(tmp_path)
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    for damaged in (
        {**values, "text_config": 3},
        {**values, "vision_config": {**values["vision_config"], "patch_size": 0}},
    ):
        (folder / "config.json").write_text(json.dumps(damaged), encoding="utf-8")
        with pytest.raises(CheckpointError, match="describes no network"):
            load_model("paligemma", str(folder))


def test_a_size_stands_for_a_checkpoint(tmp_path: Path) -> None:
    family = find_family("qwen3-vl")
    assert family.location(None, "4B") == "Qwen/Qwen3-VL-4B-Instruct"
    assert family.location(None) == family.default_checkpoint == "Qwen/Qwen3-VL-8B-Instruct"
    with pytest.raises(UsageError, match="leave one of them out"):
        load_model("qwen3-vl", str(write_qwen3_vl(tmp_path)), size="4B")
    with pytest.raises(UsageError, match="expected one of 8B, 32B, 4B"):
        load_model("qwen3-vl", size="5B")


def test_two_pictures_of_different_size_go_together(tmp_path: Path) -> None:
    """Positions come from each row's own mask and picture."""
    vlm = load_model("qwen3-vl", str(write_qwen3_vl(tmp_path)))
    small, large = example_observations(["Why?", "Why not?"])
    large = replace(large, image=np.tile(large.image, (3, 2, 1)))
    asked = [Prompt(own, own.instruction, ("A", "B")) for own in (small, large)]
    together = vlm.read(asked)
    alone = [vlm.read([question]).option_logits[0] for question in asked]
    np.testing.assert_allclose(together.option_logits, alone, atol=1e-5)
    assert vlm.speak(together, 5) == [vlm.speak(vlm.read([question]), 5)[0] for question in asked]


@pytest.mark.parametrize(
    "vision", [{"fullatt_block_indexes": [1]}, {"use_rope": False}, {"hidden_act": "gelu"}, {"hidden_size": 36}]
)
def test_towers_that_no_released_ovis_has_are_refused(vision: dict[str, object], tmp_path: Path) -> None:
    folder = write_ovis2_5(tmp_path)
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    values["vit_config"] |= vision
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(CheckpointError, match="vit_config"):
        load_model("ovis2.5", str(folder))
