"""A screen by gradients: where it orders places, where it is void, and what it never enters.

On policies whose wiring is written down. A mean that is read linearly has its effect as its gradient; a majority
of signs has no slope anywhere, although the joint effect is the whole.
"""

from typing import Any

import pytest

from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks import Policy, Site, gradients_at
from probe_kit.intervene import (
    AttributionEffect,
    AttributionPatching,
    ReplayFiles,
    load_effects,
    run_intervention,
)
from probe_kit.intervene.kinds.attribution import EXACT
from probe_kit.intervene.patching.attribution import kind_of_place
from probe_kit.intervene.results import verdicts_of
from probe_kit.intervene.stored import Measurement
from probe_kit.runs import Run
from tests.intervene.answers import measured, said_of
from tests.intervene.wirings import WiredSession, outcomes_of, replay_inputs

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

SUITE = "suite@1#0123456789ab"
ROLES = ("image", "language", "state")


@pytest.fixture(scope="module")
def wired() -> WiredSession:
    return WiredSession()


def screened(session: WiredSession, name: str, **options: Any) -> Measurement:
    intervention = AttributionPatching(categories=(name,), roles=ROLES, **options)
    conditions = intervention.conditions(session)
    outcomes = outcomes_of(session, [name], conditions[2:])
    entries = dict(session.certificate)
    return measured(
        outcomes, SUITE, intervention.parameters() | {"kind": intervention.kind}, entries, lambda _: b""
    )


def by_name(rows: list[AttributionEffect]) -> dict[str, AttributionEffect]:
    return {row.name: row for row in rows}


def test_attribution_ranks_a_linearly_read_cell_first_and_estimates_its_effect(wired: WiredSession) -> None:
    screen = screened(wired, "copied")
    rows = by_name(AttributionPatching.effects(screen))
    first, anchor = rows["kv.01 language"], rows["kv.* all"]
    assert (first.rank, first.finding) == (1, "anchored")
    assert first.estimate == pytest.approx(1.0, abs=0.02)
    assert first.exact == pytest.approx(1.0, abs=0.02)
    assert (anchor.is_anchor, anchor.rank) == (True, None)
    assert anchor.estimate == pytest.approx(anchor.exact, abs=0.02)
    assert rows["backbone.01 language"].estimate == pytest.approx(1.0, abs=0.02)
    assert all(abs(row.estimate or 0) < 0.02 for row in rows.values() if row.sites in ("kv.00", "kv.02"))
    (sentence,) = AttributionPatching.sentences(list(rows.values()), said_of(screen))
    assert sentence.startswith("Copied: gradients give 1.0")
    assert "; first of kv: kv.01 language 1.0" in sentence


@pytest.mark.parametrize("name", ["blocks", "roles"])
def test_a_screen_is_void_where_a_decision_has_no_slope(wired: WiredSession, name: str) -> None:
    """All of `kv` carries everything, and no gradient shows it."""
    screen = screened(wired, name)
    rows = AttributionPatching.effects(screen)
    assert {row.finding for row in rows} == {"void"}
    assert {row.rank for row in rows} == {None}
    assert (rows[0].name, rows[0].estimate) == ("kv.* all", 0.0)
    assert rows[0].exact == pytest.approx(1.0, abs=0.02)
    (sentence,) = AttributionPatching.sentences(rows, said_of(screen))
    void_sentence = "screen void: gradients give 0.00 where the patch gives 1.00 (kv.* all)"
    assert f"{void_sentence}; no order is shown" in sentence
    assert void_sentence in str(AttributionPatching.table(rows, said_of(screen)).title)


def test_nothing_is_ordered_where_the_swap_moves_nothing(wired: WiredSession) -> None:
    rows = AttributionPatching.effects(screened(wired, "noise"))
    assert {(row.finding, row.rank, row.estimate) for row in rows} == {("n/a", None, None)}
    assert "there is no order" in AttributionPatching.sentences(rows, said_of(screened(wired, "noise")))[0]


