"""The network alone, against its own parts; `verify` compares it with the original."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tokenizers import Tokenizer
from tokenizers.pre_tokenizers import ByteLevel
from torchvision.transforms import Compose, Normalize, ToTensor

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.magma.network import (
    ACTION_QUESTION,
    UNUSED_WEIGHTS,
    Grid,
    MagmaConfig,
    MagmaPicture,
    PictureSettings,
    build_magma,
    chat_text,
    choose_grid,
    conversation,
    full_size_magma,
    picture_question,
    prepare_picture,
    shipped_statistics,
    shrink_picture,
)
from tests.hooks.families.magma.checkpoints import (
    IDS,
    action_ids,
    config_values,
    small_network,
    weights,
    write_tokenizer,
)


def test_everything_comes_from_the_file() -> None:
    config = MagmaConfig.from_json(config_values())
    assert (config.text.hidden_size, config.text.rms_norm_eps) == (64, 1e-5)
    assert config.text.rope_parameters["rope_theta"] == 500000.0
    assert (config.image_token, config.base_vocabulary, config.dtype) == (IDS["<image>"], 512, "float32")
    assert config.image_start_end
    assert (config.vision.trunk, config.vision.base, config.vision.crops) == ("convnext_xxlarge", 64, 4)


def test_a_file_without_text_config_has_the_same_fields_at_its_top() -> None:
    values = config_values()
    flat = {**values["text_config"], **{name: value for name, value in values.items() if name != "text_config"}}
    ours, theirs = MagmaConfig.from_json(flat).text, MagmaConfig.from_json(values).text
    assert (ours.hidden_size, ours.num_key_value_heads, ours.rope_parameters, ours.vocab_size) == (
        theirs.hidden_size,
        theirs.num_key_value_heads,
        theirs.rope_parameters,
        theirs.vocab_size,
    )


@pytest.mark.parametrize("name", ["mlp2x_gelu", "mlp2x_gelu_segtokv2"])
def test_older_names_of_the_projector_mean_the_same_modules(name: str) -> None:
    assert MagmaConfig.from_json(config_values(vision={"mm_projector_type": name})).vision.projector_layers == 2


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("vision", "vision_backbone", "convnextbase"),
        ("vision", "mm_projector_type", "linear"),
        ("vision", "img_anyres_strategy", "tile"),
        ("vision", "vision_feature_layer", "res4"),
        ("vision", "hidden_size", 96),
        ("text", "model_type", "mistral"),
    ],
)
def test_what_is_unknown_or_contradicts_is_refused_by_name(part: str, field: str, value: object) -> None:
    with pytest.raises(CheckpointError, match=str(value)):
        MagmaConfig.from_json(config_values(**{part: {field: value}}))


def test_another_model_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="'llava'"):
        MagmaConfig.from_json(config_values(model_type="llava"))
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        MagmaConfig.from_folder(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "magma"}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="vision_config"):
        MagmaConfig.from_folder(tmp_path)


def test_a_projector_that_does_not_fit_the_trunk_is_refused() -> None:
    config = MagmaConfig.from_json(config_values(vision={"mm_hidden_size": 48}))
    with pytest.raises(CheckpointError, match=r"48 features .*32"):
        build_magma(config, torch.float32)


IMAGE = IDS["<image>"]
SHORT, LONG = [3, 40, IMAGE, 50, 9], [3, 41, 42, 43, IMAGE, 51, 52, 9]


def picture(height: int, width: int, seed: int = 0) -> MagmaPicture:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return prepare_picture(pixels, PictureSettings(64, 4))


@torch.no_grad()
def test_a_picture_takes_its_placeholders_place_row_by_row_with_a_separator_behind_each() -> None:
    network, wide = small_network(), picture(60, 128)
    assert (wide.grid.rows, wide.grid.columns) == (1, 2)
    span = network.span(LONG, wide.grid, 64)
    assert (span.start, span.rows, span.columns, span.length) == (4, 2, 4, 10)
    embeddings, _ = network.embed([LONG], [wide])
    assert embeddings.shape == (1, len(LONG) - 1 + span.length, 64)
    block = embeddings[0, 4:14].reshape(2, 5, 64)
    separator = network.multi_modal_projector.row_seperator[0, 0]
    assert torch.equal(block[:, 4], torch.stack([separator, separator]))
    left, right = network.multi_modal_projector(network.vision_tower(wide.crops).permute(0, 2, 3, 1))
    assert torch.equal(block[:, :4], torch.cat([left, right], dim=1))
    text = network.language_model.model.embed_tokens(torch.tensor([51, 52, 9]))
    assert torch.equal(embeddings[0, 14:], text)


@torch.no_grad()
def test_the_global_strategy_looks_at_the_whole_picture_at_once() -> None:
    network, wide = small_network(vision={"img_anyres_strategy": "global"}), picture(60, 128)
    full_picture = torch.cat([wide.crops[0], wide.crops[1]], dim=2)[None]
    expected = network.multi_modal_projector(network.vision_tower(full_picture).permute(0, 2, 3, 1))[0]
    assert torch.equal(network.look([wide])[0].reshape(2, 5, 64)[:, :4], expected)
    crops = small_network()
    assert not torch.allclose(crops.look([wide])[0], network.look([wide])[0])


@torch.no_grad()
def test_cached_steps_choose_what_one_pass_over_prompt_and_answer_would_choose() -> None:
    network, view = small_network(), picture(50, 50)
    decoded = network.decode([LONG], [view], steps=5)
    fed = LONG + decoded.ids[0, :-1].tolist()
    full_pass = network([fed], [view]).logits[:, -5:]
    torch.testing.assert_close(decoded.logits, full_pass, rtol=0, atol=2e-5)
    assert torch.equal(decoded.ids, full_pass.argmax(dim=-1))


@torch.no_grad()
def test_decoding_goes_on_where_it_stopped() -> None:
    network, view = small_network(), picture(50, 50)
    decoded = network.decode([SHORT], [view], steps=3)
    logits = network.logits_behind(decoded, network.unhooked())
    longer = network.decode([SHORT], [view], steps=4)
    torch.testing.assert_close(logits, longer.logits[:, 3], rtol=0, atol=1e-6)


@torch.no_grad()
def test_a_prompt_without_a_picture_is_text_alone() -> None:
    network = small_network()
    ids = [3, 40, 50, 9]
    expected = network.language_model(torch.tensor([ids])).logits
    torch.testing.assert_close(network([ids], None).logits, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("ids", [[3, 4, 5], [3, IMAGE, IMAGE, 5]])
def test_a_prompt_needs_exactly_one_placeholder(ids: list[int]) -> None:
    with pytest.raises(CheckpointError, match="placeholder"), torch.no_grad():
        small_network().embed([ids], [picture(50, 50)])


def test_every_layer_scale_is_a_parameter_and_the_unread_head_is_none() -> None:
    names = set(small_network().state_dict())
    assert sum(name.endswith(".gamma") for name in names) == 5
    assert not names & set(UNUSED_WEIGHTS)
    assert set(weights(small_network())) == names | set(UNUSED_WEIGHTS)


def test_begin_and_end_vectors_are_loaded_where_the_file_has_them() -> None:
    names = set(small_network(vision={"mm_use_im_start_end": True}).state_dict())
    assert {f"multi_modal_projector.img_{end}_seperator" for end in ("start", "end")} <= names


def test_a_network_without_memory_has_real_rotary_frequencies_in_float32() -> None:
    built = build_magma(MagmaConfig.from_json(config_values()), torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in built.parameters())
    assert all(buffer.dtype == torch.float32 and not buffer.is_meta for buffer in built.buffers())
    assert torch.get_default_dtype() == torch.float32


@pytest.mark.parametrize(("stored", "dtype"), [("bfloat16", torch.float32), ("float32", torch.bfloat16)])
def test_a_network_has_one_precision_whatever_a_part_of_its_configuration_says(
    stored: str, dtype: torch.dtype
) -> None:
    config = MagmaConfig.from_json(config_values(text={"torch_dtype": stored}))
    assert {parameter.dtype for parameter in build_magma(config, dtype, device="cpu").parameters()} == {dtype}


def test_the_trunk_of_the_released_size_has_the_norms_of_convnext_xxlarge() -> None:
    norms = [module.eps for module in full_size_magma().vision_tower.modules() if hasattr(module, "eps")]
    assert set(norms) == {1e-5}


@torch.no_grad()
def test_steered_weights_put_out_an_action_that_depends_on_the_picture() -> None:
    """The small checkpoints of other tests rest on this."""
    network = small_network(steered=True)
    prompt = [3, IMAGE, 40, sorted(ByteLevel.alphabet()).index("Ċ")]
    rows = [network.decode([prompt], [picture(50, 50, seed)], steps=8).ids[0] for seed in range(3)]
    for ids in rows:
        assert all(int(ids[step]) in action_ids(step).tolist() for step in range(7))
        assert int(ids[7]) == IDS["<|eot_id|>"]
    assert len({tuple(ids.tolist()) for ids in rows}) > 1


SETTINGS = PictureSettings(64, 4)


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("width", "height", "grid"),
    [
        (224, 224, Grid(1, 1)),
        (640, 480, Grid(1, 2)),
        (480, 640, Grid(2, 1)),
        (1280, 720, Grid(2, 2)),
        (100, 1000, Grid(2, 1)),
        (2000, 100, Grid(1, 4)),
        (1, 3000, Grid(1, 1)),
    ],
)
def test_the_grid_keeps_most_pixels_and_wastes_fewest(width: int, height: int, grid: Grid) -> None:
    assert choose_grid(width, height, PictureSettings(512, 4)) == grid


@pytest.mark.parametrize(("height", "width"), [(50, 50), (70, 121), (48, 64), (128, 128), (200, 40)])
def test_crops_are_torchvisions_pixels_stretched_and_cut_bit_for_bit(height: int, width: int) -> None:
    picture = noise(height, width)
    prepared = prepare_picture(picture, SETTINGS)
    pixels = Compose([ToTensor(), Normalize(SETTINGS.mean, SETTINGS.deviation)])(Image.fromarray(picture))
    rows, columns = prepared.grid.rows, prepared.grid.columns
    resized = torch.nn.functional.interpolate(pixels[None], size=(64 * rows, 64 * columns), mode="bilinear")[0]
    expected = [
        resized[:, 64 * row : 64 * (row + 1), 64 * column : 64 * (column + 1)]
        for row in range(rows)
        for column in range(columns)
    ]
    assert torch.equal(prepared.crops, torch.stack(expected))


def test_the_client_shrinks_with_pils_default_filter() -> None:
    picture = noise(48, 64)
    expected = np.asarray(Image.fromarray(picture).resize((20, 20)))
    np.testing.assert_array_equal(shrink_picture(picture, 20), expected)


def test_the_checkpoints_own_processor_wins_over_its_configuration(tmp_path: Path) -> None:
    vision = MagmaConfig.from_json(config_values()).vision
    assert PictureSettings.of(vision, tmp_path) == SETTINGS
    file = tmp_path / "preprocessor_config.json"
    file.write_text(json.dumps({"base_img_size": 96, "num_crops": 2, "image_mean": [0, 0.5, 1]}), encoding="utf-8")
    settings = PictureSettings.of(vision, tmp_path)
    assert (settings.base, settings.crops, settings.mean, settings.deviation) == (
        96,
        2,
        (0, 0.5, 1),
        SETTINGS.deviation,
    )
    file.write_text(json.dumps({"num_crops": 2}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="base_img_size"):
        PictureSettings.of(vision, tmp_path)


def question(start_end: bool = True) -> str:
    return picture_question(ACTION_QUESTION.format(instruction="Put the cube on the Star"), start_end)


def test_a_whole_prompt_in_the_frames_of_llama_3() -> None:
    assert chat_text(conversation(question())) == (
        "<|begin_of_text|><|start_header_id|>system<|end_header_id|>\n\n"
        "You are agent that can see, talk and act.<|eot_id|>"
        "<|start_header_id|>user<|end_header_id|>\n\n"
        "<image_start><image><image_end>\n"
        "What action should the robot take to Put the cube on the Star?<|eot_id|>"
        "<|start_header_id|>assistant<|end_header_id|>\n\n"
    )
    assert question(start_end=False).startswith("<image>\nWhat")


def test_the_checkpoints_own_template_wins() -> None:
    template = "{{ bos_token }}{% for m in messages %}[{{ m.role }}] {{ m.content }} {% endfor %}>"
    text = chat_text(conversation("q"), template, beginning="<s>")
    assert text == "<s>[system] You are agent that can see, talk and act. [user] q >"


def test_the_system_speaks_first_unless_asked_otherwise() -> None:
    assert [message.role for message in conversation("q")] == ["system", "user"]
    assert [message.role for message in conversation("q", user_first=True)] == ["user", "system"]


def test_markers_are_single_tokens_of_a_tokenizer_in_the_released_layout(tmp_path: Path) -> None:
    tokenizer = Tokenizer.from_file(str(write_tokenizer(tmp_path) / "tokenizer.json"))
    ids = tokenizer.encode(chat_text(conversation(question()))).ids
    for token in ("<image>", "<image_start>", "<image_end>"):
        assert ids.count(IDS[token]) == 1
    assert ids[:2] == [IDS["<|begin_of_text|>"]] * 2  # written out, and once more by the tokenizer
    assert tokenizer.get_vocab_size(with_added_tokens=False) == 512


def test_the_shipped_statistics_are_the_clients_to_the_last_digit() -> None:
    """Known places of the table that the evaluation client holds in its code; rounded ones would not do."""
    action = shipped_statistics()["bridge_orig"]["action"]
    assert (action["q01"][5], action["q99"][0]) == (-0.20718276381492615, 0.028309678435325586)
    assert [len(action[name]) for name in ("q01", "q99", "mask")] == [7, 7, 7]
    assert action["mask"] == [True] * 6 + [False]
