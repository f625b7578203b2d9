"""Where the states of a client that says no episode begin another one, over motions of many kinds.

Each motion is drawn here with its resets, so that what the rule misses and what it splits for nothing is counted.
"""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.serve.resets import Resets

State = NDArray[np.float64]
NUMBERS, EPISODES = 8, 50
HOME = np.linspace(-1, 1, NUMBERS)
RANGE = np.linspace(0.2, 1, NUMBERS)


def smooth(begin: State, end: State, steps: int) -> list[State]:
    """States between two, with the least jerk."""
    t = np.linspace(0, 1, steps + 1)[1:, None]
    return list(begin + (end - begin) * (10 * t**3 - 15 * t**4 + 6 * t**5))


def straight(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """A reach of constant speed, as a replayed demonstration."""
    way = 0.12 * RANGE * rng.normal(size=NUMBERS)
    return [start + way * number for number in range(steps)]


def reaching(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """One reach that begins and ends slowly."""
    return [start, *smooth(start, HOME + RANGE * rng.normal(size=NUMBERS), steps - 1)]


def jerky(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """Steps as long as the way back to the start, clipped at the limits: actions of a policy, times five."""
    states = [start]
    for _ in range(steps - 1):
        moved = states[-1] + 0.6 * RANGE * rng.normal(size=NUMBERS)
        states.append(np.clip(moved, HOME - RANGE, HOME + RANGE))
    return states


def anywhere(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """Each state anywhere between the limits: chunks that are executed whole."""
    return [start, *(HOME + RANGE * rng.uniform(-1, 1, (steps - 1, NUMBERS)))]


def one_jump(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """A slow motion with a single far jump, which is as long as the reset that follows."""
    end, jumps = HOME + RANGE * rng.normal(size=NUMBERS), int(rng.integers(1, steps))
    return [start + (0.02 * number + (number >= jumps)) * (end - start) for number in range(steps)]


def grasping(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """A reach of 0.3 of the range, with a gripper whose number jumps by more than the arm moves."""
    states = [start, *smooth(start, HOME + 0.3 * RANGE * rng.normal(size=NUMBERS), steps - 1)]
    closed = int(rng.integers(steps // 3, steps))
    for number, state in enumerate(states):
        state[-1] = HOME[-1] + (number >= closed)
    return states


def waiting(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """A robot that stands still, with a noisy sensor, and then reaches."""
    still = [start + 0.002 * rng.normal(size=NUMBERS) for _ in range(steps // 2)]
    return [*still, *smooth(still[-1], HOME + RANGE * rng.normal(size=NUMBERS), steps - steps // 2)]


def lattice(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """Steps of full speed in either direction, which often bring a number back to its first value."""
    states = [start]
    for _ in range(steps - 1):
        moved = states[-1] + 0.5 * RANGE * rng.choice([-1.0, 1.0], NUMBERS)
        states.append(np.clip(moved, HOME - RANGE, HOME + 1.3 * RANGE))
    return states


def going_home(start: State, steps: int, rng: np.random.Generator) -> list[State]:
    """A reach and the way back: the reset that follows moves nothing."""
    reach = smooth(start, HOME + RANGE * rng.normal(size=NUMBERS), steps // 2)
    return [start, *reach, *smooth(reach[-1], HOME, steps - steps // 2)]


Motion = Callable[[State, int, np.random.Generator], list[State]]
MOTIONS: tuple[Motion, ...] = (straight, reaching, jerky, anywhere, one_jump, grasping, waiting)


def session(motion: Motion, shortest: int, longest: int, spread: float = 0.0) -> Iterator[tuple[State, bool]]:
    """The states of 50 episodes, and whether each begins one; starts differ by a share of the range."""
    rng = np.random.default_rng(0)
    for _ in range(EPISODES):
        start = HOME + spread * RANGE * rng.normal(size=NUMBERS)
        for number, state in enumerate(motion(start, int(rng.integers(shortest, longest)), rng)):
            yield state, number == 0


def count(states: Iterator[tuple[State, bool]]) -> tuple[int, int, int]:
    """The resets that are missed, the splits that are none, and the rows that may hold more than one episode."""
    resets, missed, extra, rows = Resets(), 0, 0, [False]
    for number, (state, begins) in enumerate(states):
        judged = resets.judge(state.astype(np.float32))
        splits = number == 0 or judged.resets
        resets.add(state.astype(np.float32), judged, splits)
        missed += begins and not splits
        extra += splits and not begins
        rows = [*rows, False] if judged.resets else rows
        rows[-1] |= judged.may_reset
    return missed, extra, sum(rows)


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_reset_to_the_first_state_begins_a_row_whatever_the_motion(motion: Motion) -> None:
    missed, extra, doubtful = count(session(motion, 7, 10))
    assert (missed, extra) == (0, 0)
    assert doubtful <= 1


@pytest.mark.parametrize("motion", [straight, reaching, one_jump, grasping, waiting])
def test_starts_that_differ_by_a_fiftieth_of_the_range_are_resets_too(motion: Motion) -> None:
    missed, extra, _ = count(session(motion, 20, 25, spread=0.02))
    assert (missed, extra) == (0, 0)


def test_a_row_says_what_nothing_decides() -> None:
    """States from anywhere to anywhere, and starts that differ: some resets look like any step."""
    missed, extra, doubtful = count(session(anywhere, 20, 25, spread=0.02))
    assert extra == 0
    assert 0 < missed <= doubtful
    missed, extra, doubtful = count(session(lattice, 7, 10))
    assert missed + extra <= 6
    assert doubtful > 0


def test_a_reset_that_moves_nothing_is_no_split_and_the_row_says_so() -> None:
    missed, extra, doubtful = count(session(going_home, 10, 14))
    assert extra == 0
    assert missed == EPISODES - 1
    assert doubtful == 1, "all is one row, which says that it may be more than one episode"


def test_a_robot_that_moves_at_random_is_not_split() -> None:
    """A policy that moves at random for 400 inferences is one episode."""
    rng = np.random.default_rng(1)
    for motion in (jerky, anywhere, lattice):
        _, extra, _ = count((state, number == 0) for number, state in enumerate(motion(HOME, 400, rng)))
        assert extra == 0


def test_a_robot_without_a_moving_number_is_never_split() -> None:
    assert count((HOME, number == 0) for number in range(20)) == (0, 0, 0)
