"""Verdicts on policies whose wiring is known: what they read, and where, is written down in `wirings`."""

from collections.abc import Mapping

import pytest

from probe_kit.intervene import ConditionOutcomes, ImageSwapEffect, UseVerdict, classify_all
from probe_kit.intervene.edits.sites import resolve_sites
from probe_kit.intervene.kinds.image_swap.effects import image_swap_effects
from probe_kit.intervene.kinds.interchange.intervention import PatchedFromSource
from probe_kit.intervene.kinds.site_effects import patch_effects
from probe_kit.intervene.replay.conditions import Condition
from probe_kit.intervene.results.site_maps import localised_sites
from probe_kit.intervene.store.settings import PER_STEP
from tests.intervene.wirings import WIRINGS, WiredSession, outcomes_of

SUITE = "suite@1#0123456789ab"
VERDICTS = {
    "copied": "used",
    "unread": "not used",
    "nonlinear": "used",
    "marks": "used",
    "other": "inconclusive",
    "constant": "not used",
    "noise": "not used",
    "roles": "used",
    "blocks": "used",
    "backup": "used",
    "repair": "used",
    "bypass": "used",
    "elsewhere": "used",
    "code": "used",
    "decoy": "used",
    "weak": "partly used, one-sided (right)",  # was *encoded, unused*
    "shifted": "moves with it, does not decide",  # was *encoded, unused*
    "faint": "partly used, graded",  # was *used*
    "one-sided": "partly used, one-sided (left)",  # was *inconclusive*
    "rarely": "partly used, graded",  # was *used*
    "trace": "not used",
    "late": "not used",
    "against": "against: used",
}
Verdicts = Mapping[str, UseVerdict]


@pytest.fixture(scope="module")
def wired() -> WiredSession:
    return WiredSession()


@pytest.fixture(scope="module")
def effects(wired: WiredSession) -> dict[str, ImageSwapEffect]:
    """Of the first chunk, all wirings as categories of one run."""
    return {row.category: row for row in image_swap_effects(outcomes_of(wired, list(WIRINGS)), SUITE)}


@pytest.fixture(scope="module")
def verdicts(effects: dict[str, ImageSwapEffect]) -> Verdicts:
    return classify_all(effects, {})


def test_every_wiring_has_a_truth() -> None:
    assert VERDICTS.keys() == WIRINGS.keys()


@pytest.mark.parametrize("name", WIRINGS)
def test_the_verdict_is_true_of_the_wiring(name: str, verdicts: Verdicts) -> None:
    assert verdicts[name].verdict == VERDICTS[name]
    is_whole = VERDICTS[name] in ("used", "against: used", "inconclusive")
    assert ("in the first chunk" in verdicts[name].sentence) == (not is_whole)


def test_the_reach_is_the_distance_between_what_the_policies_choose(effects: dict[str, ImageSwapEffect]) -> None:
    """30 cm, although seven wirings move weakly or always to one side."""
    assert {row.reach_source for row in effects.values()} == {"actions"}
    assert effects["copied"].reach == pytest.approx(0.30, abs=0.01)
    assert effects["faint"].reach_share == pytest.approx(0.2, abs=0.01)


def test_reasons_name_what_was_measured(verdicts: Verdicts) -> None:
    assert "trace of 1.0 cm" in verdicts["trace"].reason
    assert "the images move it by 1.0" in verdicts["other"].reason
    assert "positive control: " in verdicts["constant"].reason


def test_what_is_decided_after_the_first_chunk_shows_in_the_episode(wired: WiredSession) -> None:
    """The first chunk approaches; *not used* of it was said of the policy."""
    outcomes = outcomes_of(wired, ["late", "constant", "copied"], calls=3)
    rows = {row.category: row for row in image_swap_effects(outcomes, SUITE, readout=PER_STEP)}
    found = classify_all(rows, {})
    assert {name: one.verdict for name, one in found.items()} == {
        "late": "used", "constant": "not used", "copied": "used",
    }  # fmt: skip


# -- place and copy ----------------------------------------------------------------------------------------------


def patched(session: WiredSession, name: str, *patterns: str, role: str = "all") -> ConditionOutcomes:
    """With every place of these patterns patched, one at a time."""
    places = [place for pattern in patterns for place in resolve_sites(pattern, session.policy)]
    sites = tuple(site for place in places for site in place.sites)
    conditions: list[Condition] = [PatchedFromSource(place, role, sites) for place in places]
    return outcomes_of(session, [name], conditions)


@pytest.mark.parametrize(
    ("name", "located"),
    [
        ("copied", ("backbone.01", "kv.01")),
        ("marks", ("kv.00",)),
        ("bypass", ()),  # was *passes at expert.01*
        ("blocks", ("backbone.01",)),  # two of the three blocks that vote come behind it
    ],
)
def test_a_place_is_named_where_the_answer_is_read(
    wired: WiredSession, name: str, located: tuple[str, ...]
) -> None:
    outcomes = patched(wired, name, "backbone.01", "backbone.02", "kv.*", "expert.01")
    rows = patch_effects(outcomes, SUITE)
    assert next(row for row in rows if row.place == "expert.01").is_localised
    assert localised_sites(rows) == located
