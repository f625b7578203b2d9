"""Recording the trajectory of an episode while it runs."""

import numpy as np
from numpy.typing import ArrayLike

from probe_kit.env.act2answer import Act2AnswerEnv
from probe_kit.env.rotations import Array
from probe_kit.env.scene import SIDES, Scene
from probe_kit.env.scoring.trajectory import LED_TO, Trajectory


class Recorder:
    """Notes the state of an environment, now and after every action. Looking changes nothing in the simulator.

    env: an Act2AnswerEnv that was just reset, wrapped or not.
    """

    def __init__(self, env: Act2AnswerEnv) -> None:
        self._env: Act2AnswerEnv = env.unwrapped
        self._frames = [np.concatenate([_state(self._env.scene), np.full(LED_TO, np.nan)])]

    def note(self, commanded: ArrayLike) -> None:
        """After an action (7,) was executed."""
        trial = self._env.trial
        assert trial.executed is not None
        command = np.asarray(commanded, np.float64)
        self._frames.append(np.concatenate([_state(trial.scene), command, trial.executed, [trial.ik_error]]))

    def trajectory(self) -> Trajectory:
        """Return the trajectory up to the last noted action."""
        return Trajectory.of_frames(np.asarray(self._frames, np.float32))


def _state(scene: Scene) -> Array:
    """The state part of a frame; see `trajectory.STATE`."""
    cube, tiles = scene.cube_state(), [scene.tile_state(side) for side in SIDES]
    return np.array(
        [
            *scene.arm.tool_state(),
            scene.arm.opening(),
            *cube.position,
            *cube.quaternion,
            cube.speed,
            *(value for tile in tiles for value in (*tile.position, *tile.quaternion)),
            *_finger_forces(scene),
            scene.is_grasped(),
            *(scene.touches_tile(side) for side in SIDES),
        ],
        np.float64,
    )


def _finger_forces(scene: Scene) -> list[float]:
    """Newtons with which each finger presses on the cube, summed over the points of contact."""
    contacts = scene.client.getContactPoints(bodyA=scene.arm.body, bodyB=scene.cube)
    return [sum(contact[9] for contact in contacts if contact[3] == finger) for finger in scene.arm.model.fingers]
