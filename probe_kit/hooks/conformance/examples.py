"""Observations that need no scene."""

from collections.abc import Sequence

import numpy as np

from probe_kit.hooks.contract.model import Model
from probe_kit.hooks.contract.observation import Observation


def example_observations(instructions: Sequence[str], cameras: Sequence[str] = ()) -> list[Observation]:
    """One observation per instruction: noise pictures, plausible states and intrinsics, from a fixed seed."""
    rng = np.random.default_rng(0)
    size = (48, 64, 3)
    intrinsics = np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
    return [
        Observation(
            rng.integers(0, 256, size, dtype=np.uint8),
            np.array([0.3, 0.02 * index, 0.15, 0, 0, 0, 0, 1], np.float32),
            text,
            intrinsics,
            {camera: rng.integers(0, 256, size, dtype=np.uint8) for camera in cameras},
        )
        for index, text in enumerate(instructions)
    ]


def examples_for(model: Model, *instructions: str) -> list[Observation]:
    """Observations that hold what the model needs."""
    cameras = [need.removeprefix("camera.") for need in sorted(model.card.needs) if need.startswith("camera.")]
    return example_observations(instructions, cameras)
