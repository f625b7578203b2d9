"""The controllers of models: executed actions, lost words, and the examples whose prompts are measured."""

import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace

from probe_kit.env import SceneSpec
from probe_kit.env.rotations import from_euler_xyz
from probe_kit.env.simulation import Camera
from probe_kit.errors import InstructionError, UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.extract.rollout.controllers import (
    PolicyController,
    Turn,
    count_lost_words,
    ensemble,
    executed_actions,
    with_rotation_vectors,
)
from probe_kit.extract.rollout.tasks import check_reachable, fit_source
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.scene_source import SceneSource
from probe_kit.extract.states import Decided
from probe_kit.hashing import derive_seed
from probe_kit.hooks import ModelCard, Observation, load_policy
from probe_kit.intervene.rollout import executed_chunk
from probe_kit.runs.plan import Row
from probe_kit.suite import Suite
from tests.hooks.families.spatialvla.checkpoints import write_checkpoint

# 1 % and 99 % quantiles of BridgeData V2's rotations, in radians.
LOW, HIGH = np.array([-0.0809, -0.0929, -0.2072]), np.array([0.0819, 0.0779, 0.2038])


def chunk(seed: int, length: int = 4) -> Any:
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.3, 0.3, (length, 7)).astype(np.float32)


def test_axis_times_angle_is_that_of_the_same_turn() -> None:
    """scipy's lower-case "xyz" turns about fixed axes, as transforms3d's default "sxyz" does."""
    actions = chunk(0, 50)
    converted = with_rotation_vectors(actions)
    turns = Rotation.from_euler("xyz", actions[:, 3:6].astype(np.float64))
    np.testing.assert_allclose(converted[:, 3:6], turns.as_rotvec(), atol=1e-7)
    np.testing.assert_array_equal(
        np.delete(converted, range(3, 6), axis=1), np.delete(actions, range(3, 6), axis=1)
    )
    np.testing.assert_array_equal(actions, chunk(0, 50))
    assert converted.dtype == np.float32


def test_no_turn_stays_no_turn_and_one_axis_stays_its_angle() -> None:
    actions = np.zeros((4, 7), np.float32)
    actions[1:, 3:6] = np.diag([0.2, -0.1, 0.05])
    np.testing.assert_allclose(with_rotation_vectors(actions), actions, atol=1e-9)


def test_the_released_conversion_moves_the_turn_by_a_few_percent() -> None:
    """Read by the controller of the scene act2answer; what docs/paper.md says of the size."""
    angles = np.random.default_rng(0).uniform(LOW, HIGH, (500, 3))
    actions = np.zeros((500, 7), np.float32)
    actions[:, 3:6] = angles
    apart = [
        Rotation.from_matrix(from_euler_xyz(plain).T @ from_euler_xyz(converted)).magnitude()
        / Rotation.from_matrix(from_euler_xyz(plain)).magnitude()
        for plain, converted in zip(angles, with_rotation_vectors(actions)[:, 3:6], strict=True)
    ]
    assert 0.02 < np.mean(apart) < 0.03


@pytest.mark.parametrize("rotation", ["roll-pitch-yaw", "axis-angle"])
@pytest.mark.parametrize("exponent", [None, 0.8])
def test_a_replayed_episode_executes_what_the_run_did(rotation: Any, exponent: float | None) -> None:
    past = [chunk(seed) for seed in range(3)]
    settings = {"execute": 2} | ({"rotation": rotation} if rotation == "axis-angle" else {})
    session = SimpleNamespace(
        run=SimpleNamespace(settings=settings), policy=SimpleNamespace(card=SimpleNamespace(ensemble=exponent))
    )
    replayed = executed_actions(past, 2, exponent, rotation)
    np.testing.assert_array_equal(executed_chunk(cast(Any, session), past), replayed)
    assert replayed.shape == ((2, 7) if exponent is None else (1, 7))
    head = executed_actions(past, 2, exponent)
    if rotation == "roll-pitch-yaw":
        np.testing.assert_array_equal(replayed, head)
    else:
        np.testing.assert_array_equal(replayed, with_rotation_vectors(head))


def chunks(*firsts: float) -> list[np.ndarray]:
    """Chunks of three actions whose x counts up from the given number."""
    return [
        np.array([[first + step, 0, 0, 0, 0, 0, first > 1] for step in range(3)], np.float32) for first in firsts
    ]


def test_every_chunk_speaks_through_the_action_it_planned_for_now() -> None:
    weights = np.exp(0.8 * np.arange(3))
    expected = (weights * [10 + 2, 20 + 1, 30]).sum() / weights.sum()
    assert ensemble(chunks(10, 20, 30), 0.8)[0] == pytest.approx(expected, rel=1e-6)
    assert ensemble(chunks(10, 20, 30), 0.0)[0] == pytest.approx((12 + 21 + 30) / 3)


def test_the_first_step_has_one_plan_and_chunks_too_old_have_none() -> None:
    np.testing.assert_array_equal(ensemble(chunks(5), 0.8), chunks(5)[0][0])
    np.testing.assert_array_equal(ensemble(chunks(1000, 10, 20, 30), 0.8), ensemble(chunks(10, 20, 30), 0.8))


def test_the_gripper_stays_open_or_closed() -> None:
    assert ensemble(chunks(2, 2, 0), 0.0)[6] == 1
    assert ensemble(chunks(2, 0, 0), 0.0)[6] == 0
    assert ensemble(chunks(2, 0), 0.8)[6] == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
