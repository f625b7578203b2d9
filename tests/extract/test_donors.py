"""Donors: frames of another group with another value of an input, of pictures one with a near state."""

from collections.abc import Sequence

import numpy as np
import pytest

from probe_kit.extract.sources.inputs import NEAREST, Frame, draw_donors, same_input
from probe_kit.hooks import Observation

GROUPS = 12


def frames(count: int = 24, spread: Sequence[float] = (1.0, 100.0)) -> list[Frame]:
    """Frames of few words, pictures and states, so that some are the same; two of each group."""
    rng = np.random.default_rng(0)
    return [
        Frame.of(
            f"frame {number}",
            Observation(
                np.full((2, 2, 3), rng.integers(2), np.uint8),
                (rng.normal(size=2) * spread).astype(np.float32),
                str(rng.choice(["lift", "push"])),
            ),
            f"group {number % GROUPS}",
            number,
        )
        for number in range(count)
    ]


def drawn(frames: Sequence[Frame], draws: int) -> set[int]:
    """The donors of the picture of the first frame, over several draws."""
    generators = map(np.random.default_rng, range(draws))
    return {donor for rng in generators for _, donor in draw_donors(frames, "picture", rng, of=[0])}


def plain(colour: int) -> Observation:
    return Observation(np.full((2, 2, 3), colour, np.uint8), np.zeros(1, np.float32), "go")


@pytest.mark.parametrize("vary", ["instruction", "picture", "state"])
def test_a_donor_is_of_another_group_and_holds_another_value(vary: str) -> None:
    given = frames()
    pairs = draw_donors(given, vary, np.random.default_rng(0), 3)
    assert {frame for frame, _ in pairs} == set(range(len(given)))
    assert len(pairs) == len(set(pairs)) == 3 * len(given)
    for frame, donor in pairs:
        assert given[frame].group != given[donor].group
        assert not same_input(given[frame].observation, given[donor].observation, vary)


def test_the_donor_of_a_picture_is_one_of_the_nearest_in_spreads_of_every_number_of_the_state() -> None:
    given = frames(60)
    states = np.stack([frame.state for frame in given])
    scaled = states / states.std(axis=0)
    others = [
        number
        for number, frame in enumerate(given)
        if frame.group != given[0].group and not same_input(frame.observation, given[0].observation, "picture")
    ]
    nearest = sorted(others, key=lambda number: float(np.linalg.norm(scaled[number] - scaled[0])))[:NEAREST]
    assert drawn(given, 40) == set(nearest)


def test_frames_that_are_equally_near_are_all_drawn() -> None:
    given = [Frame.of(str(number), plain(number), str(number), 0) for number in range(3 * NEAREST)]
    assert drawn(given, 300) == set(range(1, 3 * NEAREST))


def test_a_picture_beyond_the_nearest_is_never_read() -> None:
    """Pictures of recordings are decoded one by one."""
    read: list[int] = []

    def observe(frame: Frame) -> Observation:
        read.append(frame.number)
        return plain(frame.number)

    given = [Frame(f"{at}", f"{at}", 0, "go", np.array([float(at)]), observe, number=at) for at in range(100)]
    ((_, donor),) = draw_donors(given, "picture", np.random.default_rng(0), of=[0])
    assert donor in range(1, NEAREST + 1)
    assert set(read) == set(range(NEAREST + 1))


def test_a_frame_without_a_donor_is_left_out() -> None:
    given = [Frame.of(str(number), plain(0), str(number), 0) for number in range(3)]
    for vary in ("instruction", "picture", "state"):
        assert draw_donors(given, vary, np.random.default_rng(0)) == []
