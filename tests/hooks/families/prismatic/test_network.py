""""""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import map_coordinates
from torch import Tensor, nn
from torchvision.transforms import functional
from torchvision.transforms.functional import InterpolationMode

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.prismatic.network import (
    PictureSettings,
    PrismaticConfig,
    PrismaticNetwork,
    build_prismatic,
    centre_crop,
    full_size_openvla,
    full_size_prismatic,
    prepare_picture,
)
from probe_kit.models.building import initialise
from tests.hooks.families.prismatic.checkpoints import FUSED, config_values


def test_a_short_config_is_completed_from_the_table_and_transformers_defaults() -> None:
    """As the released files are: only the vocabulary of the language model is written down."""
    config = PrismaticConfig.from_json(
        {
            "model_type": "openvla",
            "vision_backbone_id": "dinosiglip-vit-so-384px",
            "llm_backbone_id": "llama2-7b-pure",
            "text_config": {"vocab_size": 32064},
        }
    )
    assert [(tower.timm_id, tower.image_size) for tower in config.towers] == [
        ("vit_large_patch14_reg4_dinov2.lvd142m", 384),
        ("vit_so400m_patch14_siglip_384", 384),
    ]
    assert (config.text.hidden_size, config.text.rms_norm_eps) == (4096, 1e-6)
    assert (config.action_vocabulary, config.action_bins, config.empty_token) == (32000, 256, 29871)
    assert not config.text.tie_word_embeddings


def test_clip_towers_have_quick_gelu_beside_a_tower_that_has_not() -> None:
    config = PrismaticConfig.from_json(config_values(vision="dinoclip-vit-l-336px"))
    assert [tower.act_layer for tower in config.towers] == [None, "quick_gelu"]


@pytest.mark.parametrize(
    ("language", "kind"),
    [("vicuna-v15-13b", "llama"), ("mistral-v0.1-7b-instruct", "mistral"), ("phi-2-3b", "phi")],
)
def test_the_language_id_decides_the_kind_of_language_model(language: str, kind: str) -> None:
    assert PrismaticConfig.from_json(config_values(language=language)).text.model_type == kind


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("model_type", "llava"),
        ("vision_backbone_id", "vit-unheard-of"),
        ("llm_backbone_id", "gpt-9"),
        ("image_resize_strategy", "stretch"),
        ("use_fused_vision_backbone", False),
        ("timm_model_ids", ["vit_so400m_patch14_siglip_224"]),
    ],
)
def test_what_contradicts_or_is_unknown_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(CheckpointError, match=field if field != "model_type" else "llava"):
        PrismaticConfig.from_json({**config_values(), field: value})


def test_a_text_config_of_another_kind_than_its_id_is_refused() -> None:
    values = config_values()
    values["text_config"]["model_type"] = "phi"
    with pytest.raises(CheckpointError, match=r"llama model, but text_config describes a phi"):
        PrismaticConfig.from_json(values)


def test_a_folder_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        PrismaticConfig.from_folder(tmp_path)


def test_what_was_trained_in_is_read_from_the_file(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config_values(torch_dtype="bfloat16")), encoding="utf-8")
    assert PrismaticConfig.from_folder(tmp_path).dtype == "bfloat16"


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
    full_pass = built(fed, torch.ones_like(fed, dtype=torch.bool), pixels).logits[:, -5:]
    torch.testing.assert_close(decoded.logits, full_pass, rtol=0, atol=2e-5)
    assert torch.equal(decoded.ids, full_pass.argmax(dim=-1))


@pytest.mark.parametrize("language", LANGUAGE)
@torch.no_grad()
def test_padding_before_the_last_token_changes_nothing(language: str) -> None:
    built = network("siglip-vit-so400m", language)
    ids, mask, pixels = inputs(built)
    alone = built.decode(ids[:1], mask[:1], pixels[:1], steps=4)
    padded = torch.cat([ids[:1, :-1], torch.full((1, 3), 320), ids[:1, -1:]], dim=1)
    padding_mask = padded != 320
    unpadded = torch.cat([ids[1:], ids[1:, :3]], dim=1)
    both = torch.cat([padded, unpadded]), torch.cat([padding_mask, torch.ones_like(unpadded, dtype=torch.bool)])
    together = built.decode(*both, pixels, steps=4)
    torch.testing.assert_close(together.logits[:1], alone.logits, rtol=0, atol=2e-5)


