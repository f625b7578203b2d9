"""Pairs of observations that differ in one input only."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.extract.sources.pairs import Frame, Pair, frames_of, pairs_of
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.scene_source import SceneSource
from probe_kit.extract.sources.source import Played
from probe_kit.hooks import Observation
from probe_kit.suite import Suite


@pytest.fixture(scope="module")
def source(small_suite: Suite) -> SceneSource:
    return SceneSource(SceneSettings(scene=SceneSpec(start_jitter=0.01)), small_suite.select(["color"], 4))


def pairs(source: SceneSource, vary: str, seed: int = 0) -> list[Pair]:
    """The pairs of a source; in the scene the arm begins in one pose, so that states are moved here."""
    rows, draw = source.rows(0), np.random.default_rng(seed)
    if vary != "state":
        return list(source.pairs(vary, draw, rows))
    frames = frames_of(source.play(Played()), rows)
    moved = [
        replace(
            frame,
            observation=replace(frame.observation, state=frame.observation.state + np.float32(0.01 * number)),
        )
        for number, frame in enumerate(frames)
    ]
    return list(pairs_of(moved, vary, draw))


def different(one: Observation, other: Observation) -> set[str]:
    """The inputs in which two observations differ."""
    parts: dict[str, tuple[Any, Any]] = {
        "picture.main": (one.image, other.image),
        "state": (one.state, other.state),
        "instruction": (one.instruction, other.instruction),
    }
    return {name for name, (first, second) in parts.items() if not np.array_equal(first, second)}


@pytest.mark.parametrize("vary", ["instruction", "picture.main", "state"])
def test_a_pair_differs_in_its_input_alone_and_its_control_changes_that_input_little(
    source: SceneSource, vary: str
) -> None:
    made = pairs(source, vary)
    assert len(made) == len(source.rows(0))
    for pair in made:
        assert different(pair.clean, pair.donor) == {vary}
        assert pair.control is not None
        assert different(pair.clean, pair.control) <= {vary}
        assert pair.seed == pair.row.policy_seed
        assert pair.row.columns["group_id"] != pair.donor_row.columns["group_id"]
    if vary == "state":
        moved = [np.abs(pair.control.state - pair.clean.state).max() for pair in made if pair.control is not None]
        assert max(moved) < 0.01


def test_the_donor_of_a_layout_has_the_pictures_in_each_others_place(source: SceneSource) -> None:
    made = pairs(source, "layout")
    assert all(different(pair.clean, pair.donor) == {"picture.main"} for pair in made)
    original, swapped = (pair for pair in made if pair.row.columns["item_id"] == made[0].row.columns["item_id"])
    np.testing.assert_array_equal(original.donor.image, swapped.clean.image)


def test_the_same_draw_gives_the_same_pairs(source: SceneSource) -> None:
    one, again = ([pair.donor_row.episode_id for pair in pairs(source, "instruction", 3)] for _ in range(2))
    assert one == again


def test_an_input_that_frames_do_not_have_or_that_is_always_the_same_is_refused(source: SceneSource) -> None:
    with pytest.raises(UsageError, match=r"vary is 'sound'; expected one of instruction, picture\.main, state"):
        pairs(source, "sound")
    rows = source.rows(0)[:2]
    seen = Observation(np.zeros((2, 2, 3), np.uint8), np.zeros(3, np.float32), "go")
    other = replace(rows[1], columns={**rows[1].columns, "group_id": "another"})
    with pytest.raises(UsageError, match="state is the same in all 2 frames"):
        list(pairs_of([Frame(rows[0], seen), Frame(other, seen)], "state", np.random.default_rng(0)))
