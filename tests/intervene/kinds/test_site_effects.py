"""What passes where: shares of the effect, tests over all places, controls."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from probe_kit.intervene import ConditionOutcomes, PatchEffect, Steering, classify_use
from probe_kit.intervene.kinds.base import ConditionName, Measurement
from probe_kit.intervene.kinds.image_swap import image_swap_effects
from probe_kit.intervene.kinds.site_maps import localised_sites, patch_effects, target_sign
from probe_kit.intervene.results.verdict import Places
from tests.intervene.answers import follower, habit, outcomes_of

SUITE = "suite@1#0123456789ab"


def with_changes(signs: tuple[np.ndarray, np.ndarray], **changes: np.ndarray) -> ConditionOutcomes:
    """changes: by condition (`__` for `|`, `_` for `-`), metres toward the clean images' correct side."""
    made = outcomes_of({"color": signs})
    names = [name.replace("__", "|").replace("_", "-") for name in changes]
    more = np.stack([made.correct_sign * values for values in changes.values()])
    displacement = np.vstack([made.displacement, more])
    return replace(
        made,
        conditions=(*made.conditions, *names),
        displacement=displacement,
        max_action_change=np.abs(displacement - displacement[0]),
        edit_log=np.tile([1.0, 0.0, 10.0, 5.0, 9.0], (*displacement.shape, 1)),
    )


def rows_of(outcomes: ConditionOutcomes) -> dict[str, PatchEffect]:
    return {f"{row.place}|{row.role}|{row.direction}".rstrip("|"): row for row in patch_effects(outcomes, SUITE)}


def test_what_carries_all_has_the_effect_one_and_is_located() -> None:
    plain, exchanged = follower(48)
    rows = rows_of(with_changes((plain, exchanged), a__all=exchanged, b__all=plain, c__all=plain * 0.8))
    assert rows["a|all"].effect == pytest.approx(1.0)
    assert (rows["a|all"].net, rows["a|all"].is_localised) == (1.0, True)
    assert (rows["b|all"].effect, rows["b|all"].p_fwe, rows["b|all"].max_action_change) == (0.0, 1.0, 0.0)
    assert rows["c|all"].effect == pytest.approx(0.1)
    assert rows["c|all"].p_fwe < 0.05


def test_what_carries_it_in_every_policy_locates_nothing() -> None:
    """The swapped images themselves, and the action itself: *used* rested on an expert site."""
    plain, exchanged = follower(48)
    places = ("backbone.00", "backbone.01", "kv.00", "expert.01", "expert.01@0-3")
    rows = rows_of(with_changes((plain, exchanged), **{f"{place}__all": exchanged for place in places}))
    assert all(row.is_localised for row in rows.values())
    assert localised_sites(list(rows.values())) == ("backbone.01", "kv.00")


@pytest.mark.parametrize("target_side", ["wrong", "left", "right", "correct"])
def test_a_steering_is_a_share_of_the_swap_whichever_side_it_pushes_to(target_side: str) -> None:
    plain, exchanged = follower(48)
    made = with_changes((plain, exchanged), a__image__mean_difference__2=exchanged)
    # Every action moves by half of the swap's 0.2 m, toward the side that is pushed to.
    pushed = made.of("clean") + 0.1 * target_sign(made, target_side)
    displacement = np.vstack([made.displacement[:2], pushed])
    (row,) = patch_effects(replace(made, displacement=displacement), SUITE, target_side)
    assert row.effect == pytest.approx(0.5)
    assert row.mean_displacement == pytest.approx(0.1)


def test_the_note_about_one_vector_is_of_steering_along_one_and_not_of_its_controls() -> None:
    plain, exchanged = follower(48)
    still = {f"a__image__{name}__2": plain for name in ("mean_difference:1", "control_1")}
    along_tokens = patch_effects(with_changes((plain, exchanged), **still), SUITE)
    assert Steering.notes(along_tokens, cast("Measurement", None)) == []
    in_all = patch_effects(with_changes((plain, exchanged), a__image__mean_difference__2=plain), SUITE)
    (note,) = Steering.notes(in_all, cast("Measurement", None))
    assert note.startswith("color: one vector that is added to every token moves no action")


def test_shares_of_nothing_are_not_given() -> None:
    plain, exchanged = habit(48)
    rows = rows_of(with_changes((plain, exchanged), a__all=exchanged))
    assert rows["a|all"].effect is None
    assert not rows["a|all"].is_localised


def test_turning_from_the_pushed_side_counts_against_it() -> None:
    plain, exchanged = follower(48)
    rows = rows_of(with_changes((-plain, exchanged), a__all=plain))
    assert rows["a|all"].net == -1.0
    assert rows["a|all"].p == 1.0


def test_what_controls_do_as_well_is_no_effect() -> None:
    draw = np.random.default_rng(0)
    plain, exchanged = follower(48)
    moved = plain - 0.05 - 0.001 * draw.normal(size=48)
    same = plain - 0.05 - 0.001 * draw.normal(size=48)
    changes = {"a__image__mean_difference": moved, "a__image__control_1": same, "b__image__mean_difference": moved}
    rows = rows_of(with_changes((plain, exchanged), **changes))
    assert rows["a|image|mean-difference"].p_fwe > 0.05
    assert rows["b|image|mean-difference"].p_fwe < 0.05  # has no control
    assert rows["a|image|mean-difference"].control_displacement == pytest.approx(0.05, abs=1e-3)
    control = rows["a|image|control-1"]
    assert control.is_control
    assert control.p_fwe is None


def test_the_ledger_is_summed_and_norms_are_compared() -> None:
    plain, exchanged = follower(8)
    row = rows_of(with_changes((plain, exchanged), a__all=exchanged))["a|all"]
    assert (row.fires, row.no_op_fires, row.relative_change) == (8, 0, 0.5)


def test_names_are_taken_apart() -> None:
    assert ConditionName.parse("backbone.02|image|control-1|2") == ConditionName(
        "backbone.02", "image", "control-1", "2"
    )
    whole, along = ConditionName.parse("backbone.02|image"), ConditionName.parse("backbone.02|image|probe")
    control = ConditionName.parse("backbone.02|image|control-1")
    assert control.is_control_of(along)
    assert [str(name) for name in (whole, along)] == ["backbone.02|image", "backbone.02|image|probe"]
    assert not control.is_control_of(whole)
    assert not along.is_control_of(along)


def test_the_place_is_said_beside_the_behaviour_and_does_not_change_it() -> None:
    (found,) = image_swap_effects(outcomes_of({"color": follower(48)}), SUITE)
    places = {
        None: "",
        (): "no place that was tried carries half of it",
        ("backbone.02",): "passes at backbone.02",
        ("kv.02",): "read at kv.02",
        ("backbone.01", "kv.02", "backbone.02"): "passes at backbone.01, backbone.02; read at kv.02",
    }
    for located, expected in places.items():
        use = classify_use(True, found, None, Places(located))
        assert (use.behaviour, use.place) == ("used", expected)
    jointly = "no single place: read jointly at kv.01 language + kv.02 language"
    assert str(Places((), jointly=jointly)) == jointly
    assert str(Places(("backbone.01",), jointly=jointly)) == f"passes at backbone.01; {jointly}"
    assert str(Places(("kv.01",), jointly=jointly)) == jointly, "all tokens of a block do not say which are read"
    assert str(Places(("kv.01 image",), jointly="read at kv.01 image")) == "read at kv.01 image"
    assert str(Places(("kv.01",), jointly="past kv")) == "read at kv.01"
