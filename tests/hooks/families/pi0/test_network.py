""""""

import json
from pathlib import Path

import pytest
import torch
from lerobot.policies.pi0 import modeling_pi0
from torch import Tensor

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.embedded import SIZE, _config
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.families.pi0.network import Pi0Size, build_pi0, current_pi0_keys
from probe_kit.models.building import initialise


def test_lerobots_module_is_left_as_found() -> None:
    before = dict(vars(modeling_pi0))
    build_pi0(_config(), SIZE)
    assert dict(vars(modeling_pi0)) == before


def test_the_policy_is_lerobots_own_class_in_eval_mode() -> None:
    policy = build_pi0(_config(), SIZE)
    assert type(policy) is modeling_pi0.PI0Policy
    assert not policy.training


@pytest.mark.slow
def test_a_seed_means_the_same_weights_every_time() -> None:
    first, second, other = (build_pi0(_config(), SIZE) for _ in range(3))
    for policy, seed in ((first, 1), (second, 1), (other, 2)):
        initialise(policy, seed)
    name = "model.state_proj.weight"
    assert all(torch.equal(tensor, second.state_dict()[key]) for key, tensor in first.state_dict().items())
    assert not torch.equal(first.state_dict()[name], other.state_dict()[name])


def test_an_incomplete_size_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dims.json").write_text(json.dumps({"vlm": {"width": 8}}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="does not describe pi0"):
        Pi0Size.from_file(tmp_path / "dims.json")


VLM = "model.paligemma_with_expert.paligemma"


def todays_keys() -> dict[str, Tensor]:
    return dict(build_pi0(_config(), SIZE).state_dict())


def test_todays_keys_stay_as_they_are() -> None:
    keys = todays_keys()
    assert current_pi0_keys(keys).keys() == keys.keys()


def test_the_layout_of_early_2025_is_brought_to_todays() -> None:
    def aged(name: str) -> str:
        for new, old in (
            (f"{VLM}.model.language_model.", f"{VLM}.language_model.model."),
            (f"{VLM}.lm_head.", f"{VLM}.language_model.lm_head."),
            (f"{VLM}.model.vision_tower.", f"{VLM}.vision_tower."),
            (f"{VLM}.model.multi_modal_projector.", f"{VLM}.multi_modal_projector."),
        ):
            name = name.replace(new, old)
        return name

    keys = todays_keys()
    old = {aged(name): tensor for name, tensor in keys.items()}
    old["normalize_inputs.buffer_observation_state.mean"] = torch.zeros(8)
    assert old.keys() != keys.keys()
    assert current_pi0_keys(old).keys() == keys.keys()


def test_openpi_names_gain_prefix_and_time_mlp_names() -> None:
    renamed = current_pi0_keys({"time_mlp_in.bias": torch.zeros(2), "state_proj.bias": torch.zeros(2)})
    assert renamed.keys() == {"model.action_time_mlp_in.bias", "model.state_proj.bias"}


def test_a_lone_lm_head_becomes_the_embedding_but_never_replaces_one() -> None:
    head, embedding = torch.ones(4, 2), torch.zeros(4, 2)
    name = f"{VLM}.model.language_model.embed_tokens.weight"
    assert torch.equal(Pi0.current_keys({f"{VLM}.lm_head.weight": head})[name], head)
    both = Pi0.current_keys({f"{VLM}.lm_head.weight": head, name: embedding})
    assert torch.equal(both[name], embedding)