def test_an_episode_is_played_by_the_mean_of_its_plans(
    tmp_path: Path, observation: Observation, small_suite: Suite
) -> None:
    checkpoint = str(write_checkpoint(tmp_path))
    policy = load_policy("spatialvla", checkpoint, ensemble="true", constrained=True, camera="default")
    spatialvla_settings = ExtractSettings(
        "spatialvla", checkpoint, suite=small_suite.folder, categories=("color",), items=2
    )
    source = spatialvla_settings.source.open()
    controller = PolicyController(policy, source, spatialvla_settings)
    past: list[np.ndarray] = []
    planned: list[np.ndarray] = []
    for call in range(3):
        rolled = replace(observation, image=np.roll(observation.image, call, axis=1))
        turn = Turn(rolled, Row(0, {"policy_seed": 5}), call + 1, cast(Any, None), past)
        executed = controller.infer([turn])[0].actions
        planned.append(policy.act([rolled], [derive_seed(5, "inference", call + 1)])[0])
        np.testing.assert_array_equal(executed, ensemble(planned, 0.8)[None])
    assert len(past) == 3
    spatialvla_settings = spatialvla_settings.changed(execute=2)
    with pytest.raises(UsageError, match="needs an inference per action"):
        check_reachable(Decided(spatialvla_settings), policy.card, source)
    check_reachable(Decided(spatialvla_settings.changed(execute=None)), policy.card, source)


WORDS = ["put", "the", "cube", "on", "the", "black", "shape"]
TEMPLATE = "what to do : {} ?"


def tokenizer(most: int | None) -> Tokenizer:
    """Of whole words; most: tokens that it keeps."""
    vocabulary = dict.fromkeys([*TEMPLATE.format(" ".join(WORDS)).split(), "[UNK]"])
    built = Tokenizer(WordLevel({word: index for index, word in enumerate(vocabulary)}, unk_token="[UNK]"))
    built.pre_tokenizer = Whitespace()
    if most is not None:
        built.enable_truncation(most)
    return built


@pytest.mark.parametrize("framed", [False, True], ids=["bare", "in a frame"])
@pytest.mark.parametrize("lost", range(len(WORDS) - 1))
def test_the_words_behind_a_cut_are_counted(lost: int, framed: bool) -> None:
    before = TEMPLATE.split("{")[0].split() if framed else []
    cut = tokenizer(len(before) + len(WORDS) - lost)

    def pack(text: str) -> list[int]:
        return list(cut.encode(TEMPLATE.format(text) if framed else text).ids)

    if not lost:
        assert count_lost_words(pack, " ".join(WORDS)) == 0
        return
    with pytest.warns(UserWarning, match="the last words of an instruction do not reach its network"):
        assert count_lost_words(pack, " ".join(WORDS)) == lost


def test_an_instruction_that_is_whole_or_of_unknown_length_loses_no_words() -> None:
    full_tokenizer = tokenizer(None)
    texts = []

    def refuse(text: str) -> list[int]:
        texts.append(text)
        if len(texts) > 1:
            raise InstructionError("too short")
        return [1]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert count_lost_words(lambda text: list(full_tokenizer.encode(text).ids), " ".join(WORDS)) == 0
        assert count_lost_words(lambda _text: None, " ".join(WORDS)) == 0
        assert count_lost_words(lambda _text: [1], "put") == 0
        assert count_lost_words(refuse, " ".join(WORDS)) == 0
    assert len(texts) == 2


CARD = ModelCard("mine", "none", "0" * 64, True, 1, "float32", "cpu", "none", ("primary",), 1, 1)


def test_an_example_has_the_scenes_picture_size_and_its_intrinsics(small_suite: Suite) -> None:
    scene = SceneSpec(picture_size=(320, 120))
    example = SceneSource(SceneSettings(scene=scene), small_suite).example("Put the cube on the star")
    assert (example.image.shape, example.instruction) == ((120, 320, 3), "Put the cube on the star")
    np.testing.assert_array_equal(example.intrinsics, scene.intrinsics)


def test_intrinsics_project_as_the_camera_does_whatever_the_picture_size() -> None:
    scene = SceneSpec(picture_size=(320, 120))
    camera = Camera(scene.camera)
    points = np.array([[0.3, 0.1, 0.0], [0.4, -0.1, 0.05]])
    x, y, z = ((points - scene.camera.eye) @ camera.axes.T).T
    homogeneous = scene.intrinsics @ np.stack([x / z, -y / z, np.ones_like(x)])
    expected = camera.project(points) * [320 / scene.camera.width, 120 / scene.camera.height]
    np.testing.assert_allclose(homogeneous[:2].T, expected, rtol=1e-5)


def test_a_batch_that_changes_numbers_and_a_camera_that_is_not_there_are_refused(small_suite: Suite) -> None:
    source, requested = SceneSource(SceneSettings(scene=SceneSpec()), small_suite), ExtractSettings("pi0", batch=2)
    two, single = Decided(requested), Decided(requested.changed(batch=1))
    fit_source(replace(CARD, batch=1, needs=frozenset({"intrinsics", "state"})), single, source)
    with pytest.raises(UsageError, match="--batch 2 with mine, which takes at most 1"):
        fit_source(replace(CARD, batch=1), two, source)
    with pytest.raises(UsageError, match=r"reads camera\.wrist"):
        fit_source(replace(CARD, needs=frozenset({"camera.wrist"})), two, source)
