"""A swap of the images: shares, displacements and intervals, its verdict, and how often it is wrong."""

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import probe_kit
from probe_kit.env import SceneSpec
from probe_kit.intervene import ImageSwapEffect, classify_all, classify_use
from probe_kit.intervene.outcomes import ConditionOutcomes, arrays_from_bytes
from probe_kit.intervene.stored import TILES_APART
from probe_kit.intervene.verdict import classify_behaviour, size_of_groups
from probe_kit.statistics.sufficiency import groups_for_not_used
from tests.intervene.answers import Cell, follower, habit, outcomes_of, swaps_of

SUITE = "suite@1#0123456789ab"


def of(signs: tuple[Cell, Cell], groups: int | None = None) -> ImageSwapEffect:
    (swap,) = swaps_of(outcomes_of({"color": signs}, groups), SUITE)
    return swap


def test_one_module_alone_makes_a_verdict() -> None:
    """The retention table, the demo and the intervention had one each."""
    root = Path(probe_kit.__file__).parent
    modules = [
        path for path in root.rglob("*.py") if re.search(r"\bUseVerdict\(", path.read_text(encoding="utf-8"))
    ]
    assert [path.relative_to(root).as_posix() for path in modules] == ["intervene/verdict.py"]


@pytest.mark.parametrize(
    ("encoded", "follows", "behaviour", "tie"),
    [
        (True, True, "used", "whether the readable copy is the one used was not tested"),
        (False, True, "used", "no readable copy found"),
        (None, True, "used", ""),
        (True, False, "not used", ""),
        (False, False, "not used", ""),
        (None, False, "not used", ""),
    ],
)
def test_behaviour_and_tie_are_said_apart(encoded: bool | None, follows: bool, behaviour: str, tie: str) -> None:
    use = classify_use(encoded, of(follower(48) if follows else habit(48)), "shape")
    assert (use.behaviour, use.tie, use.reversed) == (behaviour, tie, False)


def test_the_mirror_of_every_behaviour_is_said_with_the_same_word() -> None:
    plain, swapped = follower(48)
    for share in (1.0, 0.3):
        middle = plain * 0.4
        toward = classify_behaviour(of((middle + share * plain, middle + share * swapped)), "shape")
        away = classify_behaviour(of((middle - share * plain, middle - share * swapped)), "shape")
        assert toward.behaviour == away.behaviour != "not used"
        assert (toward.reversed, away.reversed) == (False, True)
        assert away.verdict == f"against: {toward.verdict}"


def test_a_displacement_in_few_episodes_is_not_used_in_the_others() -> None:
    """Every action moves toward the correct side, but hardly one changes sides."""
    plain, swapped = np.full(48, 0.1), np.full(48, 0.09)
    swapped[:4] = -0.01
    swap = of((plain, swapped))
    assert swap.follow_p == 2.0**-24
    assert classify_behaviour(swap, "shape").behaviour != "used"


def test_five_groups_that_always_follow_are_not_used_in_part() -> None:
    """Their rate has no bound above 0, the displacement has: *partly* was said of the number of groups."""
    swap = of(follower(20), groups=5)
    assert swap.net_follow_rate_ci[0] <= 0 < swap.reach_share_ci[0]
    assert classify_behaviour(swap, None).verdict == "used"


def test_an_action_that_goes_against_the_picture_in_half_of_the_episodes_is_not_called_unused() -> None:
    """Only the upper end of the interval counted: [-0.58, 0.08] was *encoded, unused*."""
    plain, swapped = follower(48)
    lot = np.random.default_rng(3).choice([-1.0, 1.0], 24, p=[0.6, 0.4]).repeat(2)
    swap = of((lot * plain, lot * swapped))
    assert swap.net_follow_rate < 0
    assert classify_behaviour(swap, "shape").behaviour == "undecided"


def test_not_used_needs_another_category_that_is_used() -> None:
    both = swaps_of(outcomes_of({"color": follower(48), "state": habit(48)}), SUITE)
    swap_by_category = {swap.category: swap for swap in both}
    assert classify_all(swap_by_category, {})["state"].reason.endswith("positive control: color")
    alone = classify_all({"state": swap_by_category["state"]}, {})["state"]
    assert (alone.behaviour, alone.lacks_control, alone.is_bounded) == ("undecided", True, True)


def test_not_used_needs_as_many_groups_as_are_said_beforehand() -> None:
    needed = groups_for_not_used()
    for count, behaviour in ((needed, "not used"), (needed - 1, "undecided")):
        assert classify_behaviour(of(habit(4 * count), groups=count), "shape").behaviour == behaviour
    too_few = classify_behaviour(of(habit(4 * needed - 4), groups=needed - 1), "shape")
    assert f"about {needed} groups would tell, there are {needed - 1}" in too_few.reason


def test_a_legend_says_how_many_groups_the_items_are_where_a_verdict_counts_groups() -> None:
    open_ = classify_behaviour(of(habit(40), groups=10), "shape").reason
    assert "groups would tell" in open_
    assert (
        size_of_groups(["", open_], [(20, 10), (12, 6)])
        == "20 items are 10 independent groups, because 2 items share each picture"
    )
    assert size_of_groups([open_], [(20, 10), (15, 10)]) == (
        "20 items are 10 independent groups, because 1.5 to 2 items share each picture"
    )
    assert size_of_groups(["used"], [(20, 10)]) == ""