def test_rotary_frequencies_stay_float32_and_real_on_a_network_built_without_memory() -> None:
    config = PrismaticConfig.from_json(config_values())
    built = build_prismatic(config, torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in built.parameters())
    assert all(buffer.dtype == torch.float32 and not buffer.is_meta for buffer in built.buffers())
    assert torch.get_default_dtype() == torch.float32


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_part_has_the_precision_that_is_asked_for_whatever_the_file_says(dtype: torch.dtype) -> None:
    values = config_values()
    values["text_config"]["torch_dtype"] = "float16"
    built = build_prismatic(PrismaticConfig.from_json(values), dtype, device="cpu")
    assert {parameter.dtype for parameter in built.parameters()} == {dtype}


@pytest.mark.slow
def test_openvla_is_a_prismatic_of_the_released_size() -> None:
    assert full_size_prismatic().state_dict().keys() == full_size_openvla().state_dict().keys()


SHAPES = [(48, 64), (65, 40), (28, 28), (29, 90), (90, 29)]


def picture(shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)


def settings(strategy: str, folder: Path = Path("nowhere")) -> PictureSettings:
    values = config_values(vision="dinoclip-vit-l-336px", image_resize_strategy=strategy)
    return PictureSettings.of(PrismaticConfig.from_json(values), folder)


def by_torchvision(image: np.ndarray, picture_settings: PictureSettings) -> np.ndarray:
    """The same in torchvision's words, whose rounding the original software has."""
    canvas = Image.fromarray(image)
    if picture_settings.strategy == "letterbox":
        longer = max(canvas.size)
        left, top = int((longer - canvas.width) / 2), int((longer - canvas.height) / 2)
        fill = tuple(int(255 * value) for value in picture_settings.means[-1])
        canvas = functional.pad(canvas, [left, top, left, top], fill=fill)
    channels = []
    for side, mean, deviation in zip(
        picture_settings.sides, picture_settings.means, picture_settings.deviations, strict=True
    ):
        size = [side, side] if picture_settings.strategy == "resize-naive" else side
        resized = functional.resize(canvas, size, InterpolationMode.BICUBIC)
        tensor = functional.to_tensor(functional.center_crop(resized, [side, side]))
        channels.append(functional.normalize(tensor, list(mean), list(deviation)))
    return torch.cat(channels).numpy()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("strategy", ["resize-naive", "letterbox", "resize-crop"])
def test_pixel_values_are_torchvisions_bit_for_bit(strategy: str, shape: tuple[int, int]) -> None:
    picture_settings = settings(strategy)
    ours = prepare_picture(picture(shape), picture_settings)
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours, by_torchvision(picture(shape), picture_settings))


def test_the_checkpoints_own_preprocessor_wins_over_the_table(tmp_path: Path) -> None:
    stored = {
        "image_resize_strategy": "resize-crop",
        "input_sizes": [[3, 28, 28], [3, 28, 28]],
        "means": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
        "stds": [[1, 1, 1], [2, 2, 2]],
        "interpolations": ["bicubic", "bilinear"],
    }
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stored), encoding="utf-8")
    picture_settings = settings("letterbox", tmp_path)
    assert (picture_settings.strategy, picture_settings.resampling, picture_settings.means[1]) == (
        "resize-crop",
        ("bicubic", "bilinear"),
        (0.4, 0.5, 0.6),
    )
    stored["interpolations"] = ["bicubic", "hamming"]
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stored), encoding="utf-8")
    with pytest.raises(CheckpointError, match="hamming"):
        settings("letterbox", tmp_path)


@pytest.mark.parametrize("shape", [(48, 64), (224, 224), (31, 17)])
def test_the_centre_crop_samples_the_middle_nine_tenths_of_the_area(shape: tuple[int, int]) -> None:
    """Against scipy's linear interpolation at the places TensorFlow's `crop_and_resize` defines."""
    image, side, factor = picture(shape), 56, np.sqrt(0.9)
    start, stop = (1 - factor) / 2, (1 + factor) / 2
    rows, columns = (np.linspace(start, stop, side) * (extent - 1) for extent in shape)
    grid = np.meshgrid(rows, columns, indexing="ij")
    expected = np.stack([map_coordinates(image[..., c] / 255, grid, order=1) for c in range(3)], axis=-1)
    ours = centre_crop(image, side).astype(int)
    assert ours.shape == (side, side, 3)
    assert np.abs(ours - (expected * 255.5).astype(np.uint8)).max() <= 1
    assert (ours == (expected * 255.5).astype(np.uint8)).mean() > 0.999
