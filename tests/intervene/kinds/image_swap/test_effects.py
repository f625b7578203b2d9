"""What follows, what goes against, what has a habit, and what the verdict makes of them."""

from collections.abc import Callable

import numpy as np
import pytest

from probe_kit.intervene import ImageSwapEffect, classify_all, classify_use
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, image_swap_effects
from probe_kit.intervene.store.answers import ConditionOutcomes
from tests.intervene.answers import follower, habit, outcomes_of

Kind = Callable[[int], tuple[np.ndarray, np.ndarray]]
SUITE = "suite@1#0123456789ab"


def of(signs: tuple[np.ndarray, np.ndarray], groups: int | None = None) -> ImageSwapEffect:
    (found,) = image_swap_effects(outcomes_of({"color": signs}, groups), SUITE)
    return found


def test_who_goes_where_the_correct_picture_lies_follows() -> None:
    found = of(follower(48))
    assert (found.follow_rate, found.reversal_rate, found.net_follow_rate) == (1.0, 0.0, 1.0)
    assert found.follow_p == 2.0**-24
    assert found.median_displacement == pytest.approx(0.2)
    assert found.follows_images
    assert not found.is_against


def test_the_mirror_of_following_is_going_against() -> None:
    plain, exchanged = follower(48)
    found = of((-plain, -exchanged))
    assert (found.follow_rate, found.reversal_rate) == (0.0, 1.0)
    assert found.is_against
    assert found.follow_p == 1.0


def test_a_habit_is_no_following_however_often_it_is_right() -> None:
    """Half of its episodes end on the correct picture."""
    found = of(habit(48))
    assert (found.follow_rate, found.reversal_rate) == (0.0, 0.0)
    assert found.follow_p > 0.1
    assert found.is_bounded
    assert found.net_follow_rate_ci[1] > 0  # that nothing was seen does not prove that nothing is there


def test_following_in_few_episodes_is_not_called_following() -> None:
    """Every action moves toward the correct side, but hardly one changes sides."""
    plain, exchanged = np.full(48, 0.1), np.full(48, 0.09)
    exchanged[:4] = -0.01
    found = of((plain, exchanged))
    assert found.follow_p == 2.0**-24
    assert found.net_follow_rate < SMALLEST_EFFECT_OF_INTEREST
    assert not found.follows_images


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
    assert not of(follower(48), groups=3).follows_images


def test_few_items_leave_the_question_open() -> None:
    found = of(habit(8))
    assert not found.is_bounded
    assert classify_use(True, found, "shape").verdict == "inconclusive"


def test_answers_are_read_back_as_they_were() -> None:
    made = outcomes_of({"color": follower(4), "shape": habit(4)})
    back = ConditionOutcomes.from_bytes(made.to_bytes())
    assert back.to_bytes() == made.to_bytes()
    assert back.conditions == made.conditions
    np.testing.assert_array_equal(back.displacement, made.displacement)
    assert back.only("shape").items.tolist() == ["shape-0", "shape-0", "shape-1", "shape-1"]


# -- verdict -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoded", "follows", "expected"),
    [
        (True, True, "used"),
        (False, True, "acted on, not found"),
        (None, True, "follows"),
        (True, False, "encoded, unused"),
        (False, False, "absent"),
        (None, False, "does not follow"),
    ],
)
def test_probes_and_pictures_together(encoded: bool | None, follows: bool, expected: str) -> None:
    found = of(follower(48) if follows else habit(48))
    assert classify_use(encoded, found, "shape").verdict == expected


def test_acting_against_what_is_encoded_is_a_verdict_of_its_own() -> None:
    plain, exchanged = follower(48)
    found = of((-plain, -exchanged))
    assert classify_use(True, found, None).verdict == "encoded, acted against"
    assert classify_use(False, found, None).verdict == "acted against, not found"


def test_unused_needs_another_category_that_follows() -> None:
    both = image_swap_effects(outcomes_of({"color": follower(48), "state": habit(48)}), SUITE)
    found = {one.category: one for one in both}
    judged = classify_all(found, {"color": True, "state": True})
    assert judged["state"].verdict == "encoded, unused"
    assert judged["state"].reason == "positive control: color"
    alone = classify_all({"state": found["state"]}, {"state": True})["state"]
    assert alone.verdict == "inconclusive"
    assert "no other category" in alone.reason
    assert classify_all({"state": found["state"]}, {"state": False})["state"].verdict == "absent"