# -- by chance -------------------------------------------------------------------------------------------------


def drawn(seed: int, groups: int, mean: float, spread: float, other: float = 0.0) -> str:
    """The behaviour of a policy that moves by `mean` of 30 cm toward the answer, and `spread` between groups.

    other: the same toward another property of the images. What does neither goes to a random side.
    """
    draw, items = np.random.default_rng(seed), 2 * groups
    of_group = np.tile(mean + draw.normal(size=groups) * spread, 2)  # items n and n + groups are a group
    toward = (of_group + draw.choice([-1.0, 1.0], items) * other).repeat(2)
    lot = draw.choice([-1.0, 1.0], items).repeat(2) * np.tile([1.0, -1.0], items)
    habits = lot * (max(mean, other) < 0.5) * 0.15
    clean, swapped = (habits + sign * 0.15 * toward + draw.normal(size=2 * items) * 0.002 for sign in (1, -1))
    outcomes = outcomes_of({"color": (clean, swapped), "shape": (np.full(400, 0.15), np.full(400, -0.15))}, groups)
    return classify_all({row.category: row for row in swaps_of(outcomes, SUITE)}, {})["color"].behaviour


DRAWS = 300


@pytest.mark.slow
@pytest.mark.parametrize(
    ("groups", "mean", "spread", "other", "expected", "least"),
    [
        (12, 0.0, 0.02, 0.0, "not used", 0.95),
        (24, 0.0, 0.10, 0.0, "not used", 0.95),
        (12, 0.0, 0.02, 1.0, "undecided", 0.95),
        (12, 0.03, 0.02, 0.0, "not used", 0.95),
        (12, 0.10, 0.05, 0.0, "undecided", 0.90),
        (12, 0.2, 0.05, 0.0, "moves with it, does not decide", 0.95),
        (12, 1.0, 0.2, 0.0, "used", 0.95),
    ],
)
def test_a_verdict_is_rarely_wrong_by_chance(
    groups: int, mean: float, spread: float, other: float, expected: str, least: float
) -> None:
    counts = Counter(drawn(seed, groups, mean, spread, other) for seed in range(DRAWS))
    assert counts[expected] >= least * DRAWS, counts


Kind = Callable[[int], tuple[np.ndarray, np.ndarray]]


def test_who_goes_where_the_correct_picture_lies_follows() -> None:
    swap = of(follower(48))
    assert (swap.follow_rate, swap.reversal_rate, swap.net_follow_rate) == (1.0, 0.0, 1.0)
    assert swap.follow_p == 2.0**-24
    assert swap.median_displacement == pytest.approx(0.2)
    assert (swap.reach, swap.reach_source) == (pytest.approx(0.2), "actions")
    assert (swap.reach_share, swap.moved_share) == (pytest.approx(1.0), pytest.approx(1.0))
    assert (swap.left_reached, swap.right_reached) == (1.0, 1.0)


def test_the_mirror_of_following_is_going_against() -> None:
    plain, exchanged = follower(48)
    swap = of((-plain, -exchanged))
    assert (swap.follow_rate, swap.reversal_rate) == (0.0, 1.0)
    assert swap.reach_share == pytest.approx(-1.0)
    assert (swap.left_reached, swap.right_reached) == (-1.0, -1.0)
    assert swap.follow_p == 1.0


def test_a_habit_is_no_following_however_often_it_is_right() -> None:
    """Half of its episodes end on the correct picture."""
    swap = of(habit(48))
    assert (swap.follow_rate, swap.reversal_rate) == (0.0, 0.0)
    assert swap.follow_p > 0.1
    assert swap.reach_share == pytest.approx(0.0, abs=1e-4)
    assert swap.net_follow_rate_ci[1] > 0  # that nothing was seen does not prove that nothing is there


def test_the_reach_of_a_policy_that_goes_to_one_side_is_the_distance_between_the_tiles() -> None:
    swap = of((np.where(np.arange(48) // 2 % 2 == np.arange(48) % 2, 0.1, -0.1), np.zeros(48)))
    assert (swap.reach, swap.reach_source) == (TILES_APART, "tiles")
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
        swap = of((plain, exchanged), groups=16)
        assert (
            swap.net_follow_rate_ci[0] <= like.net_follow_rate_ci[0] or swap.net_follow_rate > like.net_follow_rate
        )
        assert (
            swap.net_follow_rate_ci[1] >= like.net_follow_rate_ci[1] or swap.net_follow_rate < like.net_follow_rate
        )


def test_items_that_share_pictures_do_not_add_up() -> None:
    assert of(follower(48)).follow_p < of(follower(48), groups=3).follow_p == 2.0**-3


def test_answers_are_read_back_as_they_were() -> None:
    outcomes = outcomes_of({"color": follower(4), "shape": habit(4)})
    back = ConditionOutcomes(**arrays_from_bytes(outcomes.to_bytes()))
    assert back.to_bytes() == outcomes.to_bytes()
    assert back.conditions == outcomes.conditions
    np.testing.assert_array_equal(back.displacement, outcomes.displacement)
    assert dict(back.by_category())["shape"].items.tolist() == ["shape-0", "shape-0", "shape-1", "shape-1"]
