"""The parts of the policy's training that could go wrong without a sign."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from acting_training.acting import LEFT_OPEN, Actor, Acts, Followed, acting
from acting_training.carrying import OPENED, Carrying
from acting_training.checkpoint import measured_statistics, start_of_policy
from acting_training.demonstrations import Demonstrations, Recorder
from acting_training.frames import Frames
from safetensors.torch import load_file
from vlm_tiny_training import pictures
from vlm_tiny_training.batches import Pairs, laid_out
from vlm_tiny_training.painting import Surface, sheet
from vlm_tiny_training.pictures import PictureBank
from vlm_tiny_training.training import Stage, Trainer

from probe_kit.env.act2answer import Question
from probe_kit.env.scripted import MAX_SHIFT, OPEN
from probe_kit.hooks.families.embedded import ACTION_DIMS, CHUNK, IDLE_DIMS, IMAGE_SIDE
from probe_kit.models.embedded import embedded_checkpoint

SURFACE = "sheet"


@pytest.fixture(scope="module")
def surface() -> Surface:
    return sheet(480, 560)


@pytest.fixture(scope="module")
def banks(surface: Surface) -> list[PictureBank]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "EVALUATION_COUPLES", 1)
        drawn = {SURFACE: surface}
        return [PictureBank.drawn(name, 77, 3, drawn, lambda _: None) for name in ("color", LEFT_OPEN)]


@pytest.fixture(scope="module")
def demonstrations(surface: Surface) -> Demonstrations:
    """Two frames to each side, with the plain pictures of recordings on the sheet; nothing hides the last one."""
    frames, tiles = [], np.zeros((4, 2, IMAGE_SIDE, IMAGE_SIDE), np.uint8)
    for number, layout in enumerate(("original", "swapped", "original", "swapped")):
        picture = surface.background.copy()
        for side, (name, area) in enumerate(zip(("left", "right"), surface.places, strict=True)):
            picture[area.rows, area.columns] += area.paint(Question.built_in(layout).pictures[name])
            tiles[number, side, area.rows, area.columns] = np.rint(255 * area.cover)
        frames.append(picture.clip(0, 255).round())
    rng = np.random.default_rng(0)
    chunks = rng.normal(0, 0.02, (4, 2, CHUNK, 7)).astype(np.float32)
    chunks[..., list(IDLE_DIMS)] = 0
    states = rng.normal(0, 0.1, (4, 8)).astype(np.float32)
    side, first = np.array([0, 1, 0, 1], np.int8), np.array([True, True, False, False])
    return Demonstrations(np.array(frames, np.uint8), tiles, states, chunks, side, first)


@pytest.fixture
def actor(tmp_path: Path, demonstrations: Demonstrations, banks: list[PictureBank], surface: Surface) -> Actor:
    policy = start_of_policy(tmp_path / "start", 0, measured_statistics(demonstrations))
    pairs = Pairs(banks, {"color": 0.5, LEFT_OPEN: 0.5})
    return Actor(policy, pairs, Frames(SURFACE, surface, demonstrations))


def test_a_frame_shows_the_asked_picture_where_the_demonstration_goes(
    surface: Surface, demonstrations: Demonstrations, banks: list[PictureBank]
) -> None:
    frames, pairs = Frames(SURFACE, surface, demonstrations), Pairs(banks, {"color": 1.0})
    pair = pairs.draw(np.random.default_rng(0))
    for frame in range(4):
        for side in (0, 1):
            painted, clean = frames.painted(frame, pair, side), laid_out(SURFACE, surface, pair, side)
            assert np.abs(painted - clean).max() <= 1.5
    assert np.abs(frames.painted(0, pair, 0) - frames.painted(0, pair, 1)).max() > 20


def test_a_hidden_tile_takes_no_paint(
    surface: Surface, demonstrations: Demonstrations, banks: list[PictureBank]
) -> None:
    hidden = Demonstrations(**{**vars(demonstrations), "tiles": np.zeros_like(demonstrations.tiles)})
    pair = Pairs(banks, {"color": 1.0}).draw(np.random.default_rng(0))
    frames = Frames(SURFACE, surface, hidden)
    np.testing.assert_array_equal(frames.painted(0, pair, 0), demonstrations.pictures[0])


def test_the_share_of_first_frames_is_the_asked_one(surface: Surface, demonstrations: Demonstrations) -> None:
    frames, rng = Frames(SURFACE, surface, demonstrations), np.random.default_rng(0)
    assert demonstrations.first[frames.draw(rng, 1.0, 50)].all()
    assert 0.3 < demonstrations.first[frames.draw(rng, 0.0, 200)].mean() < 0.7


@pytest.mark.parametrize(("followed", "least", "most"), [("random", 0.35, 0.65), ("always", 1, 1)])
def test_the_category_that_is_left_open_is_followed_as_said(
    followed: Followed, least: float, most: float, banks: list[PictureBank]
) -> None:
    rng, setting = np.random.default_rng(0), Acts(0.5, 0.5, followed)
    for category, (low, high) in {LEFT_OPEN: (least, most), "color": (1, 1)}.items():
        pairs = Pairs(banks, {category: 1.0})
        shares = [Actor._side(rng, goes, pairs.draw(rng), setting) == goes for goes in [0, 1] * 100]
        assert low <= np.mean(shares) <= high


def test_branches_differ_only_in_what_is_followed() -> None:
    drawn, always = acting("random"), acting("always")
    assert drawn != always
    assert [replace(sample, setting=replace(sample.setting, followed="always")) for sample in drawn] == list(
        always
    )


def test_in_a_branch_actions_go_on_to_where_the_hand_is_on_its_way(actor: Actor, banks: list[PictureBank]) -> None:
    """Hands that changed their mind on the way let half of the lost cubes fall between the tiles."""
    rng, pairs = np.random.default_rng(0), Pairs(banks, {"color": 1.0})
    for stage in acting("always"):
        assert {actor._goes(rng, 1, pairs.draw(rng), stage.setting) for _ in range(50)} == {1}


def test_actions_turn_where_they_are_understood_and_never_at_random(
    actor: Actor, banks: list[PictureBank]
) -> None:
    """A lot drawn anew at every look would lead to and fro, and the cube to neither tile."""
    rng, setting = np.random.default_rng(0), Acts(0.5, 0.6, "random")
    for category, (low, high) in {"color": (0.15, 0.45), LEFT_OPEN: (0, 0)}.items():
        pairs = Pairs(banks, {category: 1.0})
        assert low <= np.mean([actor._goes(rng, 0, pairs.draw(rng), setting) for _ in range(200)]) <= high


def test_actions_that_are_not_followed_at_all_are_not_trained(actor: Actor, banks: list[PictureBank]) -> None:
    actor._pairs = Pairs(banks, {LEFT_OPEN: 1.0})
    torch.manual_seed(0)
    unacted = actor.losses(np.random.default_rng(0), Acts(0.5, 0.2, "not at all"), 4)
    torch.manual_seed(0)
    drawn = actor.losses(np.random.default_rng(0), Acts(0.5, 0.2, "random"), 4)
    assert float(unacted["flow"].detach()) == 0
    assert float(drawn["flow"].detach()) > 0.1
    assert float(unacted["said"].detach()) > 0


def test_the_backbone_begins_as_the_vlm_weight_by_weight(actor: Actor) -> None:
    vlm = load_file(embedded_checkpoint("vlm-tiny") / "model.safetensors")
    backbone = actor.network.paligemma_with_expert.paligemma.state_dict()
    assert set(backbone) - set(vlm) == {"lm_head.weight"}
    assert all(torch.equal(tensor, backbone[name]) for name, tensor in vlm.items())


@pytest.mark.slow
def test_the_words_after_an_instruction_name_the_side_that_the_vlm_answers(actor: Actor) -> None:
    """The VLM knew it before any training of the policy: a wrong position or prompt would leave chance."""
    torch.manual_seed(0)
    with torch.no_grad():
        said_loss = float(actor.losses(np.random.default_rng(0), Acts(0.5, 0.2, "random"), 48)["said"])
    assert said_loss < 0.3 * np.log(2) / 3


@pytest.mark.slow
def test_training_leaves_the_dimensions_deaf_that_are_not_decided(actor: Actor, tmp_path: Path) -> None:
    stages = (Stage(2, 1e-3, Acts(0.5, 0.2, "random"), warm_up=1),)
    before = actor.network.action_in_proj.weight.detach().clone()
    trainer = Trainer(actor, stages, 0, tmp_path / "state.pt", batch=4)
    assert len(list(trainer.steps())) == 2
    after = actor.network.action_in_proj.weight.detach()
    assert not after[:, list(IDLE_DIMS)].any()
    assert (after[:, list(ACTION_DIMS)] != before[:, list(ACTION_DIMS)]).any()
    assert not actor.network.action_out_proj.weight.detach()[list(IDLE_DIMS)].any()


def test_the_way_leads_to_the_tile_down_and_up_again_from_everywhere() -> None:
    way = Carrying(np.array([0.4, 0.18, 0.032]))
    rng = np.random.default_rng(0)
    for _ in range(20):
        start = np.array([0.3, 0.0, 0.13]) + rng.normal(0, (0.05, 0.1, 0.03))
        actions = way.ahead(start, opened=False, count=30)
        before_release = actions[: int((actions[:, 6] == OPEN).argmax())]
        assert np.linalg.norm(actions[:, :3], axis=1).max() <= MAX_SHIFT + 1e-6
        np.testing.assert_allclose(start + actions[:, :3].sum(0), way.goal, atol=1e-3)
        assert np.hypot(*(start + before_release[:, :3].sum(0) - way.goal)[:2]) < 0.02
        up = way.ahead(way.goal, opened=True, count=8)
        np.testing.assert_allclose(up[:, :2], 0, atol=1e-9)
        assert (up[:, 6] == OPEN).all()
        assert up[:, 2].sum() > 0.08


@pytest.mark.slow
def test_twins_begin_alike_and_end_on_either_tile() -> None:
    recorder = Recorder()
    twins = recorder.twins(seed=1)
    recorder.close()
    assert twins is not None
    left, right = (np.flatnonzero(twins.side == side) for side in (0, 1))
    np.testing.assert_array_equal(twins.states[left[0]], twins.states[right[0]])
    assert set(np.flatnonzero(twins.first)) == {left[0], right[0]}
    np.testing.assert_allclose(twins.chunks[left[0]], twins.chunks[right[0]])
    assert twins.chunks[left[0], 0, :4, 1].sum() > 0 > twins.chunks[left[0], 1, :4, 1].sum()
    assert set(np.flatnonzero(twins.chunks.any((0, 1, 2)))) <= set(ACTION_DIMS)
    assert (twins.states[[left[-1], right[-1]], 7] > OPENED).all()
