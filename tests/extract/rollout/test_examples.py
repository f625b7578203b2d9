from dataclasses import replace

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.env.simulation import Camera
from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.extract.rollout.tasks import fitted
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.scene_source import SceneSource
from probe_kit.hooks import ModelCard
from probe_kit.suite import Suite

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
    source, two = SceneSource(SceneSettings(scene=SceneSpec()), small_suite), ExtractSettings("pi0", batch=2)
    fitted(replace(CARD, batch=1, needs=frozenset({"intrinsics", "state"})), two.changed(batch=1), source)
    with pytest.raises(UsageError, match="--batch 2 with mine, which takes at most 1"):
        fitted(replace(CARD, batch=1), two, source)
    with pytest.raises(UsageError, match=r"reads camera\.wrist"):
        fitted(replace(CARD, needs=frozenset({"camera.wrist"})), two, source)
