"""Times of frames in exact arithmetic: the one rule by which a time names a frame.

Timestamps are float32, which beyond 1024 s are 0.0001 s apart, or sums that drift. Videos count time in whole
ticks of their own. So times that mean the same frame differ, and no tolerance in seconds is right for all.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import Self

import numpy as np
from numpy.typing import NDArray

NEAR = 3
"""A time names a frame at most 1 / NEAR of a frame step away, if every other one is at least twice as far."""
BY_FAR = "within a third of a frame step, and every other one at least twice as far"
NONE = -1
_LITTLE = 0.001


@dataclass(frozen=True)
class TickTimes:
    """Times as whole numbers.

    Attributes:
        numbers: The times in `1 / unit` of a tick.
    """

    numbers: Sequence[int]
    unit: int

    @classmethod
    def of(cls, seconds: Sequence[float], begin: float, base: Fraction) -> Self:
        """Return `begin` plus each of the `seconds`, without rounding.

        Args:
            seconds: Finite times.
            begin: The time that is added to each, finite.
            base: The seconds of a tick.
        """
        offset = Fraction(begin)
        ratios = [number.as_integer_ratio() for number in seconds]
        parts = lcm(offset.denominator, *{denominator for _, denominator in ratios})
        added = offset.numerator * (parts // offset.denominator)
        return cls(
            [(added + number * (parts // denominator)) * base.denominator for number, denominator in ratios],
            parts * base.numerator,
        )


@dataclass(frozen=True)
class FrameMatch:
    """The frames that times name.

    Attributes:
        positions: (T,) int64 position of the frame that is nearest by far; NONE where there is none.
        drifts: (T,) float64 distance to the nearest frame in frame steps; infinite without any frame.
    """

    positions: NDArray[np.int64]
    drifts: NDArray[np.float64]


def nearest_by_far(times: TickTimes, frames: Sequence[int], step: Fraction) -> FrameMatch:
    """Return the frame that each time names: the nearest one, if no other comes near.

    On a regular grid that is every time up to a third of a step from its frame. Two frames at one time, and times
    in a gap, name none. All comparisons are those of integers.

    Args:
        times: The times.
        frames: The times of the frames in whole ticks, ascending.
        step: The time from one frame to the next in ticks.
    """
    unit, count = times.unit * step.denominator, len(frames)
    whole_step = step.numerator * times.unit
    positions, drifts = np.full(len(times.numbers), NONE, np.int64), np.full(len(times.numbers), np.inf)
    for number, scaled in enumerate(times.numbers if count else ()):
        time = scaled * step.denominator
        after = bisect_right(frames, time // unit)
        position = min(after, count - 1)
        if after and (after == count or time - frames[after - 1] * unit <= frames[after] * unit - time):
            position = after - 1
        nearest = abs(frames[position] * unit - time)
        sides = (side for side in (position - 1, position + 1) if 0 <= side < count)
        distances = (abs(frames[side] * unit - time) for side in sides)
        drifts[number] = nearest / whole_step
        if NEAR * nearest <= whole_step and all(
            nearest < distance and 2 * nearest <= distance for distance in distances
        ):
            positions[number] = position
    return FrameMatch(positions, drifts)


@dataclass(frozen=True)
class Drift:
    """The largest distance of a time from its frame.

    Attributes:
        steps: The distance in frame steps.
        seconds: The same distance in seconds.
        camera: The camera whose video was compared; None for the timestamp against frame / fps.
    """

    steps: float
    seconds: float
    episode: int
    frame: int
    camera: str | None

    def __str__(self) -> str:
        """Describe the distance and where it is."""
        against = "frame / fps" if self.camera is None else f"the video of {self.camera}"
        if self.steps < _LITTLE:
            return f"less than {_LITTLE:g} of a frame step"
        distance = f"{self.steps:.2g} of a frame step ({1000 * self.seconds:.2g} ms) from {against}"
        return f"{distance}, at frame {self.frame} of episode {self.episode}"
