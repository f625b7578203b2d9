"""The actions that are executed of the chunks of an episode, as the controller of the arm reads them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.rotations import from_rpy, to_vector
from probe_kit.hooks.contract.declared import PLAIN, Rotation

_TURN = slice(3, 6)
"""Roll, pitch and yaw among the seven numbers of an action."""
_GRIPPER_OPEN = 0.5
"""The number of an open gripper is 1, of a closed one 0."""


def executed_actions(
    chunks: Sequence[NDArray[np.float32]], execute: int, exponent: float | None, rotation: Rotation = PLAIN
) -> NDArray[np.float32]:
    """(n, 7) float32: what is executed after the newest of an episode's chunks (chunk, 7), oldest first.

    execute: actions of its head. exponent: of `ensemble`, which makes one action of all chunks; None to take the
    head. rotation: see `ProtocolRow.rotation`.
    """
    actions = chunks[-1][:execute] if exponent is None else ensemble(chunks, exponent)[None]
    return actions if rotation == PLAIN else with_rotation_vectors(actions)


def with_rotation_vectors(actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """A copy of actions (n, 7) with axis times angle, in radians, in place of roll, pitch and yaw.

    Axis and angle are those of R = Rz(yaw) Ry(pitch) Rx(roll), as `euler2axangle` of transforms3d gives them. The
    released evaluation converts so, and its controller reads the three numbers as Euler angles.
    """
    converted = actions.copy()
    converted[:, _TURN] = [to_vector(from_rpy(angles)) for angles in actions[:, _TURN].astype(np.float64)]
    return converted


def ensemble(chunks: Sequence[NDArray[np.float32]], exponent: float) -> NDArray[np.float32]:
    """(7,) float32: the action for this step, from the chunks (chunk, 7) of an episode's inferences, oldest first.

    There is an inference per step, so a chunk made n steps ago contributes its n-th action, and one that is too
    old not at all. Weights grow by e^exponent from each chunk to the next; the gripper is open or closed by their
    majority.
    """
    length = len(chunks[-1])
    # `reversed` counts ages from the newest chunk; the last [::-1] puts the oldest first again, as weights count.
    plans = np.array([chunk[age] for age, chunk in enumerate(reversed(chunks[-length:]))], np.float64)[::-1]
    weights = np.exp(exponent * np.arange(len(plans)))
    action = np.asarray(weights @ plans / weights.sum(), np.float32)
    action[-1] = action[-1] > _GRIPPER_OPEN
    return action
