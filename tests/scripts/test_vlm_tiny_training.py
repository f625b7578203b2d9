"""The parts of the VLM's training that could go wrong without a sign."""

from pathlib import Path

import numpy as np
import pytest
import torch
from vlm_tiny_training import pictures
from vlm_tiny_training.batches import Pair, Pairs, laid_out
from vlm_tiny_training.painting import Surface, calibrate, sheet
from vlm_tiny_training.pictures import PictureBank
from vlm_tiny_training.reading import Asked, Asks, Learner, ask
from vlm_tiny_training.training import Stage, Trainer
from vlm_tiny_training.window import model_view

from probe_kit.env import Act2AnswerEnv, SceneSpec
from probe_kit.env.act2answer import Question
from probe_kit.env.scene import SIDES
from probe_kit.hooks.families.embedded import new_vlm_tiny, write_vlm_tiny

pytestmark = pytest.mark.slow

PRESETS = ("bridge", "act2answer")
LETTERS = {("A", True): 0, ("A", False): 1, ("B", True): 1, ("B", False): 0}
"""The side (0 left) by the letter and whether left is named first."""


@pytest.fixture(scope="module")
def surfaces() -> dict[str, Surface]:
    return {name: calibrate(SceneSpec.preset(name)) for name in PRESETS} | {"sheet": sheet(480, 560)}


@pytest.fixture(scope="module")
def banks(surfaces: dict[str, Surface]) -> list[PictureBank]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "EVALUATION_COUPLES", 1)
        return [PictureBank.drawn(name, 77, 6, surfaces, lambda _: None) for name in ("color", "state")]


@pytest.fixture(scope="module")
def pairs(banks: list[PictureBank]) -> Pairs:
    return Pairs(banks, {"color": 0.5, "state": 0.5})


@pytest.mark.parametrize("preset", PRESETS)
def test_a_painted_first_frame_looks_like_a_rendered_one(preset: str, surfaces: dict[str, Surface]) -> None:
    env = Act2AnswerEnv(SceneSpec.preset(preset))
    env.reset(seed=0)
    rendered = model_view(env.scene.frame().picture).astype(np.float32)
    env.close()
    painted = surfaces[preset].background.copy()
    for side, area in zip(SIDES, surfaces[preset].places, strict=True):
        painted[area.rows, area.columns] += area.paint(Question.built_in().pictures[side])
    assert 10 * np.log10(255**2 / np.mean((painted - rendered) ** 2)) > 45


def test_pictures_of_the_evaluation_split_are_refused(
    surfaces: dict[str, Surface], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "EVALUATION_COUPLES", 1)
    with pytest.raises(ValueError, match="evaluation split"):
        PictureBank.drawn("color", 0, 1, surfaces, lambda _: None)


def test_the_asked_picture_lies_on_the_asked_side(pairs: Pairs, surfaces: dict[str, Surface]) -> None:
    rng = np.random.default_rng(0)
    for name, surface in surfaces.items():
        pair = pairs.draw(rng)
        turned = Pair(pair.bank, pair.pictures[::-1], pair.phrases[::-1])
        for side in (0, 1):
            np.testing.assert_array_equal(
                laid_out(name, surface, pair, side), laid_out(name, surface, turned, 1 - side)
            )
        assert np.any(laid_out(name, surface, pair, 0) != laid_out(name, surface, pair, 1))


def test_answers_are_true_in_whatever_order_the_sides_are_named(pairs: Pairs) -> None:
    rng = np.random.default_rng(0)
    answers = set()
    for _ in range(60):
        pair, side = pairs.draw(rng), int(rng.integers(2))
        for kind in ("p1", "p2"):
            drawn_question = ask(kind, pair, pairs, side, rng)
            assert pair.phrases[0] in drawn_question.question
            assert LETTERS[drawn_question.answer, "A left" in drawn_question.question] == side
            answers.add((drawn_question.answer, side))
        spoken = ask("seen", pair, pairs, side, rng)
        if spoken.answer == "No":
            assert not any(f"the {phrase}?" in spoken.question for phrase in pair.phrases)
        else:
            assert spoken.answer == f"Yes, {('left', 'right')[side]}"
        described = ask("describe", pair, pairs, side, rng)
        assert (described.answer == pair.phrases[0], ("left", "right")[side] in described.question) == (True, True)
    assert answers == {("A", 0), ("A", 1), ("B", 0), ("B", 1)}


def test_both_pictures_of_a_pair_are_called_what_they_show(pairs: Pairs) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        pair = pairs.draw(rng)
        assert tuple(str(pair.bank.phrases[picture_index]) for picture_index in pair.pictures) == pair.phrases
        assert pairs.absent(pair, rng) not in pair.phrases


@pytest.fixture
def learner(tmp_path: Path, pairs: Pairs, surfaces: dict[str, Surface]) -> Learner:
    network = new_vlm_tiny(0)
    write_vlm_tiny(tmp_path / "start", network, "random, seed 0")
    return Learner(network, tmp_path / "start" / "tokenizer.json", pairs, surfaces)


def test_a_longer_neighbour_changes_no_answer(
    learner: Learner, pairs: Pairs, surfaces: dict[str, Surface]
) -> None:
    pair = pairs.draw(np.random.default_rng(0))
    picture = laid_out("sheet", surfaces["sheet"], pair, 0)[None]
    short, long = Asked("Put the cube on the star", "left"), Asked("Do you see the star? Answer yes or no.", "No")
    with torch.no_grad():
        alone = [float(learner.loss(picture, [sample])) for sample in (short, long)]
        together = float(learner.loss(np.repeat(picture, 2, 0), [short, long]))
    assert together == pytest.approx(np.mean(alone), abs=1e-5)


def test_training_resumed_gives_the_weights_of_training_in_one_go(learner: Learner, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    start = {name: tensor.clone() for name, tensor in learner.network.state_dict().items()}
    stages = (
        Stage(1, 1e-3, Asks({"place": 1.0}, heads=True), warm_up=1),
        Stage(1, 1e-3, Asks({"seen": 1.0}), warm_up=1),
    )

    def train(stages: tuple[Stage[Asks], ...], path: Path) -> dict[str, torch.Tensor]:
        learner.network.load_state_dict(start)
        for losses in Trainer(learner, stages, 0, path).steps():
            assert all(np.isfinite(value) for value in losses.values())
        return {name: tensor.clone() for name, tensor in learner.network.state_dict().items()}

    uninterrupted = train(stages, tmp_path / "whole.pt")
    train(stages[:1], tmp_path / "halves.pt")
    resumed = train(stages, tmp_path / "halves.pt")
    assert all(torch.equal(uninterrupted[name], resumed[name]) for name in uninterrupted)
