"""Statistics of the numbers of a state or an action, as checkpoints and data sets store them."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""The quantiles that lerobot stores, by its names."""
LEVELS = ("min", "q01", "q10", "q50", "mean", "q90", "q99", "max")
"""The statistics that are values of the feature itself, by lerobot's names."""
_MIRRORED = {"min": "max", "q01": "q99", "q10": "q90"}
_MIRRORED |= {high: low for low, high in _MIRRORED.items()}
_BOUNDS = (("min", "max", 0.5), ("q01", "q99", 1.0), ("q10", "q90", 2.0))
"""Two bounds, and the share of their distance by which values may lie beyond them."""
DEVIATIONS = 5.0
"""The deviations from the mean up to which values are expected: at most 4 % of any data lie beyond (Chebyshev)."""
_NORMAL = {"max": 4.0, "q99": 4.65, "q90": 2.56}
"""The distance of the two bounds in standard deviations, of normal values; of `max` a choice."""
UNRELIABLE = 1e-2
"""The share of the mean below which a deviation may be rounding.

lerobot takes √(E[x²] − E[x]²) of float32 sums. At 10,000 frames these are off by 1e-4 of x².
"""
_ROUNDED_MEAN = 1e-3
"""The share of the mean by which values may differ from it where no bounds are stored."""
_ROUNDED = 1e-5
_LEAST = 1e-6


