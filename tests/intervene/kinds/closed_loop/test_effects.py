"""What is said of where cubes ended, on outcomes made by hand."""

from collections.abc import Sequence

import numpy as np
import pytest

from probe_kit.intervene import ClosedLoopEffect, ConditionOutcomes
from probe_kit.intervene.kinds.closed_loop import closed_loop_effects
from probe_kit.intervene.kinds.site_maps import PatchEffect, best_cell

NAMES = (
    "clean",
    "image_swap",
    "backbone.02|image",
    "backbone.02|image|mean-difference",
    "backbone.02|image|control-1",
)
RIGHT, WRONG, OUT = "correct", "wrong", "oob"


def made(episode_outcomes: Sequence[Sequence[str]], names: Sequence[str] = NAMES) -> ConditionOutcomes:
    """episode_outcomes: (K, E), two layouts an item, each item a group of its own."""
    episodes = len(episode_outcomes[0])
    items = np.array([f"color-{number // 2}" for number in range(episodes)])
    shape = len(names), episodes
    return ConditionOutcomes(
        conditions=tuple(names),
        episodes=np.array([f"{item}:{'os'[number % 2]}" for number, item in enumerate(items)]),
        items=items,
        groups=items,
        categories=np.full(episodes, "color"),
        sides=np.array([("left", "right")[number % 2] for number in range(episodes)]),
        displacement=np.zeros(shape),
        max_action_change=np.zeros(shape),
        edit_log=np.zeros((*shape, 5)),
        replay_error=np.zeros(episodes),
        episode_outcomes=np.array(episode_outcomes),
    )


def found(episode_outcomes: Sequence[Sequence[str]], names: Sequence[str] = NAMES) -> dict[str, ClosedLoopEffect]:
    return {row.name: row for row in closed_loop_effects(made(episode_outcomes, names), "suite")}


def test_a_choice_that_turns_beyond_its_control_is_confirmed() -> None:
    rows = found([[RIGHT] * 16, [WRONG] * 16, [WRONG] * 16, [WRONG] * 14 + [OUT] * 2, [RIGHT] * 16])
    assert [row.finding for row in rows.values()] == ["identity patch", *["confirmed"] * 3, "control"]
    along = rows["backbone.02 image mean-difference"]
    assert (along.net, along.control_net, along.in_zone, along.wrong_in_zone) == (0.875, 0.0, 0.875, 1.0)
    assert (along.gained, along.lost) == (14, 0)
    assert along.p_mcnemar == pytest.approx(2 * 0.5**14)
    assert rows["backbone.02 image"].p_fwe == pytest.approx(1 / 2**8)
    assert rows["clean"].p is None


def test_what_its_control_does_as_well_is_not_confirmed() -> None:
    rows = found([[RIGHT] * 16, [WRONG] * 16, [RIGHT] * 16, [WRONG] * 16, [WRONG] * 16])
    assert rows["backbone.02 image mean-difference"].finding == "not confirmed"
    assert rows["backbone.02 image"].finding == "not confirmed"


def test_a_broken_hand_enters_no_verdict_and_no_family() -> None:
    """Neither as a claim, nor as a control that a claim is compared with."""
    broken = [WRONG] * 7 + [OUT] * 9
    rows = found([[RIGHT] * 16, [WRONG] * 16, broken, [WRONG] * 16, broken])
    assert rows["backbone.02 image"].finding == "task disrupted"
    assert rows["backbone.02 image"].p_fwe is None
    assert rows["backbone.02 image"].net > 0
    assert rows["backbone.02 image control-1"].finding == "task disrupted"
    assert rows["backbone.02 image mean-difference"].control_net is None
    assert rows["backbone.02 image mean-difference"].finding == "confirmed"
    half = [WRONG] * 8 + [OUT] * 8
    assert not found([[RIGHT] * 16, half], NAMES[:2])["image_swap"].disrupted


def test_falling_out_of_the_zones_is_no_turn() -> None:
    rows = found([[RIGHT] * 16, [OUT] * 6 + [RIGHT] * 10], NAMES[:2])
    assert rows["image_swap"].net == 0
    assert rows["image_swap"].correct == 0.625
    assert rows["image_swap"].finding == "not confirmed"


def test_sides_are_of_the_picture_that_is_turned_to() -> None:
    rows = found([[RIGHT] * 16, [WRONG, RIGHT] * 8], NAMES[:2])
    assert (rows["image_swap"].net_left, rows["image_swap"].net_right) == (0.0, 1.0)


def test_nothing_in_a_zone_is_no_ratio() -> None:
    rows = found([[OUT] * 16, [OUT] * 16], NAMES[:2])
    assert rows["image_swap"].wrong_in_zone is None
    assert not rows["image_swap"].disrupted


def test_shuffled_conditions_are_seldom_confirmed() -> None:
    """Plain and changed outcomes of the same coin: not above one in twenty."""
    draw = np.random.default_rng(0)
    confirmed = [
        found(draw.choice([RIGHT, WRONG, OUT], size=(2, 16)).tolist(), NAMES[:2])["image_swap"].finding
        == "confirmed"
        for _ in range(100)
    ]
    assert sum(confirmed) <= 5


def test_stored_answers_come_back_with_outcomes_and_without() -> None:
    outcomes = made([[RIGHT, WRONG], [OUT, WRONG]], NAMES[:2])
    again = ConditionOutcomes.from_bytes(outcomes.to_bytes())
    assert again.episode_outcomes is not None
    np.testing.assert_array_equal(again.episode_outcomes, [[RIGHT, WRONG], [OUT, WRONG]])


def place(name: str, role: str, effect: float, p: float = 0.001) -> PatchEffect:
    return PatchEffect(
        category="color", place=name, role=role, direction="", coefficient="", is_control=False,
        n_episodes=8, n_items=4,
        effect=effect, effect_ci=(effect, effect), net=0.0, net_ci=(0.0, 0.0), net_left=0.0, net_right=0.0,
        mean_displacement=0.0, control_displacement=None,
        t=0.0, p=p, p_fwe=p, max_action_change=0.0, fires=0, no_op_fires=0, relative_change=0.0,
    )  # fmt: skip


def test_the_best_cell_is_the_last_located_place_in_its_narrowest_role() -> None:
    rows = [
        place("backbone.00", "all", 1.0), place("backbone.02", "all", 0.99), place("backbone.02", "image", 0.9),
        place("backbone.02", "language", 0.1), place("backbone.03", "all", 0.0, 1.0),
    ]  # fmt: skip
    cells = [best_cell(rows), best_cell(rows[:2])]
    assert [cell and (cell.place, cell.role) for cell in cells] == [
        ("backbone.02", "image"),
        ("backbone.02", "all"),
    ]
    assert best_cell(rows[3:]) is None
