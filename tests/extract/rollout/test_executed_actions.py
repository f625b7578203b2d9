"""What is executed of a chunk: its head or a mean, with the rotation that the controller is given."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probe_kit.env.rotations import from_euler_xyz
from probe_kit.extract.rollout.controllers import executed_actions, with_rotation_vectors
from probe_kit.intervene.rollout import executed

# 1 % and 99 % quantiles of BridgeData V2's rotations, in radians.
LOW, HIGH = np.array([-0.0809, -0.0929, -0.2072]), np.array([0.0819, 0.0779, 0.2038])


def chunk(seed: int, length: int = 4) -> Any:
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.3, 0.3, (length, 7)).astype(np.float32)


def test_axis_times_angle_is_that_of_the_same_turn() -> None:
    """scipy's lower-case "xyz" turns about fixed axes, as transforms3d's default "sxyz" does."""
    actions = chunk(0, 50)
    found = with_rotation_vectors(actions)
    turns = Rotation.from_euler("xyz", actions[:, 3:6].astype(np.float64))
    np.testing.assert_allclose(found[:, 3:6], turns.as_rotvec(), atol=1e-7)
    np.testing.assert_array_equal(np.delete(found, range(3, 6), axis=1), np.delete(actions, range(3, 6), axis=1))
    np.testing.assert_array_equal(actions, chunk(0, 50))
    assert found.dtype == np.float32


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
    found = executed_actions(past, 2, exponent, rotation)
    np.testing.assert_array_equal(executed(cast(Any, session), past), found)
    assert found.shape == ((2, 7) if exponent is None else (1, 7))
    head = executed_actions(past, 2, exponent)
    if rotation == "roll-pitch-yaw":
        np.testing.assert_array_equal(found, head)
    else:
        np.testing.assert_array_equal(found, with_rotation_vectors(head))
