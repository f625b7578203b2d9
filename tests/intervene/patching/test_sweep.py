"""Sweeps and sets of cells on policies whose wiring is written down; see `wirings`."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from probe_kit import patching as pt
from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.intervene.kinds.interchange import patch_of
from tests.intervene.answers import patches_of
from tests.intervene.wirings import WiredSession, outcomes_of

KV = "kv.*|image,language,state"


@pytest.fixture(scope="module")
def wired() -> WiredSession:
    return WiredSession()


@pytest.fixture(scope="module")
def copied(wired: WiredSession) -> pt.Sweep:
    cells = pt.find_cells(wired.policy, "backbone.*|all,image", KV)
    return pt.sweep_cells(wired.policy, pt.find_pairs(wired, "copied"), cells, wired.lateral_displacement)


def test_the_place_that_is_read_carries_everything_and_no_other_block_does(copied: pt.Sweep) -> None:
    table = copied.table.set_index("cells")
    assert table.loc["kv.01 language", "share"] == pytest.approx(1, abs=0.05)
    assert table.loc["kv.01 language", "p_fwe"] < 0.01
    other_cells = table.loc[[name for name in table.index if name.startswith("kv") and name != "kv.01 language"]]
    assert other_cells["share"].abs().max() < 0.05
    assert other_cells["p_fwe"].min() > 0.05
    assert table.loc["backbone.00 image", "share"] == pytest.approx(1, abs=0.05)
    assert table.loc["backbone.01 image", "share"] == pytest.approx(0, abs=0.05)
    assert set(table["n_pairs"]) == {24}
    assert set(table["n_groups"]) == {12}


def test_a_sweep_gives_the_numbers_of_the_interchange(copied: pt.Sweep, wired: WiredSession) -> None:
    chosen_rows = [
        row for row, name in enumerate(copied.names) if name.endswith(("01 image", "01 language", "01 all"))
    ]
    cells = [copied.cells[row][0] for row in chosen_rows]
    sites = tuple(dict.fromkeys(site for cell in cells for site in cell.site_group.sites))
    stored = outcomes_of(wired, ["copied"], [patch_of(cell, sites) for cell in cells])
    rows = copied.table.iloc[chosen_rows].iterrows()
    for at, (effect, (row, record)) in enumerate(zip(patches_of(stored, "suite"), rows, strict=True)):
        assert f"{effect.sites} {effect.role}" == record["cells"]
        assert record["share"] == pytest.approx(effect.effect, abs=1e-9)
        assert record["moved"] == pytest.approx(effect.mean_displacement, abs=1e-9)
        np.testing.assert_array_equal(copied.patched[row], stored.displacement[2 + at])


def test_a_heatmap_has_layers_by_roles(copied: pt.Sweep) -> None:
    axes = copied.heatmap("moved").axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["all", "image", "language", "state"]
    places = [label.get_text() for label in axes.get_xticklabels()]
    assert places == ["backbone.00", "backbone.01", "backbone.02", "backbone.03", "kv.00", "kv.01", "kv.02"]
    (image,) = axes.images
    grid = np.ma.filled(image.get_array(), np.nan)
    table = copied.table.set_index("cells")
    assert grid[2, 5] == pytest.approx(table.loc["kv.01 language", "moved"])
    assert np.isnan(grid[0, 5]), "kv was not swept over all tokens"


@pytest.mark.parametrize("quantity", ["heads", "a_quantity_with_a_name_that_is_as_long_as_any"])
@pytest.mark.parametrize(
    ("places", "roles"),
    [(1, 1), *(pytest.param(*size, marks=pytest.mark.slow) for size in ((4, 1), (32, 1), (6, 3)))],
)
def test_a_heatmap_leaves_its_cells_room_beside_long_names(
    copied: pt.Sweep, places: int, roles: int, quantity: str
) -> None:
    cell = copied.cells[0][0]
    groups = [replace(cell.site_group, name=f"backbone.02.{quantity}.{n}") for n in range(places)]
    cells = [(replace(cell, site_group=group, role=f"role-{r}"),) for group in groups for r in range(roles)]
    patched = np.resize(copied.patched, (len(cells), copied.clean.size))
    figure = replace(copied, cells=tuple(cells), patched=patched).heatmap("moved")
    figure.draw_without_rendering()  # constrained layouts without room warn, which is an error here
    axes, bar = figure.axes
    size = axes.get_window_extent()
    assert size.height / figure.dpi >= 0.9 * 0.4 * roles
    assert size.width / figure.dpi >= 0.9 * 0.4 * places
    ticks = sorted(t.get_window_extent().y0 for t in bar.get_yticklabels() if t.get_text())
    assert all(upper - lower > 8 for lower, upper in pairwise(ticks))


def test_a_share_of_noise_is_not_given(wired: WiredSession) -> None:
    pairs, cells = pt.find_pairs(wired, "unread", 6), pt.find_cells(wired.policy, "kv.01|language")
    swept = pt.sweep_cells(wired.policy, pairs, cells, wired.lateral_displacement)
    assert swept.source_p > 0.05
    assert swept.table["share"].isna().all()
    assert swept.table["moved"].notna().all()
    with pytest.raises(UsageError, match=r"no cell has a share: p of the source itself is .*; take 'moved'"):
        swept.heatmap()


def test_pairs_are_both_layouts_of_an_item_and_lead_to_the_other_side(wired: WiredSession) -> None:
    pairs = pt.find_pairs(wired, "copied", 3)
    assert [pair.item for pair in pairs] == [f"copied-{n}" for n in (0, 0, 1, 1, 2, 2)]
    assert [pair.toward for pair in pairs] == [1, -1, -1, 1, 1, -1]
    assert all(pair.clean is not pair.source for pair in pairs)
    with pytest.raises(UsageError, match="items is 0"):
        pt.find_pairs(wired, "copied", 0)


def test_a_sweep_refuses_cells_that_it_cannot_patch(wired: WiredSession) -> None:
    cells = pt.find_cells(wired.policy, "kv.01|language")
    with pytest.raises(UsageError, match="a sweep of 1 sets of cells in 0 pairs"):
        pt.sweep_cells(wired.policy, [], cells, wired.lateral_displacement)
    with pytest.raises(UsageError, match="a sweep of 0 sets"):
        pt.sweep_cells(wired.policy, pt.find_pairs(wired, "copied", 1), [], wired.lateral_displacement)
    with pytest.raises(UsageError, match=r"two cells or more; kv\.01 language given"):
        pt.compare_alone_and_without(
            wired.policy, pt.find_pairs(wired, "copied", 1), cells, wired.lateral_displacement
        )
    with pytest.raises(UsageError, match="1 group of pairs cannot be halved"):
        pt.find_minimal_cells(
            wired.policy, pt.find_pairs(wired, "copied", 1), pt.find_cells(wired.policy, KV),
            wired.lateral_displacement,
        )  # fmt: skip


def test_pairs_without_a_group_are_independent(wired: WiredSession) -> None:
    pairs = [pt.Pair(pair.clean, pair.source, pair.seed) for pair in pt.find_pairs(wired, "copied", 2)]
    swept = pt.sweep_cells(
        wired.policy, pairs, pt.find_cells(wired.policy, "kv.01|language"), wired.lateral_displacement
    )
    assert np.unique(swept.groups).size == np.unique(swept.items).size == 4
    assert (swept.toward == 1).all()


# -- sets --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_copy_is_read_here_and_nothing_is_needed_elsewhere(wired: WiredSession) -> None:
    comparison = pt.compare_alone_and_without(
        wired.policy,
        pt.find_pairs(wired, "copied", 8),
        pt.find_cells(wired.policy, KV),
        wired.lateral_displacement,
    ).set_index("cells")
    assert comparison.loc["kv.01 language", "finding"] == "read here"
    assert set(comparison.drop("kv.01 language")["finding"]) == {"nothing alone"}
    assert comparison.loc["kv.01 language", "needed"] == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_of_a_majority_of_blocks_no_single_one_carries_anything_and_two_carry_all(wired: WiredSession) -> None:
    pairs, cells = pt.find_pairs(wired, "blocks"), pt.find_cells(wired.policy, "kv.*|language", "kv.01|state")
    comparison = pt.compare_alone_and_without(wired.policy, pairs, cells, wired.lateral_displacement)
    assert set(comparison["finding"]) == {"nothing alone"}
    minimal = pt.find_minimal_cells(wired.policy, pairs, cells, wired.lateral_displacement)
    assert len(minimal.cells) == 2
    assert {cell.role for cell in minimal.cells} == {"language"}
    assert minimal.share is not None
    assert minimal.share.value == pytest.approx(1, abs=0.05)
    assert minimal.p < 0.05
    assert len(minimal.choosing) == 6
    joint = pt.sweep_cells(wired.policy, pairs, [minimal.cells, *minimal.cells], wired.lateral_displacement)
    assert joint.names[0] == " + ".join(map(str, minimal.cells))
    assert joint.table["share"].round(1).tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(UsageError, match="this sweep has sets of several"):
        joint.heatmap()


def test_a_category_that_the_run_lacks_is_refused(wired: WiredSession) -> None:
    wired.run.location = "here"  # type: ignore[misc]
    with pytest.raises(UnknownCategoryError, match="here has no category 'colour'; it has: copied"):
        pt.find_pairs(wired, "colour")
