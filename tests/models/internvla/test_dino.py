import pytest
import torch
from torch import Tensor
from transformers import Dinov2Config, Dinov2Model

from probe_kit.models.building import initialise
from probe_kit.models.internvla import DinoConfig, DinoV2
from tests.support.internvla_checkpoints import dims_values

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
