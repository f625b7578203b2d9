""""""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from torch import Tensor
from transformers import Dinov2Config, Dinov2Model

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.internvla.network import (
    DinoConfig,
    DinoV2,
    InternVLAConfig,
    InternVLANetwork,
    Schedule,
    build_internvla,
    dino_pixels,
    find_config,
    look,
    prompt,
)
from probe_kit.hooks.families.shared.qwen.network import QwenInputs, pack_inputs
from probe_kit.models.building import initialise
from tests.hooks.families.internvla.checkpoints import COT, config, dims_values, network, run_values, vlm_values
from tests.support.qwen_checkpoints import ID


def configuration(**framework: Any) -> InternVLAConfig:
    """Without the file of other sizes: what the names of the run's file mean."""
    return InternVLAConfig.from_values(run_values(**framework), vlm_values(), "test")


def test_the_names_of_the_runs_file_mean_the_released_sizes() -> None:
    built = configuration()
    assert (built.dino.width, built.dino.blocks, built.dino.heads, built.dino.patch, built.dino.side) == (
        384, 12, 6, 14, 224,
    )  # fmt: skip
    assert (built.head.width, built.head.blocks, built.head.heads) == (768, 12, 12)
    assert (built.head.length, built.query.heads) == (4, 8)
    assert (built.cot, built.picture) == (COT, (224, 224))


def test_the_file_of_sizes_wins_over_the_names() -> None:
    built = config()
    assert (built.dino.width, built.dino.trained_side, built.dino.side) == (24, 70, 56)
    assert (built.head.width, built.head.heads, built.query.heads) == (32, 4, 4)


def test_the_spelling_of_the_released_file_and_the_right_one_are_read() -> None:
    right = dict(run_values()["framework"]["layer_qformer"])
    right["output_dim"] = right.pop("ouptput_dim")
    assert config(layer_qformer=right) == config()
    del right["output_dim"]
    with pytest.raises(CheckpointError, match="ouptput_dim"):
        config(layer_qformer=right)


@pytest.mark.parametrize(
    ("field", "change", "reason"),
    [
        ("framework_py", "QwenGR00T", "'QwenGR00T'"),
        ("dino", {"dino_backbone": "dinov3_vits16"}, "dinov3_vits16"),
        ("action_model", {"action_model_type": "DiT-XL"}, "DiT-XL"),
        ("action_model", {"past_action_window_size": 2}, "past_action_window_size is 2"),
        ("layer_qformer", {"input_dim": 64}, "reads width 64"),
        ("layer_qformer", {"qformer_end_layer": 9}, "hidden states 3 to 9"),
        ("layer_qformer", {"ouptput_dim": 30}, "width 30 and 8 heads"),
    ],
)
def test_what_does_not_fit_is_refused(field: str, change: Any, reason: str) -> None:
    before = run_values()["framework"][field]
    with pytest.raises(CheckpointError, match=reason):
        configuration(**{field: {**before, **change} if isinstance(change, dict) else change})


def test_the_files_are_found_beside_the_weights_or_one_folder_up(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"config\.yaml or config\.json of a run is missing"):
        find_config(tmp_path / "checkpoints")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(run_values()), encoding="utf-8")
    (tmp_path / "dims.json").write_text(json.dumps(dims_values()), encoding="utf-8")
    for folder in (tmp_path, tmp_path / "checkpoints"):
        values, config_folder = find_config(folder)
        assert config_folder == tmp_path
        assert values["qformer_heads"] == 4
        assert values["framework"]["layer_qformer"]["num_query_tokens"] == 6
    (tmp_path / "config.yaml").write_text("a: [", encoding="utf-8")
    with pytest.raises(CheckpointError, match="cannot be read"):
        find_config(tmp_path)


@pytest.fixture(scope="module")
def diffusing() -> InternVLANetwork:
    return network()


@pytest.mark.parametrize(("steps", "moments"), [(5, [0, 20, 40, 60, 80]), (10, list(range(0, 100, 10)))])
def test_steps_lie_at_a_whole_distance(steps: int, moments: list[int]) -> None:
    schedule = Schedule.of(steps, 100)
    assert schedule.moments.tolist() == moments
    assert len(schedule) == steps


