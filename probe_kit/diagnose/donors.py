"""Donors: whose input a frame gets."""

from collections.abc import Sequence

import numpy as np

from probe_kit.diagnose.inputs import Frame
from probe_kit.extract.sources.inputs import PICTURE, same_input

DONORS = 3
"""For each frame: one donor alone often asks for the same action by chance."""
NEAREST = 8
"""Frames with the nearest states among which the donor of a picture is drawn, so that the picture fits the arm."""


def draw_donors(frames: Sequence[Frame], name: str, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Pairs (frame, donor) of indices: donors of another group that hold another value of the input.

    Frames without any are left out. A picture comes from one of the frames whose states are nearest.
    """
    pairs = []
    for index, frame in enumerate(frames):
        candidates = [
            other
            for other, donor in enumerate(frames)
            if donor.group != frame.group and not same_input(frame.observation, donor.observation, name)
        ]
        if name.startswith(PICTURE):
            candidates = _nearest(frames, index, candidates)
        count = min(DONORS, len(candidates))
        pairs += [(index, int(donor)) for donor in rng.choice(candidates, count, replace=False)]
    return pairs


def _nearest(frames: Sequence[Frame], index: int, candidates: Sequence[int]) -> list[int]:
    """The candidates whose state is nearest to that of a frame; all that are equally near."""
    distances = [_distance(frames[index], frames[other]) for other in candidates]
    if len(candidates) <= NEAREST:
        return list(candidates)
    limit = sorted(distances)[NEAREST - 1]
    return [other for other, distance in zip(candidates, distances, strict=True) if distance <= limit]


def _distance(first: Frame, second: Frame) -> float:
    states = [frame.observation.state.astype(np.float64) for frame in (first, second)]
    return float(np.linalg.norm(states[0] - states[1]))
