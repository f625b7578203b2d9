"""Turning points of episodes whose every step is known."""

import numpy as np
import pytest

from probe_kit.env.scoring import EVENTS, LATERAL, MOVED, Events, Trajectory

FRAMES = 12
LEFT, RIGHT = (0.4, 0.155), (0.4, -0.155)


def trajectory(tool: np.ndarray, held: list[int]) -> Trajectory:
    """tool: (T + 1, 3) places. held: frames in which the cube is."""
    frames = len(tool)
    pose = np.zeros((frames, 7), np.float32)
    tiles = [pose + np.array([*place, 0, 0, 0, 0, 1], np.float32) for place in (LEFT, RIGHT)]
    zero = np.zeros(frames, np.float32)
    return Trajectory(
        tool=np.hstack([tool, np.zeros((frames, 3))]).astype(np.float32), opening=zero, cube=pose, cube_speed=zero,
        tile_left=tiles[0], tile_right=tiles[1], finger_force=np.zeros((frames, 2), np.float32),
        held=np.isin(np.arange(frames), held), touches=np.zeros((frames, 2), bool),
        commanded=np.zeros((frames - 1, 7), np.float32), executed=np.zeros((frames - 1, 7), np.float32),
        ik_error=zero[1:],
    )  # fmt: skip


def reaching() -> np.ndarray:
    """Settles, sets off at frame 2 sideways to the cube, lifts it, moves aside from frame 8 on."""
    places = np.zeros((FRAMES, 3))
    places[1, 2] = MOVED / 2
    places[2:, 1] = 0.06
    places[5:, 2] = 0.1
    places[8:, 1] += 1.5 * LATERAL
    return places


def test_every_event_has_the_frame_at_which_it_was_first_the_case() -> None:
    events = Events.of(trajectory(reaching(), held=[4, 5, 7, 8, 9]))
    assert events == Events(first_motion=2, grasp=4, first_lateral_move=8, release=10)
    assert [events.frame(name) for name in EVENTS] == [2, 4, 8, 10]


@pytest.mark.parametrize("side", [-1, 1])
def test_reaching_sideways_for_the_cube_is_no_choice_of_a_side(side: int) -> None:
    places = reaching() * np.array([1, side, 1])
    assert Events.of(trajectory(places, held=[4, 5, 6, 7])).first_lateral_move == 8
    assert Events.of(trajectory(places, held=[])).first_lateral_move is None


def test_what_never_happened_has_no_frame() -> None:
    assert Events.of(trajectory(np.zeros((FRAMES, 3)), held=[])) == Events(None, None, None, None)


def test_a_cube_that_is_still_held_was_not_released() -> None:
    assert Events.of(trajectory(reaching(), held=list(range(4, FRAMES)))).release is None


def test_the_scripted_expert_sets_off_grasps_chooses_a_side_and_lets_go(shared_env) -> None:
    from probe_kit.env import ScriptedExpert
    from probe_kit.env.act2answer import Recorder

    shared_env.reset(seed=0)
    expert = ScriptedExpert(shared_env)
    expert.reset()
    recorder = Recorder(shared_env)
    while not shared_env.trial.over:
        action = expert.act()
        shared_env.advance(action)
        recorder.note(action)
    found = [Events.of(recorder.trajectory()).frame(event) for event in EVENTS]
    assert None not in found
    assert found == sorted(found)
    assert len(set(found)) == len(EVENTS)
