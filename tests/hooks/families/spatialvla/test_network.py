"""The whole network, against its own parts put together another way."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import Tensor

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.spatialvla.actions import ActionBins, equal_mass_edges
from probe_kit.hooks.families.spatialvla.network import (
    DEPTH_SIDE,
    MARGIN,
    PictureSettings,
    PositionEmbedding3D,
    SpatialVLAConfig,
    SpatialVLANetwork,
    back_project,
    build_spatialvla,
    depth_input,
    estimate_depth,
    known_cameras,
    prepare_picture,
)
from probe_kit.models.decoding import Packed
from tests.hooks.families.spatialvla.checkpoints import (
    BINS,
    FIRST_ACTION,
    IMAGE,
    SIDE,
    config_values,
    network,
    preprocessor_values,
    processor_values,
)


def test_a_short_text_config_is_completed_by_gemmas_defaults() -> None:
    """As the released files are: sizes that are Gemma-2's own are not written down."""
    short = {"hidden_size": 2304, "vocab_size": FIRST_ACTION + BINS["total"], "tie_word_embeddings": False}
    config = SpatialVLAConfig.from_json(config_values(text_config=short, projection_dim=2304))
    text = config.text
    assert (text.head_dim, text.num_key_value_heads, text.num_hidden_layers) == (256, 4, 26)
    assert (text.attn_logit_softcapping, text.final_logit_softcapping, text.rms_norm_eps) == (50, 30, 1e-6)


def test_the_old_name_of_the_rotary_base_is_understood() -> None:
    values = config_values()
    values["text_config"]["rope_theta"] = 5000.0
    assert SpatialVLAConfig.from_json(values).text.rope_parameters["rope_theta"] == 5000


def test_sizes_and_ids_come_from_the_file(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config_values(torch_dtype="bfloat16")), encoding="utf-8")
    config = SpatialVLAConfig.from_folder(tmp_path)
    assert (config.image_token, config.first_action, config.actions) == (IMAGE, FIRST_ACTION, BINS["total"])
    assert (config.side, config.patches, config.points, config.frequencies) == (42, 9, 2, 3)
    assert config.dtype == "bfloat16"
    assert config.own_action_embeddings


def test_a_model_may_see_no_depth() -> None:
    values = config_values(use_vision_zoe=False)
    del values["vision_zoe_config"], values["ego3d_patch_reso"]
    assert SpatialVLAConfig.from_json(values).depth is None


@pytest.mark.parametrize(
    "missing",
    ["image_token_index", "action_token_begin_idx", "vision_zoe_config", "ego3d_patch_reso", "text_config"],
)
def test_what_is_missing_is_named(missing: str) -> None:
    values = config_values()
    del values[missing]
    with pytest.raises(CheckpointError, match=missing):
        SpatialVLAConfig.from_json(values)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("model_type", "paligemma", "paligemma"),
        ("projection_dim", 48, "projection_dim 48"),
        ("spatial_token_num", 30, "action ids end at"),
        ("image_token_index", FIRST_ACTION, "is an action"),
        ("ego3d_patch_reso", 4, "4 points do not divide"),
        ("vision_config", {"model_type": "clip_vision_model"}, "clip_vision_model"),
    ],
)
def test_what_contradicts_is_refused_by_name(field: str, value: object, reason: str) -> None:
    with pytest.raises(CheckpointError, match=reason):
        SpatialVLAConfig.from_json({**config_values(), field: value})


def test_an_output_layer_tied_to_the_embeddings_is_refused_and_the_outer_flag_is_not_read() -> None:
    """The released outer config says tied; the language model's own says not."""
    values = config_values()
    assert values["tie_word_embeddings"]
    assert not SpatialVLAConfig.from_json(values).text.tie_word_embeddings
    values["text_config"]["tie_word_embeddings"] = True
    with pytest.raises(CheckpointError, match="ties the output layer"):
        SpatialVLAConfig.from_json(values)


def test_a_folder_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"config\.json is missing"):
        SpatialVLAConfig.from_folder(tmp_path)


