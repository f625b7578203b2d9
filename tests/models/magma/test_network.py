import numpy as np
import pytest
import torch
from tokenizers.pre_tokenizers import ByteLevel

from probe_kit.errors import CheckpointError
from probe_kit.models.magma import (
    UNUSED_WEIGHTS,
    MagmaConfig,
    Picture,
    PictureSettings,
    build_magma,
    full_size_magma,
    prepare_picture,
)
from tests.support.magma_checkpoints import IDS, action_ids, config_values, small_network, weights

IMAGE = IDS["<image>"]
SHORT, LONG = [3, 40, IMAGE, 50, 9], [3, 41, 42, 43, IMAGE, 51, 52, 9]


def picture(height: int, width: int, seed: int = 0) -> Picture:
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
    whole = torch.cat([wide.crops[0], wide.crops[1]], dim=2)[None]
    expected = network.multi_modal_projector(network.vision_tower(whole).permute(0, 2, 3, 1))[0]
    assert torch.equal(network.look([wide])[0].reshape(2, 5, 64)[:, :4], expected)
    crops = small_network()
    assert not torch.allclose(crops.look([wide])[0], network.look([wide])[0])


@torch.no_grad()
def test_cached_steps_choose_what_one_pass_over_prompt_and_answer_would_choose() -> None:
    network, view = small_network(), picture(50, 50)
    decoded = network.decode([LONG], [view], steps=5)
    fed = LONG + decoded.ids[0, :-1].tolist()
    whole = network([fed], [view]).logits[:, -5:]
    torch.testing.assert_close(decoded.logits, whole, rtol=0, atol=2e-5)
    assert torch.equal(decoded.ids, whole.argmax(dim=-1))


@torch.no_grad()
def test_a_batch_of_other_lengths_and_other_grids_changes_nothing() -> None:
    network = small_network()
    prompts, views = [SHORT, LONG], [picture(50, 50), picture(128, 120, seed=1)]
    together = network.decode(prompts, views, steps=4)
    for row in range(2):
        alone = network.decode(prompts[row : row + 1], views[row : row + 1], steps=4)
        torch.testing.assert_close(together.logits[row], alone.logits[0], rtol=0, atol=2e-5)


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


@pytest.mark.parametrize(("stored", "asked"), [("bfloat16", torch.float32), ("float32", torch.bfloat16)])
def test_a_network_has_one_precision_whatever_a_part_of_its_configuration_says(
    stored: str, asked: torch.dtype
) -> None:
    config = MagmaConfig.from_json(config_values(text={"torch_dtype": stored}))
    assert {parameter.dtype for parameter in build_magma(config, asked, device="cpu").parameters()} == {asked}


def test_the_full_size_has_the_released_number_of_parameters() -> None:
    network = full_size_magma()
    head = 1024 * 3072 + 2 * 3072
    assert sum(parameter.numel() for parameter in network.parameters()) + head == 8_906_701_696
    norms = [module.eps for module in network.vision_tower.modules() if hasattr(module, "eps")]
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
