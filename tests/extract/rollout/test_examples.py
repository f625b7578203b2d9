from dataclasses import replace

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.env.simulation.camera import Camera
from probe_kit.errors import UsageError
from probe_kit.extract.rollout.examples import check_unfit, example_observations
from probe_kit.hooks import ModelCard

CARD = ModelCard("mine", "none", "0" * 64, True, 1, "float32", "cpu", "none", ("primary",), 1, 1)


def test_examples_have_the_scenes_picture_size_and_its_intrinsics() -> None:
    asked = ["Put the cube on the star", "Put the cube on the moon"]
    examples = example_observations(SceneSpec(picture_size=(320, 120)), asked)
    assert {example.image.shape for example in examples} == {(120, 320, 3)}
    assert [example.instruction for example in examples] == asked


def test_intrinsics_project_as_the_camera_does_whatever_the_picture_size() -> None:
    scene = SceneSpec(picture_size=(320, 120))
    camera = Camera(scene.camera)
    points = np.array([[0.3, 0.1, 0.0], [0.4, -0.1, 0.05]])
    x, y, z = ((points - scene.camera.eye) @ camera.axes.T).T
    homogeneous = scene.intrinsics @ np.stack([x / z, -y / z, np.ones_like(x)])
    expected = camera.project(points) * [320 / scene.camera.width, 120 / scene.camera.height]
    np.testing.assert_allclose(homogeneous[:2].T, expected, rtol=1e-5)


def test_a_batch_that_changes_numbers_and_a_camera_that_is_not_there_are_refused() -> None:
    (example,) = example_observations(SceneSpec(), ["Put the cube on the star"])
    check_unfit(replace(CARD, batch=1, needs=frozenset({"intrinsics", "state"})), 1, example)
    with pytest.raises(UsageError, match="--batch 2 with mine, which takes at most 1"):
        check_unfit(replace(CARD, batch=1), 2, example)
    with pytest.raises(UsageError, match=r"reads camera\.wrist"):
        check_unfit(replace(CARD, needs=frozenset({"camera.wrist"})), 1, example)