@dataclass(frozen=True)
class FeatureStatistics:
    """Statistics of every number of a state or an action.

    Attributes:
        values: (D,) float64 by lerobot's name: `min`, `max`, `mean`, `std`, `q01`, `q10`, `q50`, `q90`, `q99`; as
            far as they are stored. NaN marks a number without them.
        compared: (D,) which numbers are compared; the others may have any value.
        periodic: (D,) which numbers are angles that the network reads as sine and cosine.
    """

    values: Mapping[str, Numbers]
    compared: NDArray[np.bool_]
    periodic: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def of(cls, stored: Mapping[str, Any], width: int) -> Self | None:
        """Return the statistics (width,) of a feature that a file holds by lerobot's names; None without any."""
        values = {}
        for name in (*LEVELS, "std"):
            try:
                numbers = np.asarray(stored.get(name, ()), np.float64)
            except (TypeError, ValueError):
                continue
            if numbers.shape == (width,) and np.isfinite(numbers).all():
                values[name] = numbers
        return cls(values, np.ones(width, bool)) if values else None

    @classmethod
    def of_episodes(cls, episodes: Sequence[NDArray[Any]]) -> Self:
        """Return the statistics of the frames (T, D) of episodes, with lerobot's estimators.

        Quantiles are the mean of the episodes' quantiles, by their frames: `aggregate_feature_stats` of lerobot.
        """
        frames = np.concatenate(episodes).astype(np.float64)
        values = {"min": frames.min(0), "max": frames.max(0), "mean": frames.mean(0), "std": frames.std(0)}
        counts = [len(episode) for episode in episodes]
        quantiles = [
            np.quantile(episode.astype(np.float64), [*QUANTILES.values()], axis=0) for episode in episodes
        ]
        values |= dict(zip(QUANTILES, np.average(quantiles, axis=0, weights=counts), strict=True))
        return cls(values, np.ones(frames.shape[1], bool))

    @property
    def width(self) -> int:
        """The count of numbers."""
        return len(self.compared)

    def level(self, name: str) -> Numbers:
        """Return one statistic (D,), NaN where it is not stored."""
        return self.values.get(name, np.full(self.width, np.nan))

    @cached_property
    def is_still(self) -> NDArray[np.bool_]:
        """A mask (D,) of the numbers that never changed."""
        low, high = self.bounds
        return np.asarray(high <= low)

    @cached_property
    def center(self) -> Numbers:
        """The mean (D,), else the median, else the middle of the bounds."""
        low, high = self.bounds
        return _first(self.level("mean"), self.level("q50"), (low + high) / 2)

    @cached_property
    def bounds(self) -> tuple[Numbers, Numbers]:
        """The least and the largest value (D,); else the outer quantiles, else two deviations from the mean."""
        spread = 2 * self.level("std")
        lows = [self.level(low) for low, *_ in _BOUNDS]
        highs = [self.level(high) for _, high, _ in _BOUNDS]
        return _first(*lows, self.level("mean") - spread), _first(*highs, self.level("mean") + spread)

    @cached_property
    def has_ends(self) -> NDArray[np.bool_]:
        """A mask (D,) of the numbers whose least and largest value are stored."""
        return np.isfinite(self.level("min") + self.level("max"))

    @cached_property
    def support(self) -> tuple[Numbers, Numbers]:
        """The lowest and highest value (D,) that is plausible for the same robot in the same units.

        It reaches half the range beyond the extremes, further beyond quantiles, and five deviations from the mean.
        """
        lows, highs = [], []
        for low, high, share in _BOUNDS:
            beyond = share * (self.level(high) - self.level(low))
            lows.append(self.level(low) - beyond)
            highs.append(self.level(high) + beyond)
        mean, spread = self.level("mean"), DEVIATIONS * self.level("std")
        # A deviation of 0 may be a rounded one, so the mean itself is the only bound, with its own rounding.
        slack = np.where(self.has_ends, _ROUNDED, _ROUNDED_MEAN) * np.abs(self.center) + _LEAST
        lowest = np.fmin(_first(*lows, mean - spread), mean - np.where(self.is_still, 0, spread))
        highest = np.fmax(_first(*highs, mean + spread), mean + np.where(self.is_still, 0, spread))
        turn = np.resize(self.periodic, self.width) if self.periodic.size else np.zeros(self.width, bool)
        return (
            np.where(turn, np.fmin(lowest, -2 * np.pi), lowest - slack),
            np.where(turn, np.fmax(highest, 2 * np.pi), highest + slack),
        )

    def outside(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which values (…, D) lie beyond the support; never of numbers that are not compared."""
        low, high = self.support
        return np.asarray(((values < low) | (values > high)) & self.compared)

    def mapped(self, slope: Numbers | float, offset: Numbers | float = 0.0) -> "FeatureStatistics":
        """Return the statistics of slope · x + offset; with a negative slope the extremes change places."""
        slopes = np.broadcast_to(np.asarray(slope, np.float64), (self.width,))
        values = {"std": np.abs(slopes) * self.level("std")}
        for name in LEVELS:
            mirrored = np.where(slopes < 0, self.level(_MIRRORED.get(name, name)), self.level(name))
            values[name] = slopes * mirrored + offset
        return FeatureStatistics(values, self.compared, self.periodic)

    def reordered(self, order: Sequence[int] | NDArray[np.intp]) -> "FeatureStatistics":
        """Return the statistics of the numbers in another order."""
        indices = np.asarray(order)
        values = {name: numbers[indices] for name, numbers in self.values.items()}
        return FeatureStatistics(
            values, self.compared[indices], self.periodic[indices] if self.periodic.size else self.periodic
        )

    def scales(self, other: "FeatureStatistics") -> tuple[Numbers, Numbers]:
        """Return the spreads (D,) of both, by the first statistic that both have: in standard deviations."""
        spreads = []
        reliable = ~((self.level("std") < UNRELIABLE * np.abs(self.level("mean"))) & self.has_ends)
        for statistics in (self, other):
            deviation = np.where(reliable, statistics.level("std"), np.nan)
            ranges = [(statistics.level(high) - statistics.level(low)) / _NORMAL[high] for low, high, _ in _BOUNDS]
            spreads.append([deviation, *ranges])
        both = [np.isfinite(mine + theirs) for mine, theirs in zip(*spreads, strict=True)]
        mine, theirs = (
            _first(*(np.where(usable, spread, np.nan) for usable, spread in zip(both, of, strict=True)))
            for of in spreads
        )
        return mine, theirs

    def distance(self, other: "FeatureStatistics") -> Numbers:
        """Return how unlike two sets of statistics are (D,), 0 for equal ones.

        It is the mean difference of all levels that both have, over the geometric mean of both spreads. So it is
        large for another place, for a wider and for a narrower spread.
        """
        mine, theirs = self.scales(other)
        reliable = ~((self.level("std") < UNRELIABLE * np.abs(self.level("mean"))) & self.has_ends)
        differences = [np.abs(self.level(name) - other.level(name)) for name in LEVELS if name != "mean"]
        for sign in (-1, 1):
            edges = [of.level("mean") + sign * of.level("std") for of in (self, other)]
            differences.append(np.where(reliable, np.abs(edges[0] - edges[1]), np.nan))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a number without any common level is NaN
            mean = np.nanmean(differences, axis=0)
        scale = np.sqrt(mine * theirs)
        return np.asarray(np.where(scale > 0, mean / np.where(scale > 0, scale, 1), np.nan))


def _first(*choices: Numbers) -> Numbers:
    """Return (D,) the first of several values that is a number."""
    result = choices[-1]
    for choice in reversed(choices[:-1]):
        result = np.where(np.isfinite(choice), choice, result)
    return np.asarray(result, np.float64)
