"""Resets of a robot between episodes of a client that names none: the evidence in the states of one connection."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

AWAY = 1 / 3
"""A number is away if its distance from the first is at least this share of its usual largest one."""
BACK = 0.1
"""A state is near the first one if every number is within this share."""
LARGEST_CHANCE = 2e-4
"""A state begins an episode if it comes by chance less often than this."""
POSSIBLE_CHANCE = 0.02
"""A state may begin an episode if it comes by chance less often than this."""
RETURN_CHANCE = 0.05
"""A far jump alone begins no episode: to be so near the first state must be rarer than this."""
FAR = 3.0
"""A step is far beyond all others if it is so many times the largest."""
FEWEST_AWAY, FEWEST_VALUES, FEWEST_STEPS, MOST_STEPS = 2, 4, 5, 300
SMALLEST_RATIO = 1e-3
"""A number that is exactly back is as good as one within this share: states are rounded."""


@dataclass(frozen=True)
class ResetEvidence:
    """The evidence of a state for a reset.

    Attributes:
        resets: Whether it begins another episode.
        may_reset: Whether it may begin one, and nothing decides it.
        is_return: Whether it is so like the first state that it is no example of a step within an episode.
        is_near: Whether it is near the first state.
        is_away: Whether most numbers of the state before were away from the first.
    """

    resets: bool = False
    may_reset: bool = False
    is_return: bool = False
    is_near: bool = False
    is_away: bool = False


class Resets:
    """The states of one connection, and which of them begin an episode.

    A reset brings the robot back to about where the connection began, from anywhere. Two things are measured, in
    units of the usual range of each number (the 90 % quantile of its distance from the first state):

    * Return. Of each number that was away, the distance to the first value now, divided by the one before, is
      uniform at worst for a robot that goes anywhere; it is raised to the share of earlier steps that came back so
      far, for grippers and others that return within an episode. Fisher's sum of logarithms over the numbers gives
      the chance of the return (Fisher, Statistical Methods for Research Workers, 4th ed., 1932, section 21.1).
    * Jump. The share of earlier steps that were as large, times the squared ratio of the largest one and this one
      where it is larger: a tail without a second moment.

    A state resets if the product is rarer than `LARGEST_CHANCE`, or if it is nearer to the first state than to the
    one before by more than the largest step. Numbers with fewer than four values, as of a gripper that is open or
    closed, do not count.
    """

    def __init__(self) -> None:
        self._first: NDArray[np.float64] | None = None
        self._last: NDArray[np.float64] | None = None
        self._states: NDArray[np.float64] = np.zeros((MOST_STEPS, 0))
        self._steps: NDArray[np.float64] = np.zeros((MOST_STEPS, 2, 0))
        self._n_states = self._n_steps = 0
        self._values: list[set[float]] = []
        self._was_away = False

    def judge(self, state: NDArray[np.float32]) -> ResetEvidence:
        """Return the evidence of a state (D,), which is not counted until `add`."""
        if self._first is None or self._last is None or not self._n_steps:
            return ResetEvidence()
        off = np.abs(self._states[: self._n_states] - self._first)
        scale = np.quantile(off, 0.9, axis=0)
        moving = (scale > 0) & np.array([len(values) >= FEWEST_VALUES for values in self._values])
        if not moving.any():
            return ResetEvidence()
        first, scale = self._first[moving], scale[moving]
        before = np.abs(self._last[moving] - first) / scale
        now = np.abs(state[moving] - first) / scale
        steps = (self._steps[: self._n_steps, :, moving] - first) / scale
        lengths = np.linalg.norm(steps[:, 1] - steps[:, 0], axis=1)
        jump = float(np.linalg.norm((state - self._last)[moving] / scale))
        # One step in fifty may be a glitch, or a reset that was missed.
        largest = float(np.sort(lengths)[-1 - len(lengths) // 50])
        returned = _chance_of_return(before, now, np.abs(steps))
        chance = returned * _chance_of_jump(jump, lengths, largest)
        nearer = jump - float(np.linalg.norm(now)) > largest
        resets = nearer or (chance <= LARGEST_CHANCE and returned <= RETURN_CHANCE)
        is_return = chance <= POSSIBLE_CHANCE and returned <= RETURN_CHANCE
        is_near = bool((now <= BACK).all())
        far = jump > FAR * largest and len(lengths) >= FEWEST_STEPS
        return ResetEvidence(
            resets,
            not resets and (far or is_return or (is_near and self._was_away)),
            is_return,
            is_near,
            bool((before >= AWAY).mean() > 0.5),
        )

    def add(self, state: NDArray[np.float32], judged: ResetEvidence, begins: bool) -> None:
        """Count a state, which begins an episode or not."""
        new = state.astype(np.float64)
        if self._first is None or self._last is None:
            self._first, self._values = new, [set() for _ in new]
            self._states, self._steps = np.zeros((MOST_STEPS, len(new))), np.zeros((MOST_STEPS, 2, len(new)))
        elif not begins and not judged.is_return:
            self._steps = np.roll(self._steps, 1, axis=0)
            self._steps[0] = self._last, new
            self._n_steps = min(MOST_STEPS, self._n_steps + 1)
        if begins or judged.is_near:
            self._was_away = False
        elif judged.is_away:
            self._was_away = True
        self._last = new
        self._states = np.roll(self._states, 1, axis=0)
        self._states[0] = new
        self._n_states = min(MOST_STEPS, self._n_states + 1)
        for values, number in zip(self._values, new.tolist(), strict=True):
            if len(values) < FEWEST_VALUES:
                values.add(number)


def _chance_of_return(before: NDArray[np.float64], now: NDArray[np.float64], steps: NDArray[np.float64]) -> float:
    """Return how often a state of an episode is so near the first one; 1 where too few numbers were away.

    Args:
        before: (D,) distances from the first state, of the state before.
        now: (D,) those of the state.
        steps: (N, 2, D) those before and after earlier steps.
    """
    away = before >= AWAY
    if int(away.sum()) < min(len(away), max(FEWEST_AWAY, len(away) // 4)):
        return 1.0
    were_away = steps[:, 0] >= AWAY
    shares = (were_away & (steps[:, 1] <= now)).sum(axis=0) / np.maximum(1, were_away.sum(axis=0))
    ratios = np.clip(np.maximum(now / np.maximum(before, AWAY), shares)[away], SMALLEST_RATIO, 1)
    total = -float(np.log(ratios).sum())
    # The sum of n logarithms is beyond `total` as often as a Poisson count of that mean is below n.
    terms = [math.exp(-total)]
    for number in range(1, len(ratios)):
        terms.append(terms[-1] * total / number)
    return min(1.0, sum(terms))


def _chance_of_jump(jump: float, lengths: NDArray[np.float64], largest: float) -> float:
    """Return how often a step within an episode is so large."""
    beyond = min(1.0, largest / jump) ** 2 if jump > 0 else 1.0
    return float((1 + (lengths >= jump).sum()) / (len(lengths) + 1) * beyond)
