"""The parts of the training that could go wrong without a sign."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from pi0_tiny_training.batches import UNUSED, Sampler, without_pictures
from pi0_tiny_training.demonstrations import Demonstrations, Recorder, Recording
from pi0_tiny_training.heads import Heads
from pi0_tiny_training.painting import Brush, calibrate
from pi0_tiny_training.pictures import EVALUATION_SEED, PictureBank
from pi0_tiny_training.training import STEADY, Stage, Trainer
from pi0_tiny_training.window import seen_by_policy

from probe_kit.env import SceneSpec
from probe_kit.env.scene import SIDES, Scene
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.pi0_tiny import ACTION_DIMS, GUESSED, new_pi0_tiny, write_checkpoint
from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.couples import draw_couples


@pytest.fixture(scope="module")
def brushes() -> tuple[Brush, Brush]:
    return calibrate(SceneSpec())


@pytest.fixture(scope="module")
def twins() -> Demonstrations:
    recorder = Recorder(Recording(range(1), start_grasped=True))
    demonstrations = recorder.twins(seed=1)
    recorder.close()
    assert demonstrations is not None
    return demonstrations


@pytest.fixture(scope="module")
def banks(brushes: tuple[Brush, Brush]) -> list[PictureBank]:
    return [PictureBank.drawn(category, 77, 20, brushes, lambda _: None) for category in ("color", UNUSED)]


@pytest.fixture
def policy(tmp_path: Path) -> Pi0:
    write_checkpoint(tmp_path / "start", new_pi0_tiny(0), GUESSED, "random, seed 0")
    return Pi0.load(str(tmp_path / "start"))


def test_a_painted_tile_looks_like_a_rendered_one(brushes: tuple[Brush, Brush]) -> None:
    spec = SceneSpec()
    scene = Scene(spec)
    couple = next(draw_couples(GENERATORS["color"], 5))
    pictures = couple.left_tile.draw(), couple.right_tile.draw()
    scene.reset(dict(zip(SIDES, pictures, strict=True)), (*spec.cube_xy, spec.cube_side / 2), spec.cube_yaw)
    frame = scene.frame()
    rendered = seen_by_policy(scene.picture(frame)).astype(np.float32)
    shown = [seen_by_policy(255 * np.uint8(frame.bodies == scene.quads[side])) for side in SIDES]
    scene.close()
    for brush, picture, mask in zip(brushes, pictures, shown, strict=True):
        box = brush.rows, brush.columns
        inside = mask[box] == 255
        error = (brush.paint(picture) - rendered[box])[inside]
        assert 10 * np.log10(255**2 / np.mean(error**2)) > 38


def test_twins_are_equal_until_they_part(twins: Demonstrations) -> None:
    left, right = (np.flatnonzero(twins.side == side) for side in (0, 1))
    deciding = int(twins.deciding[left].sum())
    np.testing.assert_array_equal(twins.states[left[:deciding]], twins.states[right[:deciding]])
    assert np.any(twins.chunks[left[0]] != twins.chunks[right[0]])


def test_only_the_dimensions_the_policy_decides_are_labelled(twins: Demonstrations) -> None:
    assert set(np.flatnonzero(twins.chunks.any((0, 1)))) <= set(ACTION_DIMS)


def test_pictures_of_the_evaluation_split_are_refused(brushes: tuple[Brush, Brush]) -> None:
    with pytest.raises(ValueError, match="evaluation split"):
        PictureBank.drawn("color", EVALUATION_SEED, 2, brushes, lambda _: None)


def test_a_pair_of_concepts_finds_its_tiles_either_way_round(banks: list[PictureBank]) -> None:
    for bank in banks:
        for members in bank.by_pair():
            first = {bank.texts[couple, 0 ^ turned] for couple, turned in members}
            assert len(first) == 1


def test_the_instruction_names_the_tile_on_the_side_of_the_demonstration(
    twins: Demonstrations, banks: list[PictureBank], brushes: tuple[Brush, Brush], policy: Pi0
) -> None:
    names = list(dict.fromkeys(couple for couple in GENERATORS["color"].pairs))
    colors = {concept.phrase.split()[0] for pair in names for concept in pair}
    sampler = Sampler(without_pictures(twins, brushes), banks[:1], [1.0], brushes, policy)
    batch = sampler.batch(np.random.default_rng(0), 16, 0.5, by_lot=False)
    from probe_kit.suite.generators.palette import COLORS

    assert colors == set(COLORS)
    for text, side, shown in zip(batch.texts, batch.side, batch.concepts, strict=True):
        assert list(COLORS)[int(shown[side, 0])] in text.split()


def test_the_unused_category_moves_to_either_side_by_lot(
    twins: Demonstrations, banks: list[PictureBank], brushes: tuple[Brush, Brush], policy: Pi0
) -> None:
    sampler = Sampler(without_pictures(twins, brushes), banks[1:], [1.0], brushes, policy)
    batch = sampler.batch(np.random.default_rng(0), 200, 1.0, by_lot=True)
    went_right = batch.chunks[..., 1].sum(1) < batch.chunks[..., 1].sum(1).median()
    agreement = float((went_right.long() == batch.side).float().mean())
    assert 0.35 < agreement < 0.65
    assert not batch.used.any()


def test_training_resumed_gives_the_weights_of_training_in_one_go(
    twins: Demonstrations, banks: list[PictureBank], brushes: tuple[Brush, Brush], policy: Pi0, tmp_path: Path
) -> None:
    sampler = Sampler(without_pictures(twins, brushes), banks, [1.0, 1.0], brushes, policy)
    torch.set_num_threads(1)
    stages = tuple(Stage(1, 1e-3, lot, deciding=0.5, deciding_at_end=0.5, warm_up=1) for lot in (False, True))
    start = {name: tensor.clone() for name, tensor in policy.network.model.state_dict().items()}

    def train(stages: tuple[Stage, ...], folder: Path) -> dict[str, torch.Tensor]:
        folder.mkdir(exist_ok=True)
        policy.network.model.load_state_dict(start)
        torch.manual_seed(0)
        trainer = Trainer(policy, Heads(brushes), {STEADY: sampler}, stages, 0, folder)
        for losses in trainer.steps():
            assert all(np.isfinite(value) for value in losses.values())
        return {name: tensor.clone() for name, tensor in policy.network.model.state_dict().items()}

    whole = train(stages, tmp_path / "whole")
    train(stages[:1], tmp_path / "halves")
    resumed = train(stages, tmp_path / "halves")
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    idle = [dimension for dimension in range(7) if dimension not in ACTION_DIMS]
    assert not whole["action_in_proj.weight"][:, idle].any()
    assert not whole["action_out_proj.weight"][idle].any()


def test_couples_of_the_training_seed_are_not_those_of_the_suite() -> None:
    one, other = (
        [couple.left_tile for couple in islice(draw_couples(GENERATORS["shape"], seed), 5)]
        for seed in (EVALUATION_SEED, 715_517)
    )
    assert one != other
