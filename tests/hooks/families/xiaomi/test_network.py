""""""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.shared.qwen.network import QwenInputs, pack_inputs
from probe_kit.hooks.families.xiaomi.network import (
    XiaomiConfig,
    XiaomiNetwork,
    build_xiaomi,
    look,
    prompt,
    read_units,
    robot_of,
)
from probe_kit.models.building import initialise
from tests.hooks.families.xiaomi.checkpoints import NUMBERS, action_config, config_values
from tests.support.qwen_checkpoints import ID


def test_sizes_come_from_the_file() -> None:
    config = XiaomiConfig.from_json(config_values())
    assert (config.flow.layers, config.flow.width) == (2, 64)


def test_without_dit_config_the_released_size_is_meant() -> None:
    text = config_values()["vlm_config"]["text_config"] | {
        "num_hidden_layers": 16, "num_key_value_heads": 8, "head_dim": 128,
    }  # fmt: skip
    vlm = config_values()["vlm_config"] | {"text_config": text}
    flow = XiaomiConfig.from_json(config_values(vlm_config=vlm, dit_config=None)).flow
    assert (flow.layers, flow.width, flow.head_dim, flow.cached_heads) == (16, 1024, 128, 8)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"head_dim": 8}, "head_dim 8, the VLM's cache has 16"),
        ({"num_key_value_heads": 4}, "num_key_value_heads 4, the VLM's cache has 2"),
        ({"num_hidden_layers": 5}, "5 layers, the VLM has only 4"),
        ({"hidden_size": 40}, "hidden_size 40"),
    ],
)
def test_a_flow_transformer_that_cannot_read_the_cache_is_refused(change: dict[str, int], reason: str) -> None:
    flow = config_values()["dit_config"] | change
    with pytest.raises(CheckpointError, match=reason):
        XiaomiConfig.from_json(config_values(dit_config=flow))


def test_another_models_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="'openvla'"):
        XiaomiConfig.from_json(config_values(model_type="openvla"))
    with pytest.raises(CheckpointError, match="missing"):
        XiaomiConfig.from_folder(tmp_path)
    values = config_values()
    del values["state_dim"]
    with pytest.raises(CheckpointError, match="state_dim"):
        XiaomiConfig.from_json(values)


STEPS, ACTIONS = 3, 4


@pytest.fixture(scope="module")
def network() -> XiaomiNetwork:
    built = build_xiaomi(XiaomiConfig.from_json(config_values()), torch.float32, device="cpu")
    initialise(built, seed=1)
    return built


def inputs(lengths: tuple[int, ...] = (9, 6)) -> QwenInputs:
    """Prompts of some text, one picture of two by two tokens, and more text."""
    rng = torch.Generator().manual_seed(0)
    picture = [ID["<|vision_start|>"], *[ID["<|image_pad|>"]] * 4, ID["<|vision_end|>"]]
    words = [
        [torch.randint(0, 250, (count,), generator=rng).tolist() for count in (2, length)] for length in lengths
    ]
    rows = [[*before, *picture, *behind] for before, behind in words]
    pixels = torch.randn(16 * len(rows), 3 * 2 * 16 * 16, generator=rng)
    return pack_inputs(
        rows, pixels, torch.tensor([[1, 4, 4]] * len(rows)), ID["<|image_pad|>"], ID["<|endoftext|>"]
    )