CAMERA = torch.tensor([[60.0, 0, 20], [0, 62, 22], [0, 0, 1]])


@pytest.fixture(scope="module")
def built() -> SpatialVLANetwork:
    model = network()
    model.embed_actions()
    return model


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
    length, prompt_length = embeddings.shape[1], packed.ids.shape[1]
    hidden = torch.full((length, length), -torch.inf).triu(1)
    hidden[:prompt_length, :prompt_length] = 0
    full_pass = built.language_model(
        inputs_embeds=embeddings,
        position_ids=torch.arange(1, length + 1)[None],
        attention_mask={"full_attention": hidden[None, None], "sliding_attention": hidden[None, None]},
    ).logits[:, -6:]
    torch.testing.assert_close(decoded.logits, full_pass, rtol=0, atol=2e-5)
    assert torch.equal(decoded.ids, full_pass.argmax(dim=-1))


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
    positions: list[Tensor] = []
    rotary = built.language_model.model.rotary_emb
    handle = rotary.register_forward_pre_hook(lambda _, inputs: positions.append(inputs[1].clone()))
    try:
        packed = Packed.of([prompt(2), prompt(4)], 0)
        built.decode(packed.ids, packed.mask, built.look(pictures(2), CAMERA).features, steps=2)
    finally:
        handle.remove()
    assert positions[0][1].tolist() == list(range(1, 16))
    assert positions[0][0, [0, 11, -1]].tolist() == [1, 12, 13]
    assert positions[1].tolist() == [[14], [16]]


@torch.inference_mode()
def test_features_stay_as_they_are_where_words_are_scaled(built: SpatialVLANetwork) -> None:
    ids = torch.tensor([prompt(4)])
    features = built.look(pictures(), CAMERA).features
    embedded = built.embed(ids, features)
    table = built.language_model.model.embed_tokens.weight
    assert torch.equal(embedded[:, :9], features)
    torch.testing.assert_close(embedded[0, 9:], table[ids[0, 9:]] * 32**0.5)


def test_action_ids_are_embedded_by_their_own_table_and_put_out_by_another() -> None:
    model = network(seed=4)
    head = model.language_model.lm_head.weight.clone()
    stale = model.language_model.model.embed_tokens.weight[FIRST_ACTION:].clone()
    model.embed_actions()
    ids = torch.arange(FIRST_ACTION, FIRST_ACTION + model.config.actions)[None]
    table = model.spatial_embed_tokens.weight
    torch.testing.assert_close(model.embed(ids)[0], table * 32**0.5)
    assert (stale - table).abs().max() > 0.01
    assert torch.equal(model.language_model.lm_head.weight, head)


def test_another_number_of_places_than_patches_is_refused(built: SpatialVLANetwork) -> None:
    with pytest.raises(UsageError, match=r"\[8\] places for a picture; expected 9"):
        built.embed(torch.tensor([prompt(3, patches=8)]), torch.zeros(1, 9, 32))


def test_attention_without_the_soft_cap_is_refused() -> None:
    model = network()
    mask = torch.ones((1, 3), dtype=torch.bool)
    model.language_model.set_attn_implementation("sdpa")
    with pytest.raises(UsageError, match="'sdpa', which drops the soft cap"):
        model(torch.zeros(1, 3, 32), mask)
    model.language_model.set_attn_implementation("eager")
    assert torch.isfinite(model(torch.ones(1, 3, 32), mask).logits).all()


@pytest.mark.slow
@torch.inference_mode()
def test_the_soft_cap_is_in_force() -> None:
    values = config_values()
    logits = []
    for cap in (50.0, 0.5):
        model = network(text_config={**values["text_config"], "attn_logit_softcapping": cap})
        model.embed_actions()
        packed = Packed.of([prompt(5)], 0)
        logits.append(
            model.decode(packed.ids, packed.mask, model.look(pictures(), CAMERA).features, steps=1).logits
        )
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
    model = network(**values)
    sight = model.look(pictures(), CAMERA)
    assert sight.depth is sight.points is sight.positions is None
    torch.testing.assert_close(sight.features, model.multi_modal_projector(sight.tower))
    assert not any("zoe" in name or "position_embedding_3d" in name for name in model.state_dict())


