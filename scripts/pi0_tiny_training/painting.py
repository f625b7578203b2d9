"""Where the tiles of the table lie in what the policy sees, see `vlm_tiny_training.brush`."""

import numpy as np
from vlm_tiny_training.brush import Brush, brush_of, ramp

from pi0_tiny_training.window import WINDOW_OF_POLICY, seen_by_policy
from probe_kit.env import SceneSpec
from probe_kit.env.scene import SIDES, Scene

__all__ = ["Brush", "calibrate"]


def calibrate(spec: SceneSpec) -> tuple[Brush, Brush]:
    """The brushes for the left and the right tile, read off one rendering of a coordinate texture."""
    scene = Scene(spec)
    scene.reset(dict.fromkeys(SIDES, ramp()), (*spec.cube_xy, spec.cube_side / 2), spec.cube_yaw)
    frame = scene.frame()
    picture = scene.picture(frame).astype(np.float64)
    brushes = [
        brush_of(picture, frame.bodies == scene.quads[side], WINDOW_OF_POLICY.crop, seen_by_policy)
        for side in SIDES
    ]
    scene.close()
    return brushes[0], brushes[1]
