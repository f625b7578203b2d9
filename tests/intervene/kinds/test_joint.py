"""The smallest set that keeps an effect, against effects that are written down."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit._terminal.console import out
from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.intervene import Interchange, InterventionResult, ReplayFiles, run_intervention
from probe_kit.intervene.inventory import listed_interventions
from probe_kit.intervene.kinds.interchange import localised_by_category, stored_site_effects
from probe_kit.intervene.kinds.joint import JointPlaces, stored_joint_places
from probe_kit.intervene.patching.sweep import MOST_SINGLY, find_minimal_set
from probe_kit.runs import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


Cells = tuple[int, ...]


def of_each(effect: Callable[[Cells], float]) -> Callable[[Sequence[Cells]], list[float]]:
    return lambda sets: [effect(cells) for cells in sets]


def majority(cells: Cells) -> float:
    """Of 2, 5 and 7."""
    return float(len({2, 5, 7} & set(cells)) >= 2)


def both(cells: Cells) -> float:
    """3 with 4; each alone does nothing."""
    return float({3, 4} <= set(cells))


def either(cells: Cells) -> float:
    """Two copies."""
    return float(bool({1, 6} & set(cells)))


def single(cells: Cells) -> float:
    return float(8 in cells)


@pytest.mark.parametrize(
    ("effect", "smallest"), [(majority, {5, 7}), (both, {3, 4}), (either, {6}), (single, {8})]
)
@pytest.mark.parametrize("count", [9, MOST_SINGLY + 34])
def test_no_cell_of_the_smallest_set_can_be_left_out(
    effect: Callable[[Cells], float], smallest: set[int], count: int
) -> None:
    cells, share, tried = find_minimal_set(range(count), of_each(effect))
    assert share == effect(cells) == 1.0
    assert all(effect(tuple(set(cells) - {cell})) < 0.9 for cell in cells)
    assert len(cells) == len(smallest)
    if count <= MOST_SINGLY:
        assert set(cells) == smallest
        assert tried <= count * (count + 1) / 2


def test_halves_try_fewer_sets_than_single_cells() -> None:
    *_, tried = find_minimal_set(range(64), of_each(both))
    assert tried < 64 * 65 / 2 / 10


def test_what_costs_least_is_left_out_first() -> None:
    weights = np.array([0.02, 0.5, 0.03, 0.45])
    cells, share, _ = find_minimal_set(range(4), of_each(lambda cells: float(weights[list(cells)].sum())))
    assert cells == (1, 3)
    assert share == pytest.approx(0.95)


def test_every_cell_stays_where_all_are_needed() -> None:
    cells, *_ = find_minimal_set(range(5), of_each(lambda cells: float(len(cells) == 5)))
    assert cells == (0, 1, 2, 3, 4)


SITES, ROLES = ("kv.00", "kv.01"), ("image", "language")


@pytest.fixture(scope="module")
def result(copy: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    intervention = JointPlaces(categories=("color",), items=2, sites=SITES, roles=ROLES)
    return run_intervention(copy, intervention, source, load=lambda *_: twin)


@pytest.mark.slow
def test_one_cell_alone_is_the_interchange_at_its_place_bit_for_bit(
    copy: Run, source: ReplayFiles, twin: "Policy", result: InterventionResult
) -> None:
    intervention = Interchange(categories=("color",), items=2, sites=SITES, roles=ROLES)
    singly = run_intervention(copy, intervention, source, load=lambda *_: twin).outcomes
    for site in SITES:
        for role in ROLES:
            np.testing.assert_array_equal(result.outcomes.of(f"alone|{site}|{role}"), singly.of(f"{site}|{role}"))


@pytest.mark.slow
def test_all_cells_but_one_are_the_other_cells_together(result: InterventionResult) -> None:
    """Block 2 was not named: everything that is patched and left out is known."""
    changed = dict(zip(result.outcomes.conditions, result.outcomes.max_action_change, strict=True))
    assert (changed["every-cell"] > 0).all()
    assert (changed["without|kv.00|image"] != changed["every-cell"]).any()
    fires = {name: row["fires"] for name, row in result.certificate["edits"].items()}
    assert fires["every-cell"] == 4 * fires["alone|kv.00|image"] == 4 / 3 * fires["without|kv.00|image"]


@pytest.mark.slow
def test_it_is_stored_listed_and_shown(copy: Run, result: InterventionResult) -> None:
    rows = stored_joint_places(copy)["color"]
    assert [row.cells for row in rows if row.part == "cell"] == [
        f"{site} {role}" for site in SITES for role in ROLES
    ]
    assert {row.finding for row in rows} == {"n/a"}, "two items are no evidence"
    assert JointPlaces.keys_in_use(copy) == {result.key}
    assert result.key in {stored.key for stored in listed_interventions(copy) if stored.state == "used"}
    assert set(result.certificate["joint"]) == {"color"}
    with out.capture() as printed:
        out.print(result.to_rich(), width=160)
    assert "all cells of kv" in printed.get()
    assert len(result.table) == len(rows)


@pytest.mark.slow
def test_heads_of_one_block_are_cells_and_no_search_of_the_backbone(
    copy: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    selection = {"categories": ("color",), "items": 1, "roles": ("image",)}
    heads = ("backbone.01.heads.2", "backbone.01.heads.3")
    jointly, singly = (
        run_intervention(copy, kind(sites=heads, **selection), source, load=lambda *_: twin).outcomes
        for kind in (JointPlaces, Interchange)
    )
    np.testing.assert_array_equal(
        jointly.of("alone|backbone.01.heads.3|image"), singly.of("backbone.01.heads.3|image")
    )
    rows = stored_site_effects(copy)["color"]
    assert [row.sites for row in rows if row.role == "image" and "heads" in row.sites] == [
        "backbone.01.heads.2",
        "backbone.01.heads.3",
    ]
    assert not any(row.is_by_construction for row in rows if "heads" in row.sites)
    assert "color" not in localised_by_category(stored_site_effects(copy)), (
        "heads alone are no search of the backbone"
    )


def test_heads_of_two_blocks_come_one_after_the_other(copy: Run, source: ReplayFiles, twin: "Policy") -> None:
    intervention = JointPlaces(categories=("color",), items=1, sites=("backbone.*.heads.*",), roles=("image",))
    with pytest.raises(UsageError, match=r"come one after the other.*backbone\.02\.heads\.\*"):
        run_intervention(copy, intervention, source, load=lambda *_: twin)


def test_a_family_without_keys_and_values_is_refused_by_name() -> None:
    (_, kv) = JointPlaces().required_capabilities
    with pytest.raises(UnsupportedInterventionError, match="kv"):
        Interventions().check(kv, "other")
