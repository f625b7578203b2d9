"""Rotation matrices, roll-pitch-yaw and rotation vectors, all in radians and in numpy.

Roll, pitch and yaw turn about the fixed x, y and z axes in this order: R = Rz(yaw) Ry(pitch) Rx(roll).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def from_rpy(rpy: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of roll, pitch, yaw (3,)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def from_euler_xyz(angles: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of Euler angles "XYZ" (3,): R = Rx(first) Ry(second) Rz(third)."""
    return from_rpy(np.negative(angles)).T


def to_rpy(R: Array) -> Array:
    """Roll, pitch, yaw (3,) of a rotation matrix (3, 3); at pitch = ±π/2 the roll is set to zero."""
    level = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], level)
    if level < 1e-6:
        return np.array([0.0, pitch, np.arctan2(-R[0, 1], R[1, 1])])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def to_vector(R: Array) -> Array:
    """Rotation vector (3,), axis times angle with angle in [0, π], of a rotation matrix (3, 3)."""
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
    """Quaternion (x, y, z, w) of a turn about +z."""
    return (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