def test_the_signal_falls_as_a_squared_cosine() -> None:
    signal = Schedule.of(100, 100).signal
    share = (np.arange(1, 101) / 100 + 0.008) / 1.008
    np.testing.assert_allclose(
        signal[:90], np.cos(share[:90] * np.pi / 2) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2
    )
    assert (np.diff(signal) < 0).all()


def test_a_number_of_steps_without_a_whole_distance_is_refused() -> None:
    with pytest.raises(UsageError, match="60 DDIM steps"):
        Schedule.of(60, 100)
    with pytest.raises(CheckpointError, match="linear"):
        Schedule.of(5, 100, "linear")


def test_true_noise_leads_back_to_the_signal_it_was_added_to() -> None:
    schedule = Schedule.of(5, 100)
    clean, noise = torch.randn(2, 4, 7), torch.randn(2, 4, 7)
    path = schedule.signal[-1] ** 0.5 * clean + (1 - schedule.signal[-1]) ** 0.5 * noise
    for index in reversed(range(5)):
        path = schedule.back(index, path, noise)
    torch.testing.assert_close(path, clean, rtol=0, atol=1e-4)


def rows_of(
    diffusing: InternVLANetwork, condition: Tensor, noise: Tensor, scale: float
) -> tuple[Tensor, list[int]]:
    row_counts: list[int] = []
    handle = diffusing.head.register_forward_pre_hook(lambda _, arguments: row_counts.append(len(arguments[0])))
    try:
        return diffusing.denoise(condition, noise, Schedule.of(5, 100), scale), row_counts
    finally:
        handle.remove()


@torch.inference_mode()
def test_guidance_runs_both_halves_and_mixes_them(diffusing: InternVLANetwork) -> None:
    condition, noise = torch.randn(2, 6, 32), torch.randn(2, 4, 7)
    mixed, row_counts = rows_of(diffusing, condition, noise, 1.5)
    assert row_counts == [4] * 5
    schedule, path = Schedule.of(5, 100), noise
    nothing = diffusing.head.z_embedder.uncondition.expand(2, -1, -1)
    for index in reversed(range(5)):
        moment = torch.full((2,), int(schedule.moments[index]))
        without, conditional = diffusing.head(path, moment, nothing), diffusing.head(path, moment, condition)
        path = schedule.back(index, path, without + 1.5 * (conditional - without))
    torch.testing.assert_close(mixed, path, rtol=0, atol=2e-5)


@torch.inference_mode()
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_without_guidance_only_the_conditional_rows_run(diffusing: InternVLANetwork, scale: float) -> None:
    plain, row_counts = rows_of(diffusing, torch.randn(2, 6, 32), torch.randn(2, 4, 7), scale)
    assert row_counts == [2] * 5
    assert torch.isfinite(plain).all()


CONFIG = DinoConfig.read(dims_values()["dino"], "test")


@pytest.fixture(scope="module")
def tower() -> DinoV2:
    built = DinoV2(CONFIG).eval()
    initialise(built, seed=2)
    with torch.no_grad():
        for name, parameter in built.named_parameters():
            if name.endswith("gamma"):
                parameter.copy_(torch.rand(24) + 0.5)
    return built


def renamed(tower: DinoV2) -> dict[str, Tensor]:
    """Its weights under the names of transformers' class, which splits what the original keeps together."""
    state = tower.state_dict()
    names = {
        "embeddings.cls_token": state["cls_token"],
        "embeddings.mask_token": state["mask_token"],
        "embeddings.position_embeddings": state["pos_embed"],
        "embeddings.patch_embeddings.projection.weight": state["patch_embed.proj.weight"],
        "embeddings.patch_embeddings.projection.bias": state["patch_embed.proj.bias"],
        "layernorm.weight": state["norm.weight"],
        "layernorm.bias": state["norm.bias"],
    }
    for block in range(CONFIG.blocks):
        ours, theirs = f"blocks.{block}.", f"encoder.layer.{block}."
        for end in ("weight", "bias"):
            parts = state[f"{ours}attn.qkv.{end}"].chunk(3)
            for part, value in zip(("query", "key", "value"), parts, strict=True):
                names[f"{theirs}attention.attention.{part}.{end}"] = value
            names[f"{theirs}attention.output.dense.{end}"] = state[f"{ours}attn.proj.{end}"]
            for same in ("norm1", "norm2", "mlp.fc1", "mlp.fc2"):
                names[f"{theirs}{same}.{end}"] = state[f"{ours}{same}.{end}"]
        for number in (1, 2):
            names[f"{theirs}layer_scale{number}.lambda1"] = state[f"{ours}ls{number}.gamma"]
    return names