def test_a_network_built_without_memory_has_real_constants_and_the_right_dtype() -> None:
    model = build_spatialvla(SpatialVLAConfig.from_json(config_values()), torch.bfloat16)
    assert all(parameter.is_meta and parameter.dtype == torch.bfloat16 for parameter in model.parameters())
    assert not any(buffer.is_meta for buffer in model.buffers())
    assert model.language_model.model.rotary_emb.inv_freq.dtype == torch.float32
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


@pytest.mark.slow
@torch.inference_mode()
def test_bfloat16_runs_with_pictures_and_depth_in_float32() -> None:
    model = network().to(torch.bfloat16)
    model.embed_actions()
    sight = model.look(pictures(), CAMERA)
    assert sight.depth is not None
    assert sight.points is not None
    assert sight.depth.metres.dtype == sight.points.dtype == torch.float32
    packed = Packed.of([prompt(4), prompt(2)], 0)
    features = model.look(pictures(2), CAMERA).features
    assert torch.isfinite(model.decode(packed.ids, packed.mask, features, 3).logits).all()


def domain_pictures() -> Tensor:
    """A dark, a bright and a striped one."""
    noise = torch.rand((3, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(0))
    noise[0] *= 0.2
    noise[1] = 1 - 0.2 * noise[1]
    noise[2, :, ::7] = 0
    return noise


@pytest.fixture
def divided() -> SpatialVLANetwork:
    """A network whose depth head takes one of the domain_pictures for another domain than the other two."""
    model = network(seed=2)
    with torch.inference_mode():
        logits = estimate_depth(model.vision_zoe_model, domain_pictures()).domains
    assert logits is not None
    difference = (logits[:, 1] - logits[:, 0]).sort().values
    between = float(difference[:2].mean())
    with torch.no_grad():
        model.vision_zoe_model.metric_head.mlp_classifier.linear2.bias[0] += between
    return model


@pytest.mark.slow
@torch.inference_mode()
def test_a_picture_has_the_depth_it_has_alone_whatever_else_is_in_the_batch(divided: SpatialVLANetwork) -> None:
    zoe = divided.vision_zoe_model
    together = estimate_depth(zoe, domain_pictures())
    assert together.domains is not None
    assert len(together.domains.argmax(dim=-1).unique()) == 2
    alone = [estimate_depth(zoe, picture[None]) for picture in domain_pictures()]
    for row, single in enumerate(alone):
        torch.testing.assert_close(together.metres[row], single.metres[0], rtol=0, atol=1e-5)


@pytest.mark.slow
@torch.inference_mode()
def test_the_originals_vote_gives_the_minority_another_head(divided: SpatialVLANetwork) -> None:
    zoe = divided.vision_zoe_model
    unvoted, voted = estimate_depth(zoe, domain_pictures()), estimate_depth(zoe, domain_pictures(), vote=True)
    assert unvoted.domains is not None
    minority = unvoted.domains.argmax(dim=-1) != unvoted.domains.sum(dim=0).argmax()
    torch.testing.assert_close(unvoted.raw[~minority], voted.raw[~minority], rtol=0, atol=1e-5)
    assert (unvoted.raw[minority] - voted.raw[minority]).abs().max() > 1e-3


@pytest.mark.slow
@torch.inference_mode()
def test_a_depth_network_of_one_head_needs_no_vote() -> None:
    values = network().config.depth.to_dict()
    values["bin_configurations"] = values["bin_configurations"][:1]
    model = network(vision_zoe_config=values)
    depth = estimate_depth(model.vision_zoe_model, domain_pictures())
    assert depth.domains is None
    assert depth.metres.shape == (3, 1, SIDE, SIDE)


def test_the_margin_is_a_mirror_and_the_range_is_minus_one_to_one() -> None:
    picture = torch.zeros(1, 3, 64, 64)
    picture[..., :, 10] = 1  # a line; its mirror image lies as far beyond the edge
    padded = depth_input(picture)
    assert padded.shape == (1, 3, DEPTH_SIDE, DEPTH_SIDE)
    scale = (DEPTH_SIDE - 1) / (64 + 2 * MARGIN - 1)
    bright = padded[0, 0, 200] > 0
    for row in (MARGIN + 10, MARGIN - 10):
        assert bright[round(row * scale)]
    torch.testing.assert_close(depth_input(torch.full((1, 3, 64, 64), 0.5)), torch.zeros(1, 3, 384, 384))


@pytest.mark.parametrize(("side", "patch", "points"), [(56, 14, 2), (48, 16, 4), (42, 14, 1)])
def test_points_project_back_to_the_middles_of_a_patchs_parts(side: int, patch: int, points: int) -> None:
    """Seen through the camera again, every point lies where it was measured, at the depth of its part."""
    generator = torch.Generator().manual_seed(0)
    camera = torch.tensor([[210.0, 0, 25.8], [0, 123.2, 25.2], [0, 0, 1]])
    metres = 1 + torch.rand((2, 1, side, side), generator=generator)
    projected = back_project(metres, camera, patch, points).double()
    part, along = patch // points, side // patch
    for row in range(2):
        for index in range(along**2):
            top, left = index // along * patch, index % along * patch
            for inner in range(points**2):
                y, x = top + inner // points * part, left + inner % points * part
                point = projected[row, index, 3 * inner : 3 * inner + 3]
                depth = metres[row, 0, y : y + part, x : x + part].double().mean()
                pixel = camera.double() @ point
                assert point[2] == pytest.approx(float(depth), abs=1e-6)
                middle = [x + part / 2, y + part / 2]
                np.testing.assert_allclose((pixel[:2] / pixel[2]).numpy(), middle, atol=1e-4)


def test_every_row_may_have_its_own_camera() -> None:
    metres = torch.ones(2, 1, 28, 28)
    cameras = torch.stack([torch.diag(torch.tensor([focal, focal, 1.0])) for focal in (10.0, 20.0)])
    both = back_project(metres, cameras, 14, 2)
    torch.testing.assert_close(both[0, :, 0], 2 * both[1, :, 0])
    torch.testing.assert_close(both[1], back_project(metres[:1], cameras[1], 14, 2)[0])


def test_the_code_is_a_value_then_sines_then_cosines_of_doubling_frequency() -> None:
    embedding = PositionEmbedding3D(6, 8, 4)
    points = torch.rand((1, 2, 6), generator=torch.Generator().manual_seed(1)) * 4
    code = embedding.code(points)
    assert code.shape == (1, 2, 6 * 9)
    for axis in range(6):
        placed = (points[0, 1, axis] - (2 if axis % 3 == 2 else 0)) / 2
        angles = [placed * 2**k for k in range(4)]
        expected = torch.stack([placed, *(torch.sin(a) for a in angles), *(torch.cos(a) for a in angles)])
        torch.testing.assert_close(code[0, 1, 9 * axis : 9 * axis + 9], expected)
    assert embedding(points).shape == (1, 2, 8)


CONFIG = SpatialVLAConfig.from_json(config_values())


def picture(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def settings(folder: Path, **fields: Any) -> PictureSettings:
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessor_values(**fields)), encoding="utf-8")
    return PictureSettings.of(CONFIG, folder)


