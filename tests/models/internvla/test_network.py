from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from probe_kit.models.internvla import (
    InternVLAConfig,
    InternVLANetwork,
    Schedule,
    build_internvla,
    dino_pixels,
    find_config,
    full_size_internvla,
)
from probe_kit.models.qwen import QwenInputs, pack_inputs
from tests.support.internvla_checkpoints import config, network, vlm_values
from tests.support.qwen_checkpoints import ID


@pytest.fixture(scope="module")
def built() -> InternVLANetwork:
    return network()


def inputs(lengths: tuple[int, ...] = (9,)) -> QwenInputs:
    rng = torch.Generator().manual_seed(0)
    picture = [ID["<|vision_start|>"], *[ID["<|image_pad|>"]] * 4, ID["<|vision_end|>"]]
    text = [torch.randint(0, 250, (2 + length,), generator=rng).tolist() for length in lengths]
    rows = [[*words[:2], *picture, *words[2:]] for words in text]
    pixels = torch.randn(16 * len(rows), 3 * 2 * 14 * 14, generator=rng)
    grid = torch.tensor([[1, 4, 4]] * len(rows))
    return pack_inputs(rows, pixels, grid, ID["<|image_pad|>"], ID["<|endoftext|>"])


def views(batch: int) -> Tensor:
    return torch.randn(batch, 3, 56, 56, generator=torch.Generator().manual_seed(1))


@torch.inference_mode()
def test_padding_changes_the_condition_so_only_one_row_at_a_time_is_honest(built: InternVLANetwork) -> None:
    """The queries read padded positions too; this is why the family declares a batch of one."""
    both = inputs((9, 5))
    together = built.read(both, views(2))
    alone = QwenInputs(
        both.ids[1:, :13], both.mask[1:, :13], both.pixel_values[16:], both.grid[1:], both.image_token
    )
    assert int(both.mask[1].sum()) == 13
    assert (built.read(alone, views(2)[1:])[0] - together[1]).abs().max() > 1e-3
    whole = QwenInputs(both.ids[:1], both.mask[:1], both.pixel_values[:16], both.grid[:1], both.image_token)
    torch.testing.assert_close(built.read(whole, views(2)[:1])[0], together[0], rtol=0, atol=1e-5)


@torch.inference_mode()
def test_the_queries_read_the_chosen_states_and_the_last_is_normed(built: InternVLANetwork) -> None:
    kept: list[Tensor] = []
    handle = built.layer_qformer.register_forward_pre_hook(lambda _, given: kept.extend(given[0]))
    try:
        built.read(inputs(), views(1))
    finally:
        handle.remove()
    language = built.vlm.model.language_model
    states: list[Tensor] = []
    hooks = [layer.register_forward_hook(lambda _, __, out: states.append(out)) for layer in language.layers]
    built.read(inputs(), views(1))
    for hook in hooks:
        hook.remove()
    positions = inputs().ids.shape[1]
    assert [state.shape[1] for state in kept] == [positions + 16] * 2
    assert torch.equal(kept[0][:, :positions], states[2])
    assert torch.equal(kept[1][:, :positions], language.norm(states[3]))


@torch.inference_mode()
def test_both_towers_reach_the_condition(built: InternVLANetwork) -> None:
    plain = built.read(inputs(), views(1))
    assert (built.read(inputs(), views(1) + 0.5) - plain).abs().max() > 1e-3
    other = inputs()
    other.pixel_values[:] += 0.5
    assert (built.read(other, views(1)) - plain).abs().max() > 1e-3


def test_a_network_without_memory_has_its_rotary_frequencies() -> None:
    empty = build_internvla(config(), torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in empty.parameters())
    assert all(buffer.dtype == torch.float32 and not buffer.is_meta for buffer in empty.buffers())


@pytest.mark.parametrize("asked", [torch.float32, torch.bfloat16])
def test_every_part_has_the_precision_that_is_asked_for_whatever_the_files_say(asked: torch.dtype) -> None:
    stored = {"torch_dtype": "float16"}
    values = vlm_values() | stored
    values["text_config"] |= stored
    values["vision_config"] |= stored
    empty = build_internvla(config(values), asked, device="cpu")
    assert {parameter.dtype for parameter in empty.parameters()} == {asked}


@torch.inference_mode()
def test_bfloat16_runs_and_stays_near(built: InternVLANetwork) -> None:
    rounded = build_internvla(config(), torch.bfloat16)
    state = {name: tensor.to(torch.bfloat16) for name, tensor in built.state_dict().items()}
    rounded.load_state_dict(state, assign=True)
    noise = torch.randn(1, 4, 7, generator=torch.Generator().manual_seed(2))
    exact, near = (
        net.denoise(net.read(inputs(), views(1)), noise, Schedule.of(5, 100), 1.5) for net in (built, rounded)
    )
    assert near.dtype == torch.float32
    assert 0 < (exact - near).abs().max() < 1


def test_the_full_size_has_the_released_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in full_size_internvla().parameters()) == 3_872_703_111


@torch.inference_mode()
def test_the_golden_condition_and_actions_are_reproduced(golden_internvla: Path) -> None:
    with np.load(golden_internvla / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays.files}
    values, place = find_config(golden_internvla / "checkpoint")
    made = InternVLAConfig.from_values(values, values["qwen2_5_vl_config"], str(place))
    original = build_internvla(made, torch.float32)
    original.load_state_dict(load_file(golden_internvla / "checkpoint" / "model.safetensors"), assign=True)
    names = ("in_input_ids", "in_attention_mask", "in_pixel_values", "in_image_grid_thw")
    ids, mask, pixels, grid = (torch.from_numpy(recorded[name]) for name in names)
    read = QwenInputs(ids, mask, pixels, grid, made.vlm.image_token_id)
    pictures = recorded["in_images_uint8"].reshape(-1, *recorded["in_images_uint8"].shape[2:])
    seen = torch.stack([dino_pixels(picture, made.dino.side) for picture in pictures])
    assert torch.equal(seen, torch.from_numpy(recorded["in_dino_pixels"]))
    condition = original.read(read, seen)
    torch.testing.assert_close(condition, torch.from_numpy(recorded["condition"]), rtol=0, atol=1e-5)
    schedule = Schedule.of(len(recorded["ddim_timestep_map"]), made.head.steps, made.head.schedule)
    np.testing.assert_allclose(schedule.signal, recorded["ddim_alphas_cumprod"], rtol=1e-12)
    noise = torch.from_numpy(recorded["in_noise"])
    actions = original.denoise(condition, noise, schedule, float(recorded["cfg_scale"]))
    torch.testing.assert_close(actions, torch.from_numpy(recorded["actions"]), rtol=0, atol=2e-5)
