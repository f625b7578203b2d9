"""A screen over pairs on policies whose wiring is written down; see `wirings`."""

from typing import Any

import pytest

from probe_kit import patching as pt
from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.intervene import AttributionPatching
from tests.intervene.answers import measured
from tests.intervene.wirings import WiredPolicy, WiredSession, outcomes_of

ROLES = ("image", "language", "state")
CELLS = tuple(f"{places}|{','.join(ROLES)}" for places in ("kv.*", "backbone.*"))


@pytest.fixture(scope="module")
def wired() -> WiredSession:
    return WiredSession()


def screened(session: WiredSession, name: str) -> pt.Screen:
    cells = pt.find_cells(session.policy, *CELLS)
    return pt.attribute_cells(session.policy, pt.find_pairs(session, name), cells, session.lateral_motion)


@pytest.fixture(scope="module")
def copied(wired: WiredSession) -> pt.Screen:
    return screened(wired, "copied")


def test_gradients_rank_the_read_cell_first_and_agree_with_the_anchor(copied: pt.Screen) -> None:
    table = copied.table.set_index("cells")
    assert copied.finding == "anchored"
    assert table["rank"]["kv.01 language"] == 1
    assert table["estimate"]["kv.01 language"] == pytest.approx(1.0, abs=0.02)
    assert copied.anchor is not None
    assert copied.anchor.estimate == pytest.approx(copied.anchor.exact, abs=0.02)
    assert table["exact"][table["kind"] == ""].notna().all()
    assert table["exact"][table["kind"] != ""].isna().all()
    assert str(copied).startswith("gradients give 1.0")
    assert "first of kv: kv.01 language 1.0" in str(copied)


def test_chosen_cells_are_the_largest_of_each_kind_and_drawn_ones_are_others(copied: pt.Screen) -> None:
    largest, drawn = copied.choose(top=1, drawn=4)
    assert str(largest[0]) == "kv.01 language"
    assert len(largest) == 2
    assert len(drawn) == 4
    assert not set(largest) & set(drawn)
    assert copied.choose(top=1, drawn=4) == (largest, drawn)
    assert len(copied.choose(top=20)[0]) == len(copied.cells) - sum(row.is_anchor for row in copied.rows)


@pytest.mark.parametrize("name", ["blocks", pytest.param("roles", marks=pytest.mark.slow)])
def test_a_screen_is_void_where_signs_decide(wired: WiredSession, name: str) -> None:
    screen = screened(wired, name)
    assert screen.finding == "void"
    assert screen.table["rank"].isna().all()
    expected = "screen void: gradients give 0.00 where the patch gives 1.00 (kv.* all); no order is shown"
    assert str(screen) == expected
    with pytest.raises(UsageError, match=r"screen void: .*; patch cells exactly with sweep_cells"):
        screen.choose()


@pytest.mark.slow
def test_its_numbers_are_those_of_the_command(wired: WiredSession, copied: pt.Screen) -> None:
    intervention = AttributionPatching(categories=("copied",), roles=ROLES)
    conditions = intervention.conditions(wired)
    outcomes = outcomes_of(wired, ["copied"], conditions[2:])
    entries = dict(wired.certificate)
    measurement = measured(
        outcomes, "suite", intervention.parameters() | {"kind": intervention.kind}, entries, lambda _: b""
    )
    stored = {row.name: row for row in AttributionPatching.effects(measurement)}
    assert stored.keys() == set(copied.table["cells"])
    for row in copied.rows:
        assert row.estimate == pytest.approx(stored[row.name].estimate, abs=1e-5), row.name
        if row.is_anchor:
            assert row.exact == pytest.approx(stored[row.name].exact, abs=1e-5), row.name


def test_there_is_no_order_where_the_source_moves_nothing(wired: WiredSession) -> None:
    pairs, cells = pt.find_pairs(wired, "noise", 6), pt.find_cells(wired.policy, "kv.01|language")
    screen = pt.attribute_cells(wired.policy, pairs, cells, wired.lateral_motion)
    assert (screen.finding, screen.anchor) == ("n/a", None)
    assert screen.table["estimate"].isna().all()
    with pytest.raises(UsageError, match="no anchor carries the effect"):
        screen.choose()


def test_a_family_without_gradients_is_refused_before_any_inference(wired: WiredSession) -> None:
    class Undifferentiable(WiredPolicy):
        interventions = Interventions(prompt_kv=True)

        def act(self, *_: Any) -> Any:
            raise AssertionError("played")

    policy = Undifferentiable()
    pairs, cells = pt.find_pairs(wired, "copied", 1), pt.find_cells(policy, "kv.01|language")
    with pytest.raises(UnsupportedInterventionError, match="wired does not support the intervention 'gradients'"):
        pt.attribute_cells(policy, pairs, cells, wired.lateral_motion)
    with pytest.raises(UsageError, match="a screen of 1 cells in 0 pairs"):
        pt.attribute_cells(wired.policy, [], cells, wired.lateral_motion)
