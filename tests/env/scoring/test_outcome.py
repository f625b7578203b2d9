import json
from dataclasses import replace

import pytest

from probe_kit.env.scoring import Outcome, success_by_radius, zone
from probe_kit.errors import SceneError

ON_TILE = Outcome(
    zone="correct",
    layout="swapped",
    side_correct="right",
    cube_xy=(0.39, -0.12),
    cube_z=0.021,
    distance_correct=0.06,
    distance_wrong=0.30,
    epsilon=0.065,
    cube_moved=True,
    on_tile=True,
    is_grasped=False,
    steps=23,
    clipped=0,
    truncation_reason=None,
)
NAN = float("nan")


@pytest.mark.parametrize(
    ("correct", "wrong", "expected"),
    [
        (0.0, 0.31, "correct"),
        (0.31, 0.0, "wrong"),
        (0.2, 0.2, "oob"),
        (0.065, 0.25, "correct"),  # the edge is inside
        (0.0651, 0.25, "oob"),
        (NAN, NAN, "oob"),
    ],
)
def test_the_zone_depends_on_both_distances(correct, wrong, expected):
    assert zone(correct, wrong, 0.065) == expected


def test_a_cube_in_both_zones_is_a_configuration_error():
    with pytest.raises(SceneError, match="smaller radius"):
        zone(0.15, 0.15, 0.16)


@pytest.mark.parametrize(("where", "side"), [("correct", "right"), ("wrong", "left"), ("oob", "none")])
def test_the_side_placed_follows_from_the_zone(where, side):
    assert replace(ON_TILE, zone=where).side_placed == side


def test_a_cube_that_never_moved_is_told_apart_inside_out_of_bounds():
    assert replace(ON_TILE, zone="oob", cube_moved=False).never_moved
    assert not replace(ON_TILE, zone="oob", cube_moved=True).never_moved
    assert not replace(ON_TILE, zone="correct", cube_moved=False).never_moved


def test_success_is_scored_again_for_other_radii_from_the_record_alone():
    outcomes = [replace(ON_TILE, distance_correct=d) for d in (0.05, 0.06, 0.07, 0.20)]
    assert success_by_radius(outcomes) == {0.055: 0.25, 0.065: 0.5, 0.081: 0.75}


def test_scoring_nothing_is_an_error():
    with pytest.raises(ValueError, match="at least one"):
        success_by_radius([])


def test_the_record_is_strict_json_even_when_the_simulator_broke():
    broken = replace(ON_TILE, cube_xy=(NAN, NAN), cube_z=NAN, distance_correct=NAN, zone="oob")
    stored = json.loads(json.dumps(broken.to_json(), allow_nan=False))
    assert stored["cube_xy"] == [None, None]
    assert stored["side_placed"] == "none"
    assert stored["steps"] == 23