def scene(batch: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """State, which numbers are used, noise."""
    rng = torch.Generator().manual_seed(1)
    used = torch.zeros(batch, ACTIONS, NUMBERS)
    used[..., :7] = 1
    state = torch.randn(batch, 1, NUMBERS, generator=rng)
    return state, used, torch.randn(batch, ACTIONS, NUMBERS, generator=rng)


@torch.inference_mode()
def test_a_batch_with_padding_equals_its_rows_one_by_one(network: XiaomiNetwork) -> None:
    state, used, noise = scene()
    together = network(inputs(), state, used, noise, STEPS)
    both = inputs()
    for row in range(2):
        length = int(both.mask[row].sum())
        alone = QwenInputs(
            both.ids[row : row + 1, :length],
            both.mask[row : row + 1, :length],
            both.pixel_values[16 * row : 16 * row + 16],
            both.grid[row : row + 1],
            both.image_token,
        )
        row_slice = slice(row, row + 1)
        torch.testing.assert_close(
            network(alone, state[row_slice], used[row_slice], noise[row_slice], STEPS)[0],
            together[row],
            rtol=0,
            atol=1e-5,
        )


@torch.inference_mode()
def test_euler_steps_go_from_noise_at_nought_and_nothing_is_kept_between_calls(network: XiaomiNetwork) -> None:
    state, used, noise = scene()
    prompt = network.read(inputs())
    path = noise
    for moment in (0.0, 0.5):
        path = path + network.velocity(prompt, state, path * used, torch.full((2,), moment)) / 2
    network(inputs((20, 3)), state, used, noise, 1)
    torch.testing.assert_close(network(inputs(), state, used, noise, 2), path, rtol=0, atol=1e-6)
    assert network.vlm.model.rope_deltas is None


@torch.inference_mode()
def test_unused_numbers_are_not_read_but_are_put_out(network: XiaomiNetwork) -> None:
    state, used, noise = scene()
    other = noise.clone()
    other[..., 7:] += 1
    plain, changed = (network(inputs(), state, used, start, STEPS) for start in (noise, other))
    torch.testing.assert_close(plain[..., :7], changed[..., :7], rtol=0, atol=1e-6)
    torch.testing.assert_close(plain[..., 7:] + 1, changed[..., 7:], rtol=0, atol=1e-5)


@torch.inference_mode()
def test_an_action_sees_the_ones_before_it_and_no_later_one(network: XiaomiNetwork) -> None:
    state, used, noise = scene()
    prompt, moment = network.read(inputs()), torch.zeros(2)
    plain = network.velocity(prompt, state, noise * used, moment)
    changed = noise.clone()
    changed[:, 2] += 1
    other = network.velocity(prompt, state, changed * used, moment)
    assert torch.equal(plain[:, :2], other[:, :2])
    assert (plain[:, 3] - other[:, 3]).abs().max() > 1e-3


@torch.inference_mode()
def test_only_the_last_layers_of_the_prompt_are_read(network: XiaomiNetwork) -> None:
    assert len(network.read(inputs()).caches) == 2
    layers = network.vlm.model.language_model.layers
    caches = network.read(inputs()).caches
    assert len(layers) == 4
    for cache, number in zip(caches, (2, 3), strict=True):
        full_cache = network.vlm.model(**inputs().keywords(network.vlm.model), use_cache=True).past_key_values
        assert torch.equal(cache[0], full_cache.layers[number].keys)


def test_a_network_without_memory_has_its_rotary_frequencies() -> None:
    built = build_xiaomi(XiaomiConfig.from_json(config_values()), torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in built.parameters())
    assert all(buffer.dtype == torch.float32 and not buffer.is_meta for buffer in built.buffers())
    assert len(list(built.buffers())) == 3
    assert torch.get_default_dtype() == torch.float32


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_part_has_the_precision_that_is_asked_for_whatever_the_files_say(dtype: torch.dtype) -> None:
    vlm = config_values()["vlm_config"] | {"dtype": "float16"}
    vlm["text_config"]["torch_dtype"] = vlm["vision_config"]["dtype"] = "float16"
    built = build_xiaomi(XiaomiConfig.from_json(config_values(vlm_config=vlm)), dtype, device="cpu")
    assert {parameter.dtype for parameter in built.parameters()} == {dtype}


@torch.inference_mode()
def test_bfloat16_runs_and_stays_near(network: XiaomiNetwork) -> None:
    rounded = build_xiaomi(XiaomiConfig.from_json(config_values()), torch.bfloat16)
    state = {name: tensor.to(torch.bfloat16) for name, tensor in network.state_dict().items()}
    rounded.load_state_dict(state, assign=True)
    exact, near = (net(inputs(), *scene(), STEPS) for net in (network, rounded))
    assert near.dtype == torch.float32
    assert 0 < (exact - near).abs().max() < 0.5


def write(folder: Path, content: dict[str, Any]) -> Path:
    (folder / "preprocessor_config.json").write_text(json.dumps({"action_config": content}), encoding="utf-8")
    return folder


def test_the_beginning_of_one_name_is_enough_and_the_file_gives_the_chunk_its_length(tmp_path: Path) -> None:
    folder = write(tmp_path, action_config())
    units = read_units(folder, "bridge", NUMBERS)
    assert (units.robot, units.mean.shape) == ("bridge_delta", (4, NUMBERS))
    assert read_units(folder, "libero", NUMBERS).mean.shape == (10, NUMBERS)
    assert read_units(folder, "fractal_delta", NUMBERS).sha256 != units.sha256


def test_the_only_robot_needs_no_name(tmp_path: Path) -> None:
    assert read_units(write(tmp_path, action_config({"mine": 2})), None, NUMBERS).robot == "mine"


def test_numbers_the_robot_does_not_have_are_masked(tmp_path: Path) -> None:
    used = read_units(write(tmp_path, action_config()), "bridge", NUMBERS).used
    assert used[:, :7].all()
    assert not used[:, 7:].any()


def test_actions_are_restored_step_by_step(tmp_path: Path) -> None:
    units = read_units(write(tmp_path, action_config()), "bridge", NUMBERS)
    ones = np.ones((1, 4, NUMBERS), np.float32)
    np.testing.assert_allclose(units.restore(ones)[0], units.mean + units.deviation)


def test_an_unknown_or_ambiguous_robot_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    folder = write(tmp_path, action_config({"calvin_abc_orig": 2, "calvin_abcd_orig": 2}))
    for name in ("widowx", "calvin_abc", None):
        with pytest.raises(UsageError, match="calvin_abc_orig, calvin_abcd_orig"):
            read_units(folder, name, NUMBERS)


def test_statistics_that_do_not_fit_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="action_config"):
        read_units(write(tmp_path, {}), None, NUMBERS)
    with pytest.raises(CheckpointError, match=r"\(steps, 31\)"):
        read_units(write(tmp_path, action_config()), "bridge", 31)
    content = action_config()
    content["bridge_delta"]["std"][0][0] = float("nan")
    with pytest.raises(CheckpointError, match="finite"):
        read_units(write(tmp_path, content), "bridge", NUMBERS)