def test_the_largest_estimates_and_drawn_cells_are_patched_exactly(wired: WiredSession) -> None:
    screen = screened(wired, "copied", sites=("kv.*",), top=1, controls=2)
    rows = by_name(AttributionPatching.effects(screen))
    exact = {name for name, row in rows.items() if row.exact is not None and not row.is_anchor}
    drawn = {name for name, row in rows.items() if row.is_drawn}
    assert exact == {"kv.01 language", *drawn}
    assert len(drawn) == 2
    assert screen.certificate["attribution"]["drawn"] == sorted(
        f"{EXACT}|{name.replace(' ', '|')}" for name in drawn
    )
    (sentence,) = AttributionPatching.sentences(list(rows.values()), said_of(screen))
    assert sentence.endswith("; of 2 drawn cells the largest exact effect is 0.00.")


def test_cells_are_ordered_among_their_kind_alone() -> None:
    names = ("kv.02", "kv.02.values", "backbone.01", "backbone.01.heads.3", "expert.03", "expert.03@4")
    assert [kind_of_place(name) for name in names] == [
        "kv", "kv values", "backbone", "backbone heads", "expert", "expert iterations",
    ]  # fmt: skip


def test_both_ends_are_the_mean_of_two_gradients(wired: WiredSession) -> None:
    """Where the action is linear they are one."""
    clean, both = (
        by_name(AttributionPatching.effects(screened(wired, "marks", ends=ends))) for ends in ("clean", "both")
    )
    assert clean["kv.00 image"].estimate == pytest.approx(both["kv.00 image"].estimate)


def test_a_gradient_at_kv_is_of_what_the_acting_part_reads_alone(wired: WiredSession) -> None:
    """The block's own reading of the same tokens, and the other tapped sites, do not count."""
    pair, at = replay_inputs("copied")[0], Site("kv", 0, "values")
    backbone_sites = [Site("backbone", layer) for layer in range(4)]
    for sites in ([at], [*backbone_sites, at]):
        _, slopes = gradients_at(
            wired.policy, [pair.clean], [pair.seed], sites, lambda chunks: chunks[0, :, 1].sum()
        )
        assert not slopes[at].any(), "block 0 is not read by the acting part"
    assert slopes[backbone_sites[0]].any()


def test_attribution_refuses_cells_that_it_cannot_screen_and_says_what_to_do() -> None:
    with pytest.raises(UsageError, match="share no token"):
        AttributionPatching(roles=("all",))
    with pytest.raises(UsageError, match="leave --readout out"):
        AttributionPatching(readout="per-step")
    with pytest.raises(UsageError, match="expected clean or both"):
        AttributionPatching(ends="middle")  # type: ignore[arg-type]


def test_a_screen_is_stored_with_the_run_and_enters_no_verdict(
    copy: Run, source: ReplayFiles, twin: Policy
) -> None:
    before = verdicts_of(copy)
    intervention = AttributionPatching(categories=("color",), items=1, sites=("kv.*", "backbone.01"))
    screen = run_intervention(copy, intervention, source, load=lambda *_: twin)
    assert load_effects(copy, kind="attribution").to_csv() == screen.to_csv()
    assert {row.sites for row in screen.effects} == {"kv.*", "kv.00", "kv.01", "kv.02", "backbone.01"}
    assert verdicts_of(copy) == before
    assert screen.certificate["edits"][f"{EXACT}|kv.02|image"]["fires"] > 0


def test_a_family_without_gradients_is_refused_before_anything_is_loaded() -> None:
    from probe_kit.hooks.registry import find_family

    intervention = AttributionPatching()
    assert "gradients" in intervention.required_capabilities
    with pytest.raises(UnsupportedInterventionError, match=r"openvla does not support.*--kind interchange"):
        find_family("openvla").check_intervention("gradients")