@pytest.mark.parametrize("shape", [(480, 640), (65, 40), (SIDE, SIDE), (100, 130)])
@pytest.mark.parametrize("fields", [{}, {"resample": 2}, {"do_normalize": True, "image_mean": [0.1, 0.5, 0.4]}])
def test_pixels_are_transformers_pil_processors_bit_for_bit(
    tmp_path: Path, shape: tuple[int, int], fields: dict[str, Any]
) -> None:
    from transformers import SiglipImageProcessorPil

    picture_settings = settings(tmp_path, **fields)
    theirs = SiglipImageProcessorPil(**{k: v for k, v in preprocessor_values(**fields).items() if "type" not in k})
    expected = np.asarray(theirs(picture(*shape), return_tensors="np")["pixel_values"][0])
    ours = prepare_picture(picture(*shape), picture_settings)
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours, expected)


def test_without_a_file_pictures_are_prepared_as_released(tmp_path: Path) -> None:
    assert PictureSettings.of(CONFIG, tmp_path) == settings(tmp_path)
    assert prepare_picture(picture(48, 64), PictureSettings(SIDE)).min() >= 0


@pytest.mark.parametrize(
    ("fields", "reason"),
    [({"side": 56}, "side 56"), ({"do_resize": False}, "side -1"), ({"resample": 17}, "resample is 17")],
)
def test_a_file_that_contradicts_the_model_is_refused(tmp_path: Path, fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(CheckpointError, match=reason):
        settings(tmp_path, **fields)


def test_a_camera_sees_the_same_point_in_the_same_part_of_the_squeezed_picture() -> None:
    camera = known_cameras(processor_values(), "file")["default"]
    point = np.array([0.1, -0.2, 0.9])
    pixel = camera.matrix @ point / point[2]
    squeezed = camera.at(224) @ point / point[2]
    np.testing.assert_allclose(squeezed[:2] / 224, pixel[:2] / [640, 480], rtol=1e-6)


def test_a_matrix_that_is_no_cameras_is_refused() -> None:
    broken = {"default": {"width": 4, "height": 3, "intrinsic": [[0, 0, 1], [0, 1, 1], [0, 0, 1]]}}
    with pytest.raises(CheckpointError, match="intrinsic_config of default"):
        known_cameras({"intrinsic_config": broken}, "file")


AXES = ("theta", "phi", "r", "roll", "pitch", "yaw")
GAUSSIANS = {axis: {"mu": 0.1 * index, "sigma": 0.3} for index, axis in enumerate(AXES)}


def bins(**fields: Any) -> ActionBins:
    return ActionBins.of(processor_values(**fields), FIRST_ACTION, BINS["total"], "file")


def test_the_three_slots_follow_each_other_and_end_the_vocabulary() -> None:
    movement, rotation, gripper = bins().slots
    assert (len(movement), len(rotation), len(gripper)) == (24, 12, 2)
    assert (movement.start, rotation.start, gripper.start) == (FIRST_ACTION, movement.stop, rotation.stop)
    assert gripper.stop == FIRST_ACTION + BINS["total"]


def test_every_rotation_and_gripper_id_is_found_again_from_its_value() -> None:
    action_bins = bins()
    ids = np.array([[action_bins.slots[0][0], r, g] for r in action_bins.slots[1] for g in action_bins.slots[2]])
    np.testing.assert_array_equal(action_bins.ids(action_bins.values(ids))[:, 1:], ids[:, 1:])


def test_every_movement_that_no_edge_cuts_off_is_found_again_from_its_value() -> None:
    action_bins = bins()
    ids = np.array([[m, action_bins.slots[1][0], action_bins.slots[2][0]] for m in action_bins.slots[0]])
    values = action_bins.values(ids)
    inside = (np.abs(values[:, :3]) < 1).all(axis=1)
    assert inside.sum() == 12  # the inner of two radii
    np.testing.assert_array_equal(action_bins.ids(values)[inside], ids[inside])


def test_a_movement_is_direction_and_length() -> None:
    """Straight up, by hand: the smallest polar angle, the smaller radius."""
    action_bins = bins()
    theta, phi, radius = action_bins.edges[:3]
    middles = [(edges[0] + edges[1]) / 2 for edges in (theta, phi, radius)]
    expected = middles[2] * np.array(
        [np.sin(middles[0]) * np.cos(middles[1]), np.sin(middles[0]) * np.sin(middles[1]), np.cos(middles[0])]
    )
    ids = np.array([slot.start for slot in action_bins.slots])
    np.testing.assert_allclose(action_bins.values(ids)[:3], np.clip(expected, -1, 1))
    second_radius = action_bins.values(ids + np.array([1, 0, 0]))[:3]
    assert np.linalg.norm(second_radius) > np.linalg.norm(expected)


def test_an_id_outside_its_slot_counts_as_the_nearest_and_is_not_known() -> None:
    action_bins = bins()
    inside = np.array([slot[0] for slot in action_bins.slots])
    below, above = np.array([0, 0, 0]), np.array([slot[-1] for slot in action_bins.slots])
    np.testing.assert_array_equal(action_bins.values(below), action_bins.values(inside))
    np.testing.assert_array_equal(action_bins.values(above + 100), action_bins.values(above))
    assert action_bins.is_action(inside).all()
    assert not action_bins.is_action(below).any()
    assert action_bins.is_action(np.stack([inside, inside[::-1]])).tolist() == [[True] * 3, [False, True, False]]


def test_the_gripper_is_closed_or_open() -> None:
    action_bins = bins()
    for value, expected in ((-1, 0), (0.49, 0), (0.5, 1), (1, 1)):
        values = action_bins.values(action_bins.ids(np.array([0.1, 0.2, 0.3, 0, 0, 0, value])))
        assert values[6] == expected


def test_where_edges_are_absent_they_come_from_the_gaussians() -> None:
    action_bins = bins(bin_policy=None, gs_params=GAUSSIANS)
    for edges, (axis, shape) in zip(action_bins.edges, GAUSSIANS.items(), strict=True):
        mass = np.diff(norm.cdf(edges, shape["mu"], shape["sigma"]))
        np.testing.assert_allclose(mass, mass[0], rtol=1e-6, err_msg=axis)
    assert action_bins.edges[0][0] == 0
    assert action_bins.edges[1][-1] == pytest.approx(np.pi)


def test_a_floor_of_the_deviation_is_kept() -> None:
    narrow = {axis: {**shape, "sigma": 0.01} for axis, shape in GAUSSIANS.items()}
    floored = bins(bin_policy=None, gs_params=narrow, min_sigma=0.3)
    np.testing.assert_allclose(floored.edges[3], equal_mass_edges(0.3, 0.3, -1, 1, 2))


def test_even_edges_have_to_be_asked_for() -> None:
    even = {**processor_values()["action_config"], "distribution": "uniform"}
    np.testing.assert_allclose(bins(bin_policy=None, action_config=even).edges[4], [-1, -1 / 3, 1 / 3, 1])
    with pytest.raises(CheckpointError, match="neither bin_policy nor gs_params for theta"):
        bins(bin_policy=None)


def test_axes_may_be_cartesian() -> None:
    plain = {**processor_values()["action_config"], "use_spherical": False}
    action_bins = bins(action_config=plain)
    ids = np.array([slot.start for slot in action_bins.slots])
    expected = [(edges[0] + edges[1]) / 2 for edges in action_bins.edges[:3]]
    np.testing.assert_allclose(action_bins.values(ids)[:3], np.clip(expected, -1, 1))


def test_bins_of_another_checkpoint_are_refused() -> None:
    with pytest.raises(CheckpointError, match="make 38 action tokens"):
        ActionBins.of(processor_values(), FIRST_ACTION, 8194, "file")
    more = {**BINS, "rotation": {**BINS["rotation"], "yaw_bins": 5}}
    with pytest.raises(CheckpointError, match="yaw has edges"):
        bins(action_config={**processor_values()["action_config"], "num_bins": more})
    with pytest.raises(CheckpointError, match="no number of bins for translation"):
        bins(action_config={})


def test_the_stored_edges_are_those_of_the_gaussians_beside_them(golden_spatialvla: Path) -> None:
    values = json.loads((golden_spatialvla / "checkpoint" / "processor_config.json").read_text(encoding="utf-8"))
    model = json.loads((golden_spatialvla / "checkpoint" / "config.json").read_text(encoding="utf-8"))
    first, actions = model["action_token_begin_idx"], model["spatial_token_num"]
    action_bins = ActionBins.of(values, first, actions, "golden")
    gaussian = ActionBins.of({k: v for k, v in values.items() if k != "bin_policy"}, first, actions, "golden")
    for ours, stored in zip(gaussian.edges, action_bins.edges, strict=True):
        np.testing.assert_allclose(ours, stored, rtol=0, atol=1e-12)
