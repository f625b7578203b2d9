"""The embedded default: small enough to ship, and it knows what its model card says."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from probe_kit.env import SceneSpec
from probe_kit.extract import AskSettings, ExtractSettings, extract_run
from probe_kit.extract.protocols import scene_of
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.registry import own_families
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.models.embedded.tiny import ACTION_DIMS
from probe_kit.suite import build_suite

NAMES = ("pi0-tiny", "pi0-tiny-early", "pi0-tiny-state")
VLM = "vlm-tiny"


def test_vlm_and_policy_are_small_and_so_is_all_that_comes_with_the_package() -> None:
    sizes = {
        folder.name: file_size(folder.name)
        for folder in embedded_checkpoint(VLM).parent.iterdir()
        if folder.is_dir()
    }
    assert sizes[VLM] + sizes["pi0-tiny"] < 8_000_000
    assert sum(sizes.values()) < 10_000_000


def file_size(name: str) -> int:
    return (embedded_checkpoint(name) / "model.safetensors").stat().st_size


@pytest.mark.parametrize("name", NAMES)
def test_the_weights_say_how_they_were_made(name: str) -> None:
    path = embedded_checkpoint(name) / "model.safetensors"
    with safe_open(path, "pt") as file:
        assert VLM in file.metadata()["probe_kit.weights"]
        assert all(torch.isfinite(file.get_tensor(key)).all() for key in file.keys())  # noqa: SIM118


def test_the_policy_begins_as_the_vlm_and_is_another_afterwards() -> None:
    """Weight by weight, as far as float16 holds them; an expert beside it that the VLM has not."""
    vlm = weights_of(VLM)
    start, policy = (backbone(weights_of(name)) for name in ("pi0-tiny-early", "pi0-tiny"))
    assert start.keys() - {"lm_head.weight"} == vlm.keys() == policy.keys() - {"lm_head.weight"}
    for name, tensor in vlm.items():
        torch.testing.assert_close(start[name].float(), tensor.half().float(), rtol=0, atol=0)
    assert any((policy[name] - tensor).abs().max() > 0.01 for name, tensor in vlm.items())


def weights_of(name: str) -> dict[str, torch.Tensor]:
    return dict(load_file(embedded_checkpoint(name) / "model.safetensors"))


def backbone(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    prefix = "model.paligemma_with_expert.paligemma."
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


@pytest.mark.parametrize("name", [*NAMES, VLM])
def test_an_embedded_model_is_at_home_where_it_was_trained(name: str) -> None:
    home = SceneSpec.preset("act2answer", early_stop=True, max_steps=40)
    assert (AskSettings if name == VLM else ExtractSettings)(name).scene == home
    assert scene_of(name) == home
    assert scene_of(name, tile_side=0.2) == replace(home, tile_side=0.2)
    assert scene_of(name, name="bridge", max_steps=3) == SceneSpec(max_steps=3)


def test_all_other_families_play_the_released_scene_and_scripts_the_default_one() -> None:
    """A VLM and a policy of one study get the same first frames without an option."""
    released = SceneSpec.preset("act2answer")
    assert (released.arm, released.max_steps, released.start_grasped) == ("widowx", 80, True)
    for name in own_families().keys() - {*NAMES, VLM}:
        assert (scene_of(name), ExtractSettings(name).scene, AskSettings(name).scene) == (released,) * 3
    assert {scene_of(name) for name in ("expert", "idle", "unknown")} == {SceneSpec()}


def test_the_hand_never_turns(pi0_tiny: Pi0) -> None:
    turning = [dimension for dimension in range(7) if dimension not in ACTION_DIMS]
    assert not pi0_tiny.action_units.high[turning].any()
    assert not pi0_tiny.action_units.low[turning].any()


@pytest.mark.slow
def test_color_and_shape_are_answered_far_above_chance(tmp_path: Path) -> None:
    """In 32 episodes that a rate of 0.9 makes rarer than once in a thousand; guessing is at one half."""
    suite = build_suite(tmp_path / "suite", ["color", "shape"], 8)
    run = extract_run(ExtractSettings("pi0-tiny", suite=suite.folder), tmp_path / "run")
    assert run.episodes["is_success"].mean() >= 0.72
    assert (run.episodes["outcome"] == "wrong").mean() <= 0.25
    assert run.episodes["steps"].median() < 40