def test_the_prompt_is_the_released_one_to_the_letter() -> None:
    assert prompt("put the cube on the star", "Base View") == (
        "<|im_start|>user\nThe following observations are captured from multiple views.\n"
        "# Base View\n<|vision_start|><|image_pad|><|vision_end|>\n"
        "Generate robot actions for the task:\nPut the cube on the star. /no_cot<|im_end|>\n"
        "<|im_start|>assistant\n<cot></cot><|im_end|>\n"
    )


def test_only_the_first_letter_changes_and_no_stop_is_doubled() -> None:
    assert "\nPut it on Mr. X's A. /no_cot" in prompt("put it on Mr. X's A.", "Base View")
    assert "\nWhich one? /no_cot" in prompt("which one?", "Base View")


@pytest.mark.parametrize(("robot", "shape"), [("bridge_delta", (256, 256, 3)), ("fractal_delta", (256, 320, 3))])
def test_the_rim_is_cut_off_and_the_size_kept(robot: str, shape: tuple[int, ...]) -> None:
    inside = np.full(shape, 90, np.uint8)
    inside[:4], inside[-4:], inside[:, :4], inside[:, -4:] = 255, 255, 255, 255
    model_picture = look(inside, robot_of(robot))
    assert model_picture.shape == shape
    assert (model_picture == 90).all()


def test_a_whole_frame_is_squeezed_not_cut() -> None:
    frame = np.zeros((480, 640, 3), np.uint8)
    frame[:, 320:] = 200
    model_picture = look(frame, robot_of("bridge_delta"))
    assert model_picture[:, :120].max() == 0
    assert model_picture[:, 136:].min() == 200


def test_the_states_of_the_two_robots() -> None:
    state = np.array([0.3, 0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.75], np.float32)
    np.testing.assert_array_equal(robot_of("bridge_delta").state(state), state)
    half = np.sqrt(0.5)
    fractal = robot_of("fractal_delta").state(state)
    np.testing.assert_allclose(fractal, [0.3, 0.1, 0.2, 0.0, half, 0.0, half, 0.25], atol=1e-6)
    assert fractal.dtype == np.float32


def test_a_robot_with_other_cameras_is_refused() -> None:
    with pytest.raises(UsageError, match="libero_all"):
        robot_of("libero_all")
