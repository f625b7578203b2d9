"""Rotations, and forward and inverse kinematics of a chain of revolute joints, in plain numpy.

PyBullet's own inverse kinematics is not used. It starts from the measured joints, so the answer depends on the
tracking error. With `currentPositions`, it is wrong for a base that is not at the origin.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from probe_kit._system.types import Matrix


def from_rpy(rpy: ArrayLike) -> Matrix:
    """Return the rotation matrix (3, 3) of roll, pitch, yaw (3,)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def from_euler_xyz(angles: ArrayLike) -> Matrix:
    """Return the rotation matrix (3, 3) of Euler angles "XYZ" (3,): R = Rx(first) Ry(second) Rz(third)."""
    return from_rpy(np.negative(angles)).T


def to_rpy(R: Matrix) -> Matrix:
    """Return roll, pitch, yaw (3,) of a rotation matrix (3, 3); at pitch = ±π/2 the roll is set to zero."""
    level = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], level)
    if level < 1e-6:
        return np.array([0.0, pitch, np.arctan2(-R[0, 1], R[1, 1])])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def to_vector(R: Matrix) -> Matrix:
    """Return the rotation vector (3,), axis times angle with angle in [0, π], of a rotation matrix (3, 3)."""
    twist = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = np.linalg.norm(twist), 0.5 * (np.trace(R) - 1.0)
    if sine > 1e-9:
        return np.asarray(twist * (np.arctan2(sine, cosine) / sine))
    if cosine > 0:
        return twist
    # A half turn: the antisymmetric part vanishes and the axis is a column of R + I.
    columns = R + np.eye(3)
    axis = columns[:, np.argmax(np.linalg.norm(columns, axis=0))]
    return np.asarray(np.pi * axis / np.linalg.norm(axis))


def yaw_quaternion(yaw: float) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a turn about +z."""
    return (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


# -- kinematics -----------------------------------------------------------------------------------------------

DAMPING = 0.02
"""Largest damping factor; it shrinks with the residual, so that the last steps are Newton steps."""
MAX_JOINT_STEP = 0.3
"""Largest joint change of one iteration, in radians."""
POSTURE_PULL = 0.05
"""Share of the way back to the resting posture per step in the null space, for chains of more than 6 joints."""
TOLERANCE = 1e-5
"""Residual (metres and radians together) at which the iteration stops."""


@dataclass(frozen=True)
class Pose:
    """A position (3,) in metres and a rotation matrix (3, 3), in the world frame."""

    position: Matrix
    rotation: Matrix


@dataclass(frozen=True)
class Solution:
    """Joint angles (n,) in radians, and the errors that remain to the target: metres and radians."""

    q: Matrix
    error: float
    turn_error: float


@dataclass(frozen=True)
class SerialChain:
    """A chain of n revolute joints, described by its screws at q = 0 in the world frame.

    Attributes:
        axes: (n, 3) unit axis of each joint.
        points: (n, 3) a point on each axis, in metres.
        tip: Pose of the tool at q = 0.
        lower: (n,) lower joint limits in radians.
        upper: (n,) upper joint limits in radians.
    """

    axes: Matrix
    points: Matrix
    tip: Pose
    lower: Matrix
    upper: Matrix

    def pose(self, q: Matrix) -> Pose:
        """Return the pose of the tool at joint angles q (n,)."""
        return self.pose_and_jacobian(q)[0]

    def solve(self, target: Pose, start: Matrix, posture: Matrix, iterations: int = 30) -> Solution:
        """Return joint angles that bring the tool to `target`, within the limits, by damped least squares.

        An unreachable target raises nothing: look at the errors of the solution.

        Args:
            target: Pose of the tool.
            start: (n,) joint angles of the start; with the last commanded angles, 2 or 3 iterations are enough.
            posture: (n,) joint angles to which a redundant chain drifts while it keeps the tool in place.
            iterations: Most iterations.
        """
        q = start
        for _ in range(iterations):
            pose, J = self.pose_and_jacobian(q)
            residual = _residual(target, pose)
            size = float(np.linalg.norm(residual))
            if size < TOLERANCE:
                break
            q = np.clip(q + self._step(J, residual, size, posture - q), self.lower, self.upper)
        remaining = _residual(target, self.pose(q))
        return Solution(q, float(np.linalg.norm(remaining[:3])), float(np.linalg.norm(remaining[3:])))

    def _step(self, J: Matrix, residual: Matrix, size: float, to_posture: Matrix) -> Matrix:
        damped = J @ J.T + min(DAMPING, size) ** 2 * np.eye(6)
        step = J.T @ np.linalg.solve(damped, residual)
        if J.shape[1] > 6:
            pull = POSTURE_PULL * to_posture
            step += pull - J.T @ np.linalg.solve(damped, J @ pull)
        return np.asarray(step * min(1.0, MAX_JOINT_STEP / max(np.abs(step).max(), 1e-12)))

    def pose_and_jacobian(self, q: Matrix) -> tuple[Pose, Matrix]:
        """Return the tool's pose at joint angles q (n,), and its Jacobian (6, n), by the product of exponentials.

        The Jacobian is linear over angular velocity, both in the world frame.
        """
        cross, cross_squared = self._generators
        turns = np.eye(3) + np.sin(q)[:, None, None] * cross + (1 - np.cos(q))[:, None, None] * cross_squared
        R, p = np.eye(3), np.zeros(3)
        axes, points = np.empty((len(q), 3)), np.empty((len(q), 3))
        for i, (turn, axis, point) in enumerate(zip(turns, self.axes, self.points, strict=True)):
            axes[i], points[i] = R @ axis, R @ point + p
            R = R @ turn
            p = points[i] - R @ point
        pose = Pose(R @ self.tip.position + p, R @ self.tip.rotation)
        return pose, np.vstack([np.cross(axes, pose.position - points).T, axes.T])

    @cached_property
    def _generators(self) -> tuple[Matrix, Matrix]:
        """The cross-product matrices (n, 3, 3) of the axes, and their squares."""
        cross = np.cross(np.eye(3)[None], self.axes[:, None])
        return np.asarray(cross), np.asarray(cross @ cross)


def _residual(target: Pose, pose: Pose) -> Matrix:
    return np.concatenate([target.position - pose.position, to_vector(target.rotation @ pose.rotation.T)])