@torch.inference_mode()
def test_at_the_trained_size_it_equals_transformers_own_dinov2(tower: DinoV2) -> None:
    other = Dinov2Model(
        Dinov2Config(hidden_size=24, num_hidden_layers=2, num_attention_heads=3, image_size=70, patch_size=14)
    ).eval()
    other.load_state_dict(renamed(tower))
    pixels = torch.randn(2, 3, 70, 70)
    expected = other(pixels).last_hidden_state[:, 1:]
    torch.testing.assert_close(tower(pixels), expected, rtol=0, atol=1e-5)


@torch.inference_mode()
def test_positions_are_stretched_with_the_originals_offset(tower: DinoV2) -> None:
    """Sampling points differ from those of a stretch to the exact size; both ends stay in the learned grid."""
    stretched = tower._positions(4, 4)
    assert stretched.shape == (1, 17, 24)
    grid = tower.pos_embed[:, 1:].unflatten(1, (5, 5)).permute(0, 3, 1, 2)
    exact = torch.nn.functional.interpolate(grid, size=(4, 4), mode="bicubic").flatten(2).transpose(1, 2)
    difference = (stretched[:, 1:] - exact).abs().max()
    assert 1e-3 < difference < 0.5
    assert torch.equal(tower._positions(5, 5), tower.pos_embed)
    assert tower._positions(3, 4).shape == (1, 13, 24)


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
    first_row = QwenInputs(both.ids[:1], both.mask[:1], both.pixel_values[:16], both.grid[:1], both.image_token)
    torch.testing.assert_close(built.read(first_row, views(2)[:1])[0], together[0], rtol=0, atol=1e-5)


@torch.inference_mode()
def test_the_queries_read_the_chosen_states_and_the_last_is_normed(built: InternVLANetwork) -> None:
    queries: list[Tensor] = []
    handle = built.layer_qformer.register_forward_pre_hook(lambda _, arguments: queries.extend(arguments[0]))
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
    assert [state.shape[1] for state in queries] == [positions + 16] * 2
    assert torch.equal(queries[0][:, :positions], states[2])
    assert torch.equal(queries[1][:, :positions], language.norm(states[3]))


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_part_has_the_precision_that_is_asked_for_whatever_the_files_say(dtype: torch.dtype) -> None:
    stored = {"torch_dtype": "float16"}
    values = vlm_values() | stored
    values["text_config"] |= stored
    values["vision_config"] |= stored
    empty = build_internvla(config(values), dtype, device="cpu")
    assert {parameter.dtype for parameter in empty.parameters()} == {dtype}


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


def test_the_prompt_is_qwens_chat_with_the_picture_first_and_the_instruction_in_lower_case() -> None:
    assert prompt("Put the Cube on the star", None) == (
        "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
        "<|im_start|>user\n<|vision_start|><|image_pad|><|vision_end|>put the cube on the star<|im_end|>\n"
        "<|im_start|>assistant\n"
    )
    assert "<|vision_end|>Your task is go. Then.<|im_end|>" in prompt("Go", "Your task is {instruction}. Then.")


def test_a_frame_is_squeezed_by_area() -> None:
    frame = np.zeros((448, 448, 3), np.uint8)
    frame[::2, ::2] = 200
    assert look(frame, None).shape == (224, 224, 3)
    assert (look(frame, None) == 50).all()
    assert look(frame, (112, 56)).shape == (56, 112, 3)


@pytest.mark.parametrize(
    ("shape", "expected"), [((224, 224), (56, 56)), ((100, 50), (112, 56)), ((56, 90), (56, 90))]
)
def test_the_shorter_side_of_dinos_picture_is_fixed(shape: tuple[int, int], expected: tuple[int, int]) -> None:
    white = np.full((*shape, 3), 255, np.uint8)
    pixels = dino_pixels(white, 56)
    assert tuple(pixels.shape) == (3, *expected)
    np.testing.assert_allclose(pixels[:, 0, 0], [(1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225])
