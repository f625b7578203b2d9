""""""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import Module

from probe_kit.errors import CheckpointError, InstructionError, UsageError, WeightsError
from probe_kit.hooks import Observation, Site, capture, edit, load_policy
from probe_kit.hooks.families.xiaomi.adapter import Xiaomi, load_xiaomi
from tests.hooks.families.xiaomi.checkpoints import config_values, write_checkpoint
from tests.support.qwen_checkpoints import ID


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("xiaomi"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Xiaomi:
    return load_xiaomi(str(folder), robot="bridge_delta")


def test_only_the_last_blocks_memory_is_read(loaded: Xiaomi, observation: Observation) -> None:
    """As many as the flow transformer has layers; those before are a control."""
    assert loaded.prompt_kv is not None
    plain, read = loaded.act([observation], [0]), len(loaded.network.dit.layers)
    for site in loaded.prompt_kv.sites("values"):
        with edit(loaded, {site: torch.zeros_like}):
            moved = np.abs(loaded.act([observation], [0]) - plain).max()
        assert (moved > 0) == (site.layer >= loaded.prompt_kv.layers - 1 - read), str(site)


def test_the_vision_stream_has_a_row_per_picture_of_the_inputs(loaded: Xiaomi, observation: Observation) -> None:
    """Qwen's tower runs over the patches of all pictures at once, whichever policy calls it."""
    site = Site("vision", 1)
    for count in (2, 3):
        with capture(loaded, [site]) as activations:
            loaded.act([observation] * count, range(count))
        assert len(activations[site]) == count


# -- captured sites ------------------------------------------------------------------------------------------


def test_the_experts_quantities_are_what_its_layers_compute(loaded: Xiaomi, observation: Observation) -> None:
    """Norm of (residual + attention) is the middle; norm of (middle + mlp) enters the next layer."""
    expert = loaded.streams["expert"]
    with capture(loaded, [site for kind in expert.quantities for site in expert.sites(kind)]) as activations:
        loaded.act([observation], [0])
    for step in range(5):
        for number, layer in enumerate(loaded.network.dit.layers):
            at = {kind: activations[Site("expert", number, kind, step)] for kind in expert.quantities}
            middle = _apply(layer, "middle_layernorm", at["residual"] + at["attention"])
            torch.testing.assert_close(middle, at["middle"], rtol=0, atol=1e-6)
            after = _apply(layer, "final_layernorm", middle + at["mlp"])
            torch.testing.assert_close(
                after, activations[Site("expert", number + 1, "residual", step)], rtol=0, atol=1e-6
            )
            if number:
                assert (at["residual"] + at["attention"] + at["mlp"] - after).abs().max() > 1e-2


@torch.inference_mode()
def _apply(layer: Module, norm: str, value: torch.Tensor) -> torch.Tensor:
    normed: torch.Tensor = getattr(layer, norm)(value)
    return normed


def test_deepstack_reaches_the_backbone_between_layers_at_the_picture_only(
    loaded: Xiaomi, observation: Observation
) -> None:
    """What enters a layer is more than the layer before put out: the vision tower's earlier blocks are added."""
    quantities = ("residual", "attention", "mlp")
    backbone = loaded.streams["backbone"]
    with capture(loaded, [site for kind in quantities for site in backbone.sites(kind)]) as activations:
        loaded.act([observation], [0])
    picture = torch.from_numpy(loaded.roles([observation])["backbone"][0].mask("image"))
    for layer in range(4):
        put_out = sum(activations[Site("backbone", layer, kind)] for kind in quantities)
        added = (activations[Site("backbone", layer + 1)] - put_out)[0].abs().amax(dim=-1)
        assert added[~picture].max() < 1e-5
        assert (added[picture].max() > 1e-2) == (layer < 2)


def test_roles_follow_the_pictures_size_and_the_chat(loaded: Xiaomi, observation: Observation) -> None:
    roles = loaded.roles([observation, replace(observation, instruction="Put the cube on the very red shape")])
    first, second = roles["backbone"]
    assert len(first) == len(second)
    assert first.mask("image.primary").sum() == 64
    assert first.mask("padding").sum() == 5
    assert first.mask("special").sum() == 6
    assert [span.role for span in roles["expert"][0].spans] == ["special", "state", "action"]
    assert len(roles["expert"][0]) == 2 + 4
    model_inputs = loaded.inputs([observation])
    assert (model_inputs.ids == ID["<|image_pad|>"]).sum() == 64


def test_the_vision_tower_is_read_picture_by_picture(loaded: Xiaomi, observation: Observation) -> None:
    sites = [Site("vision", 0), Site("vision", 3)]
    dark = replace(observation, image=observation.image // 2)
    with capture(loaded, sites) as together:
        loaded.act([observation, dark], [0, 1])
    with capture(loaded, sites) as alone:
        loaded.act([dark], [1])
    assert together[sites[1]].shape == (2, 256, 32)
    torch.testing.assert_close(together[sites[1]][1], alone[sites[1]][0], rtol=0, atol=1e-5)


# -- acting ----------------------------------------------------------------------------------------------------


def test_actions_are_in_the_units_of_the_robot(loaded: Xiaomi, observation: Observation) -> None:
    actions = loaded.act([observation], [0])
    assert actions.shape == (1, 4, 7)
    assert set(np.unique(actions[..., 6])) <= {0.0, 1.0}
    assert np.abs(actions[..., :6]).max() < 0.5
    assert loaded.card.chunk == loaded.card.execute == 4


def test_another_robot_is_another_chunk_and_another_run(folder: Path, loaded: Xiaomi) -> None:
    fractal = load_policy("xiaomi-r0", str(folder), robot="fractal")
    assert (fractal.card.chunk, fractal.card.execute) == (3, 3)
    assert fractal.card.settings["robot"] == "fractal_delta"
    assert fractal.card.settings["action_statistics"] != loaded.card.settings["action_statistics"]
    with pytest.raises(UsageError, match="bridge_delta, fractal_delta, libero_all"):
        load_xiaomi(str(folder), robot="aloha")


def test_a_robot_this_arm_cannot_stand_in_for_does_not_act(folder: Path, observation: Observation) -> None:
    policy = load_xiaomi(str(folder), robot="libero_all")
    with pytest.raises(UsageError, match="other cameras"):
        policy.act([observation], [0])


def test_a_checkpoint_without_statistics_says_so_and_refuses_to_act(
    folder: Path, tmp_path: Path, observation: Observation
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    file = copy / "preprocessor_config.json"
    file.write_text(
        json.dumps({**json.loads(file.read_text(encoding="utf-8")), "action_config": {}}), encoding="utf-8"
    )
    policy = load_xiaomi(str(copy))
    assert "cannot act" in policy.card.notes[0]
    assert policy.card.chunk == 30
    with pytest.raises(CheckpointError, match="action_config"):
        policy.act([observation], [0])


def test_without_its_processor_files_the_missing_ones_are_named(
    folder: Path, tmp_path: Path, observation: Observation
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / "tokenizer.json").unlink()
    policy = load_xiaomi(str(copy), robot="bridge_delta")
    with pytest.raises(CheckpointError, match=r"tokenizer\.json is missing"):
        policy.act([observation], [0])
    elsewhere = load_xiaomi(str(copy), tokenizer=str(folder), robot="bridge_delta")
    assert np.isfinite(elsewhere.act([observation], [0])).all()
    assert "file tokenizer/tokenizer.json" in elsewhere.card.settings


def test_a_tokenizer_of_another_checkpoint_is_refused(tmp_path: Path, observation: Observation) -> None:
    vlm = config_values()["vlm_config"]
    vlm["text_config"]["vocab_size"] = ID["<|im_start|>"]
    policy = load_xiaomi(str(write_checkpoint(tmp_path, vlm_config=vlm)), robot="bridge_delta")
    with pytest.raises(CheckpointError, match="another checkpoint"):
        policy.act([observation], [0])


def test_a_prompt_longer_than_the_model_reads_is_an_error(loaded: Xiaomi, observation: Observation) -> None:
    with pytest.raises(InstructionError, match="positions"):
        loaded.act([replace(observation, instruction="go " * 2000)], [0])


# -- loading ---------------------------------------------------------------------------------------------------


def test_a_missing_tensor_is_refused_and_a_tied_one_may_be_left_out(folder: Path, tmp_path: Path) -> None:
    assert list(load_xiaomi(str(folder), robot="bridge_delta").card.audit["allowed_missing"]) == [
        "vlm.lm_head.weight"
    ]
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    values["dit_config"]["num_hidden_layers"] = 3
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / "config.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(WeightsError, match=r"missing.*dit\.layers\.2"):
        load_xiaomi(str(copy), robot="bridge_delta")


def test_bfloat16_is_the_files_weights_rounded_and_acts(folder: Path, observation: Observation) -> None:
    policy = load_xiaomi(str(folder), dtype="bfloat16", robot="bridge_delta")
    assert policy.card.dtype == "bfloat16"
    assert np.isfinite(policy.act([observation], [0])).all()


def test_no_step_is_refused(folder: Path) -> None:
    with pytest.raises(UsageError, match="0 Euler steps"):
        load_xiaomi(str(folder), steps=0, robot="bridge_delta")


def test_the_releases_openness_is_one_minus_the_fingers_in_metres(folder: Path, observation: Observation) -> None:
    loaded, released = (
        load_xiaomi(str(folder), robot="bridge_delta"),
        load_xiaomi(str(folder), openness="release", robot="bridge_delta"),
    )
    measured, released_state = (policy.state([observation])[0, 0].numpy() for policy in (loaded, released))
    assert measured[7] == 1.0
    assert released_state[7] == pytest.approx(1 - 0.037)
    np.testing.assert_array_equal(measured[:7], released_state[:7])
