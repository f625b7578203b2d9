"""The whole network, against its own parts put together another way, and against the recorded original."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from probe_kit.errors import UsageError
from probe_kit.hooks.checkpoints.weights import load_weights, read_weights
from probe_kit.models.decoding import Packed
from probe_kit.models.spatialvla import SpatialVLAConfig, SpatialVLANetwork, build_spatialvla, full_size_spatialvla
from tests.support.spatialvla_checkpoints import FIRST_ACTION, IMAGE, SIDE, config_values, network

CAMERA = torch.tensor([[60.0, 0, 20], [0, 62, 22], [0, 0, 1]])


@pytest.fixture(scope="module")
def built() -> SpatialVLANetwork:
    made = network()
    made.embed_actions()
    return made


def prompt(length: int, patches: int = 9, seed: int = 0) -> list[int]:
    text = torch.randint(5, IMAGE, (length,), generator=torch.Generator().manual_seed(seed))
    return [IMAGE] * patches + [2, *text.tolist(), 4]


def pictures(rows: int = 1) -> Tensor:
    return torch.rand((rows, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(3))


@torch.inference_mode()
def test_cached_steps_choose_what_one_pass_over_prompt_and_actions_would_choose(built: SpatialVLANetwork) -> None:
    """One pass in which the prompt sees itself in both directions and the actions see what came before."""
    packed = Packed.of([prompt(5)], 0)
    features = built.look(pictures(), CAMERA).features
    decoded = built.decode(packed.ids, packed.mask, features, steps=6)
    embeddings = torch.cat([built.embed(packed.ids, features), built.embed(decoded.ids[:, :-1])], dim=1)
    length, known = embeddings.shape[1], packed.ids.shape[1]
    hidden = torch.full((length, length), -torch.inf).triu(1)
    hidden[:known, :known] = 0
    whole = built.language_model(
        inputs_embeds=embeddings,
        position_ids=torch.arange(1, length + 1)[None],
        attention_mask={"full_attention": hidden[None, None], "sliding_attention": hidden[None, None]},
    ).logits[:, -6:]
    torch.testing.assert_close(decoded.logits, whole, rtol=0, atol=2e-5)
    assert torch.equal(decoded.ids, whole.argmax(dim=-1))


@torch.inference_mode()
def test_padding_and_other_rows_change_nothing(built: SpatialVLANetwork) -> None:
    rows = [prompt(3, seed=1), prompt(8, seed=2)]
    looked = pictures(2)
    cameras = torch.stack([CAMERA, CAMERA * torch.tensor([[1.2], [1.1], [1.0]])])
    packed = Packed.of(rows, 0)
    together = built.decode(packed.ids, packed.mask, built.look(looked, cameras).features, steps=4)
    for row in (0, 1):
        one = Packed.of([rows[row]], 0)
        alone = built.decode(
            one.ids, one.mask, built.look(looked[row : row + 1], cameras[row : row + 1]).features, 4
        )
        torch.testing.assert_close(together.logits[row : row + 1], alone.logits, rtol=0, atol=2e-5)


@torch.inference_mode()
def test_the_picture_reads_the_text_and_padding_is_read_by_nothing(built: SpatialVLANetwork) -> None:
    features = built.look(pictures(), CAMERA).features
    states = []
    for ids in ([*prompt(4)[:-1], 0, 4], [*prompt(4)[:-1], 7, 4], [*prompt(4)[:-2], 9, 0, 4]):
        row = torch.tensor([ids])
        mask = torch.ones_like(row, dtype=torch.bool)
        mask[0, -2] = False
        states.append(torch.stack(built(built.embed(row, features), mask).hidden_states)[:, :, :9])
    torch.testing.assert_close(states[0], states[1], rtol=0, atol=0)
    assert (states[0][2] - states[2][2]).abs().max() > 1e-3


@torch.inference_mode()
def test_positions_count_tokens_from_one(built: SpatialVLANetwork) -> None:
    seen: list[Tensor] = []
    rotary = built.language_model.model.rotary_emb
    handle = rotary.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[1].clone()))
    try:
        packed = Packed.of([prompt(2), prompt(4)], 0)
        built.decode(packed.ids, packed.mask, built.look(pictures(2), CAMERA).features, steps=2)
    finally:
        handle.remove()
    assert seen[0][1].tolist() == list(range(1, 16))
    assert seen[0][0, [0, 11, -1]].tolist() == [1, 12, 13]
    assert seen[1].tolist() == [[14], [16]]


@torch.inference_mode()
def test_features_stay_as_they_are_where_words_are_scaled(built: SpatialVLANetwork) -> None:
    ids = torch.tensor([prompt(4)])
    features = built.look(pictures(), CAMERA).features
    embedded = built.embed(ids, features)
    table = built.language_model.model.embed_tokens.weight
    assert torch.equal(embedded[:, :9], features)
    torch.testing.assert_close(embedded[0, 9:], table[ids[0, 9:]] * 32**0.5)


def test_action_ids_are_embedded_by_their_own_table_and_put_out_by_another() -> None:
    made = network(seed=4)
    head = made.language_model.lm_head.weight.clone()
    stale = made.language_model.model.embed_tokens.weight[FIRST_ACTION:].clone()
    made.embed_actions()
    ids = torch.arange(FIRST_ACTION, FIRST_ACTION + made.config.actions)[None]
    own = made.spatial_embed_tokens.weight
    torch.testing.assert_close(made.embed(ids)[0], own * 32**0.5)
    assert (stale - own).abs().max() > 0.01
    assert torch.equal(made.language_model.lm_head.weight, head)


def test_another_number_of_places_than_patches_is_refused(built: SpatialVLANetwork) -> None:
    with pytest.raises(UsageError, match=r"\[8\] places for a picture; expected 9"):
        built.embed(torch.tensor([prompt(3, patches=8)]), torch.zeros(1, 9, 32))


def test_attention_without_the_soft_cap_is_refused() -> None:
    made = network()
    mask = torch.ones((1, 3), dtype=torch.bool)
    made.language_model.set_attn_implementation("sdpa")
    with pytest.raises(UsageError, match="'sdpa', which drops the soft cap"):
        made(torch.zeros(1, 3, 32), mask)
    made.language_model.set_attn_implementation("eager")
    assert torch.isfinite(made(torch.ones(1, 3, 32), mask).logits).all()


@torch.inference_mode()
def test_the_soft_cap_is_in_force() -> None:
    values = config_values()
    logits = []
    for cap in (50.0, 0.5):
        made = network(text_config={**values["text_config"], "attn_logit_softcapping": cap})
        made.embed_actions()
        packed = Packed.of([prompt(5)], 0)
        logits.append(made.decode(packed.ids, packed.mask, made.look(pictures(), CAMERA).features, steps=1).logits)
    assert (logits[0] - logits[1]).abs().max() > 1e-3
    assert max(each.abs().max() for each in logits) < 30


@torch.inference_mode()
def test_slots_and_fed_tokens_are_obeyed(built: SpatialVLANetwork) -> None:
    packed = Packed.of([prompt(5), prompt(5, seed=9)], 0)
    features = built.look(pictures(2), CAMERA).features
    slots = [range(FIRST_ACTION, FIRST_ACTION + 4), range(FIRST_ACTION + 4, FIRST_ACTION + 6)]
    ids = built.decode(packed.ids, packed.mask, features, 2, slots).ids
    assert all(ids[row, step] in slots[step] for row in (0, 1) for step in (0, 1))
    free = built.decode(packed.ids, packed.mask, features, 3)
    again = built.decode(packed.ids, packed.mask, features, 3, fed=free.ids[:, :2])
    torch.testing.assert_close(free.logits, again.logits, rtol=0, atol=0)
    other = built.decode(packed.ids, packed.mask, features, 3, fed=free.ids[:, :2].flip(0) + 1)
    assert (free.logits[:, 1] - other.logits[:, 1]).abs().max() > 1e-3


@torch.inference_mode()
def test_a_model_without_depth_reads_sight_alone() -> None:
    values = {"use_vision_zoe": False, "vision_zoe_config": None}
    made = network(**values)
    seen = made.look(pictures(), CAMERA)
    assert seen.depth is seen.points is seen.positions is None
    torch.testing.assert_close(seen.features, made.multi_modal_projector(seen.tower))
    assert not any("zoe" in name or "position_embedding_3d" in name for name in made.state_dict())


def test_a_network_built_without_memory_has_real_constants_and_the_right_dtype() -> None:
    made = build_spatialvla(SpatialVLAConfig.from_json(config_values()), torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in made.parameters())
    assert not any(buffer.is_meta for buffer in made.buffers())
    assert made.language_model.model.rotary_emb.inv_freq.dtype == torch.float32
    assert torch.get_default_dtype() == torch.float32


def test_constants_are_the_same_with_and_without_memory() -> None:
    config = config_values()
    lazy, real = (
        build_spatialvla(SpatialVLAConfig.from_json(config), torch.float32, device) for device in ("meta", "cpu")
    )
    constants = dict(real.named_buffers())
    assert constants.keys() == dict(lazy.named_buffers()).keys()
    for name, buffer in lazy.named_buffers():
        torch.testing.assert_close(buffer, constants[name])


@torch.inference_mode()
def test_bfloat16_runs_with_pictures_and_depth_in_float32() -> None:
    made = network().to(torch.bfloat16)
    made.embed_actions()
    seen = made.look(pictures(), CAMERA)
    assert seen.depth is not None
    assert seen.points is not None
    assert seen.depth.metres.dtype == seen.points.dtype == torch.float32
    packed = Packed.of([prompt(4), prompt(2)], 0)
    features = made.look(pictures(2), CAMERA).features
    assert torch.isfinite(made.decode(packed.ids, packed.mask, features, 3).logits).all()


def test_the_full_size_has_the_released_number_of_parameters() -> None:
    full = full_size_spatialvla()
    assert sum(parameter.numel() for parameter in full.parameters()) == 4_027_854_731
    assert len(full.state_dict()) == 1382


# -- the recorded original -------------------------------------------------------------------------------------


@torch.inference_mode()
def test_hidden_states_logits_and_ids_are_the_originals(golden_spatialvla: Path) -> None:
    folder = golden_spatialvla / "checkpoint"
    made = build_spatialvla(SpatialVLAConfig.from_folder(folder), torch.float32)
    weights = read_weights(folder)
    load_weights(made, weights, weights.tensors, assign=True)
    made.embed_actions()
    with np.load(golden_spatialvla / "reference.npz") as arrays:
        recorded = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    ids, mask = recorded["input_ids"], recorded["attention_mask"].bool()
    features = made.look(recorded["pixel_values"], recorded["intrinsic"]).features
    output = made(made.embed(ids, features), mask)
    close = {"rtol": 0, "atol": 5e-5}
    torch.testing.assert_close(torch.stack(output.hidden_states), recorded["hidden_states"], **close)
    torch.testing.assert_close(output.logits, recorded["logits"], **close)
    steps = len(recorded["generated_ids"])
    decoded = made.decode(ids, mask, features, steps)
    assert torch.equal(decoded.ids[0], recorded["generated_ids"])
    torch.testing.assert_close(decoded.logits[0], recorded["generated_step_logits"], **close)
