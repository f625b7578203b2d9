"""What follows, what goes against, and what has a habit: shares, displacements and their intervals."""

from collections.abc import Callable

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.intervene import ImageSwapEffect
from probe_kit.intervene.kinds.image_swap import TILES_APART
from probe_kit.intervene.outcomes import ConditionOutcomes
from tests.intervene.answers import follower, habit, outcomes_of, swaps_of

Kind = Callable[[int], tuple[np.ndarray, np.ndarray]]
SUITE = "suite@1#0123456789ab"


def of(signs: tuple[np.ndarray, np.ndarray], groups: int | None = None) -> ImageSwapEffect:
    (found,) = swaps_of(outcomes_of({"color": signs}, groups), SUITE)
    return found


def test_who_goes_where_the_correct_picture_lies_follows() -> None:
    found = of(follower(48))
    assert (found.follow_rate, found.reversal_rate, found.net_follow_rate) == (1.0, 0.0, 1.0)
    assert found.follow_p == 2.0**-24
    assert found.median_displacement == pytest.approx(0.2)
    assert (found.reach, found.reach_source) == (pytest.approx(0.2), "actions")
    assert (found.reach_share, found.moved_share) == (pytest.approx(1.0), pytest.approx(1.0))
    assert (found.left_reached, found.right_reached) == (1.0, 1.0)


def test_the_mirror_of_following_is_going_against() -> None:
    plain, exchanged = follower(48)
    found = of((-plain, -exchanged))
    assert (found.follow_rate, found.reversal_rate) == (0.0, 1.0)
    assert found.reach_share == pytest.approx(-1.0)
    assert (found.left_reached, found.right_reached) == (-1.0, -1.0)
    assert found.follow_p == 1.0


def test_a_habit_is_no_following_however_often_it_is_right() -> None:
    """Half of its episodes end on the correct picture."""
    found = of(habit(48))
    assert (found.follow_rate, found.reversal_rate) == (0.0, 0.0)
    assert found.follow_p > 0.1
    assert found.reach_share == pytest.approx(0.0, abs=1e-4)
    assert found.net_follow_rate_ci[1] > 0  # that nothing was seen does not prove that nothing is there


def test_the_reach_of_a_policy_that_goes_to_one_side_is_the_distance_between_the_tiles() -> None:
    found = of((np.where(np.arange(48) // 2 % 2 == np.arange(48) % 2, 0.1, -0.1), np.zeros(48)))
    assert (found.reach, found.reach_source) == (TILES_APART, "tiles")
    assert np.subtract(SceneSpec().tile_left, SceneSpec().tile_right)[1] == pytest.approx(TILES_APART)


def test_a_few_categories_that_move_weakly_do_not_shorten_the_reach() -> None:
    weak = tuple(0.02 * part for part in follower(48))
    rows = swaps_of(outcomes_of({"color": follower(96), "shape": weak}), SUITE)  # type: ignore[dict-item]
    assert [row.reach for row in rows] == [pytest.approx(0.2)] * 2
    assert rows[1].reach_share == pytest.approx(0.02)


def test_displacements_of_a_single_group_have_no_interval() -> None:
    assert of(follower(4), groups=1).reach_share_ci == (-np.inf, np.inf)


@pytest.mark.parametrize("kind", [follower, habit])
def test_one_group_unlike_the_others_makes_nothing_surer(
    kind: Callable[[int], tuple[np.ndarray, np.ndarray]],
) -> None:
    like = of(kind(64), groups=16)
    for other in (follower, habit):
        plain, exchanged = kind(64)
        unlike = (np.arange(64) // 2) % 16 == 0
        for part, source in zip((plain, exchanged), other(64), strict=True):
            part[unlike] = source[unlike]
        found = of((plain, exchanged), groups=16)
        assert (
            found.net_follow_rate_ci[0] <= like.net_follow_rate_ci[0]
            or found.net_follow_rate > like.net_follow_rate
        )
        assert (
            found.net_follow_rate_ci[1] >= like.net_follow_rate_ci[1]
            or found.net_follow_rate < like.net_follow_rate
        )


def test_items_that_share_pictures_do_not_add_up() -> None:
    assert of(follower(48)).follow_p < of(follower(48), groups=3).follow_p == 2.0**-3


def test_answers_are_read_back_as_they_were() -> None:
    made = outcomes_of({"color": follower(4), "shape": habit(4)})
    back = ConditionOutcomes.from_bytes(made.to_bytes())
    assert back.to_bytes() == made.to_bytes()
    assert back.conditions == made.conditions
    np.testing.assert_array_equal(back.displacement, made.displacement)
    assert dict(back.by_category())["shape"].items.tolist() == ["shape-0", "shape-0", "shape-1", "shape-1"]
