import pytest
import torch
from torch import Tensor, nn

from probe_kit.models.building import initialise
from probe_kit.models.prismatic import (
    PrismaticConfig,
    PrismaticNetwork,
    build_prismatic,
    full_size_openvla,
    full_size_prismatic,
)
from tests.support.prismatic_checkpoints import FUSED, config_values

VISION = [FUSED, "dinoclip-vit-l-336px", "clip-vit-l", "siglip-vit-so400m", "dinov2-vit-l", "in1k-vit-l"]
LANGUAGE = ["llama2-7b-pure", "vicuna-v15-7b", "mistral-v0.1-7b-pure", "phi-2-3b"]


def network(vision: str = FUSED, language: str = "llama2-7b-pure") -> PrismaticNetwork:
    config = PrismaticConfig.from_json(config_values(vision, language))
    built = build_prismatic(config, torch.float32, device="cpu")
    initialise(built, seed=1)
    return built


def inputs(built: PrismaticNetwork) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    towers = built.vision_backbone.towers
    side = towers[0].patch_embed.img_size[0]
    ids = torch.randint(3, 200, (2, 9), generator=generator)
    pixels = torch.randn((2, 3 * len(towers), side, side), generator=generator)
    return ids, torch.ones_like(ids, dtype=torch.bool), pixels


@pytest.mark.parametrize("vision", VISION)
@torch.no_grad()
def test_patch_features_are_the_second_to_last_blocks_of_every_tower(vision: str) -> None:
    built = network(vision)
    pixels = inputs(built)[2]
    expected = []
    for index, tower in enumerate(built.vision_backbone.towers):
        stream = tower._pos_embed(tower.patch_embed(pixels[:, 3 * index : 3 * index + 3]))
        stream = tower.norm_pre(stream)
        for block in list(tower.blocks)[:-1]:
            stream = block(stream)
        expected.append(stream[:, tower.num_prefix_tokens :])
    torch.testing.assert_close(built.vision_backbone(pixels), torch.cat(expected, dim=2), rtol=0, atol=0)


def test_clip_towers_are_built_with_quick_gelu_and_others_with_the_exact_one() -> None:
    dino, clip = network("dinoclip-vit-l-336px").vision_backbone.towers
    assert isinstance(dino.blocks[0].mlp.act, nn.GELU)
    assert "quick" in type(clip.blocks[0].mlp.act).__name__.lower()


@pytest.mark.parametrize("vision", [FUSED, "clip-vit-l"])
def test_the_projector_has_three_layers_for_two_towers_and_two_for_one(vision: str) -> None:
    names = {name for name in network(vision).state_dict() if name.startswith("projector.")}
    layers = 3 if vision == FUSED else 2
    assert names == {f"projector.fc{k + 1}.{part}" for k in range(layers) for part in ("weight", "bias")}


@pytest.mark.parametrize("language", LANGUAGE)
@torch.no_grad()
def test_cached_steps_choose_what_one_pass_over_prompt_and_answer_would_choose(language: str) -> None:
    built = network("siglip-vit-so400m", language)
    ids, mask, pixels = inputs(built)
    decoded = built.decode(ids, mask, pixels, steps=5)
    fed = torch.cat([ids, decoded.ids[:, :-1]], dim=1)
    whole = built(fed, torch.ones_like(fed, dtype=torch.bool), pixels).logits[:, -5:]
    torch.testing.assert_close(decoded.logits, whole, rtol=0, atol=2e-5)
    assert torch.equal(decoded.ids, whole.argmax(dim=-1))


@pytest.mark.parametrize("language", LANGUAGE)
@torch.no_grad()
def test_padding_before_the_last_token_changes_nothing(language: str) -> None:
    built = network("siglip-vit-so400m", language)
    ids, mask, pixels = inputs(built)
    alone = built.decode(ids[:1], mask[:1], pixels[:1], steps=4)
    padded = torch.cat([ids[:1, :-1], torch.full((1, 3), 320), ids[:1, -1:]], dim=1)
    seen = padded != 320
    beside = torch.cat([ids[1:], ids[1:, :3]], dim=1)
    both = torch.cat([padded, beside]), torch.cat([seen, torch.ones_like(beside, dtype=torch.bool)])
    together = built.decode(*both, pixels, steps=4)
    torch.testing.assert_close(together.logits[:1], alone.logits, rtol=0, atol=2e-5)


def test_rotary_frequencies_stay_float32_and_real_on_a_network_built_without_memory() -> None:
    config = PrismaticConfig.from_json(config_values())
    built = build_prismatic(config, torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in built.parameters())
    assert all(buffer.dtype == torch.float32 and not buffer.is_meta for buffer in built.buffers())
    assert torch.get_default_dtype() == torch.float32


@pytest.mark.parametrize("asked", [torch.float32, torch.bfloat16])
def test_every_part_has_the_precision_that_is_asked_for_whatever_the_file_says(asked: torch.dtype) -> None:
    values = config_values()
    values["text_config"]["torch_dtype"] = "float16"
    built = build_prismatic(PrismaticConfig.from_json(values), asked, device="cpu")
    assert {parameter.dtype for parameter in built.parameters()} == {asked}


@pytest.mark.slow
def test_the_full_size_has_the_released_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in full_size_openvla().parameters()) == 7_541_237_184
    assert full_size_prismatic().state_dict().keys() == full_size_openvla().state_dict().keys()
