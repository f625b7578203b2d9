"""Conversion of policy actions to joint angles, in the Bridge convention of SimplerEnv.

Deltas accumulate on the pose that was last *commanded*, not on the measured one, so that tracking errors do
not add up. The rotation delta turns about the fixed axes of the world, through the tool.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from probe_kit.env.robot.arm import Arm
from probe_kit.env.robot.kinematics import Pose
from probe_kit.env.rotations import Array, from_euler_xyz, from_rpy
from probe_kit.env.spec import Euler, LimitSpec
from probe_kit.errors import ActionError

ACTION_SIZE = 7
OPEN_ABOVE = 0.5


@dataclass(frozen=True)
class Move:
    """The motion that one action asks of the arm.

    q_from, q_to: (n,) commanded joints before and after. opening: 1 open, 0 closed.
    clipped: a limit changed the action. ik_error: metres that remain to the wanted position.
    shift, turn: (3,) metres and radians by which the commanded pose really moved, in the words of the action.
    """

    q_from: Array
    q_to: Array
    opening: float
    clipped: bool
    ik_error: float
    shift: Array
    turn: Array


def check_action(action: ArrayLike) -> Array:
    """The action as float64 (7,). Raises ActionError if it has another shape or is not finite."""
    try:
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(f"action {action!r} is not numeric; expected 7 finite numbers.") from error
    if values.shape != (ACTION_SIZE,):
        raise ActionError(
            f"action has shape {values.shape}; expected (7,): xyz delta, roll-pitch-yaw delta, gripper. "
            "Pass one action of a chunk at a time."
        )
    if not np.isfinite(values).all():
        raise ActionError(
            f"action {values.tolist()} is not finite (NaN or infinity); the environment did not move."
        )
    return values


class DeltaController:
    """Keeps the commanded tool pose `target` and joints `q`, and moves both by one action at a time.

    euler: how the rotation of an action is read, see `SceneSpec`.
    """

    def __init__(self, arm: Arm, limits: LimitSpec, q: Array, euler: Euler = "zyx") -> None:
        self._arm = arm
        self._limits = limits
        floor = (-np.inf, -np.inf, arm.model.clearance)
        self._low = None if limits.low is None else np.maximum(limits.low, floor)
        self._rotation = from_euler_xyz if euler == "xyz" else from_rpy
        self.q = q
        self.target: Pose = arm.chain.pose(q)

    def command(self, action: Array) -> Move:
        """Advance the commanded pose by a checked action (7,), or hold it if the new one is out of reach."""
        limits = self._limits
        shift, turn = _within(action[:3], limits.translation), _within(action[3:6], limits.rotation)
        position = self.target.position + shift
        if self._low is not None or limits.high is not None:
            position = np.clip(position, self._low, limits.high)
        shift = position - self.target.position
        pose = Pose(position, self._rotation(turn) @ self.target.rotation)
        clipped = not np.allclose(shift, action[:3], atol=1e-9) or bool((turn != action[3:6]).any())

        q_from = self.q
        solution = self._arm.chain.solve(pose, q_from, np.array(self._arm.model.posture))
        if solution.error <= limits.ik_error and solution.turn_error <= limits.ik_turn_error:
            self.q, self.target = solution.q, pose
        else:
            shift, turn = np.zeros(3), np.zeros(3)
        opening = 1.0 if action[6] > OPEN_ABOVE else 0.0
        return Move(q_from, self.q, opening, clipped, solution.error, shift, turn)


def _within(values: Array, largest: float | None) -> Array:
    return values if largest is None else np.clip(values, -largest, largest)
