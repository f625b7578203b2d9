"""Verdicts on policies whose wiring is known: what they read, and where, is written down in `wirings`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression

from probe_kit import patching as pt
from probe_kit.errors import UsageError
from probe_kit.hooks import Site, capture
from probe_kit.intervene import ConditionOutcomes, ImageSwapEffect, UseVerdict, classify_all
from probe_kit.intervene.evidence import describe_tie, tie_at_site
from probe_kit.intervene.kinds.interchange import localised_sites, patch_of, patches_within
from probe_kit.intervene.kinds.joint import (
    JointEffect,
    JointPlaces,
    describe_joint_places,
    describe_remainders,
)
from probe_kit.intervene.patching import Cell
from probe_kit.intervene.places import resolve_sites
from probe_kit.intervene.replay import Condition
from probe_kit.intervene.settings import PER_STEP
from tests.intervene.answers import measured, patches_of, swaps_of
from tests.intervene.wirings import WIRINGS, WORDS, WiredSession, outcomes_of, replay_inputs

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

SUITE = "suite@1#0123456789ab"
VERDICTS = {
    "copied": "used",
    "unread": "not used",
    "nonlinear": "used",
    "marks": "used",
    "other": "undecided",
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
    "one-sided": "partly used, one-sided (left)",  # was *undecided*
    "rarely": "partly used, graded",  # was *used*
    "trace": "not used",
    "late": "not used",
    "against": "against: used",
    "once": "used",  # these three were written after the rules
    "opposite": "used",
    "half": "used",  # decides in half of the items, which is where *used* begins
    "norms": "used",  # these seven were written for the rules as they stood; they changed places and ties
    "shared": "used",
    "beside": "used",
    "opposing": "used",
    "balance": "used",
    "behind": "used",
    "either": "undecided",
}
Verdicts = Mapping[str, UseVerdict]


@pytest.fixture(scope="module")
def wired() -> WiredSession:
    return WiredSession()


@pytest.fixture(scope="module")
def effects(wired: WiredSession) -> dict[str, ImageSwapEffect]:
    """Of the first chunk, all wirings as categories of one run."""
    return {row.category: row for row in swaps_of(outcomes_of(wired, list(WIRINGS)), SUITE)}


@pytest.fixture(scope="module")
def verdicts(effects: dict[str, ImageSwapEffect]) -> Verdicts:
    return classify_all(effects, {})


def test_every_wiring_has_a_truth() -> None:
    assert VERDICTS.keys() == WIRINGS.keys()


@pytest.mark.parametrize("name", WIRINGS)
def test_the_verdict_is_true_of_the_wiring(name: str, verdicts: Verdicts) -> None:
    assert verdicts[name].verdict == VERDICTS[name]
    assert "in the first chunk" in verdicts[name].sentence
    assert "episode" not in verdicts[name].sentence.partition(":")[0]


def test_the_reach_is_the_distance_between_what_the_policies_choose(effects: dict[str, ImageSwapEffect]) -> None:
    """30 cm, although seven wirings move weakly or always to one side."""
    assert {row.reach_source for row in effects.values()} == {"actions"}
    assert effects["copied"].reach == pytest.approx(0.30, abs=0.01)
    assert effects["faint"].reach_share == pytest.approx(0.2, abs=0.01)


def test_reasons_name_what_was_measured(verdicts: Verdicts) -> None:
    assert "trace of 1.0 cm" in verdicts["trace"].reason
    assert "the images move it by 1.0" in verdicts["other"].reason
    assert "or on the answer in opposite directions" in verdicts["either"].reason
    assert "positive control: " in verdicts["constant"].reason


def test_a_decision_after_the_first_chunk_shows_in_the_whole_episode(wired: WiredSession) -> None:
    """The first chunk approaches; *not used* of it was said of the policy."""
    names = ["late", "constant", "copied"]
    outcomes = outcomes_of(wired, names, calls=3)
    rows = {row.category: row for row in swaps_of(outcomes, SUITE, readout=PER_STEP)}
    uses = classify_all(rows, {})
    assert {name: use.verdict for name, use in uses.items()} == {
        "late": "used", "constant": "not used", "copied": "used",
    }  # fmt: skip
    first = {row.category: row for row in swaps_of(outcomes_of(wired, names), SUITE)}
    both = classify_all(first, {}, other_readouts=uses)
    assert {name: use.verdict for name, use in both.items()} == {
        "late": "first chunk not used; episode used", "constant": "not used", "copied": "used",
    }  # fmt: skip
    assert both["copied"].sentence == "The answer is used in the first chunk and over the whole episode."
    assert both["late"].sentence.startswith("The answer is not used in the first chunk: within")
    assert both["late"].sentence.endswith("; it is used over the whole episode.")


# -- place and copy ----------------------------------------------------------------------------------------------


def patched(session: WiredSession, name: str, *patterns: str, role: str = "all") -> ConditionOutcomes:
    """With every place of these patterns patched, one at a time."""
    places = [site_group for pattern in patterns for site_group in resolve_sites(pattern, session.policy)]
    sites = tuple(site for site_group in places for site in site_group.sites)
    conditions: list[Condition] = [patch_of(Cell(site_group, role), sites) for site_group in places]
    return outcomes_of(session, [name], conditions)


@pytest.mark.parametrize(
    ("name", "located"),
    [
        ("copied", ("backbone.01", "kv.01")),
        ("marks", ("kv.00",)),
        ("bypass", ()),  # was *passes at expert.01*
        ("against", ("backbone.01", "kv.01")),  # was nowhere: p was of the direction that it does not take
        ("blocks", ("backbone.01",)),  # two of the three blocks that vote come behind it
    ],
)
def test_a_place_is_named_where_the_answer_is_read(
    wired: WiredSession, name: str, located: tuple[str, ...]
) -> None:
    outcomes = patched(wired, name, "backbone.01", "backbone.02", "kv.*", "expert.01")
    rows = patches_of(outcomes, SUITE)
    assert next(row for row in rows if row.sites == "expert.01").is_localised
    assert localised_sites(rows) == located


# -- joint places ------------------------------------------------------------------------------------------------


def joint(
    session: WiredSession, name: str, sites: str = "kv.*", roles: tuple[str, ...] = ("language",)
) -> dict[str, JointEffect]:
    """By part and cells, what `--kind joint` finds."""
    intervention = JointPlaces(categories=(name,), sites=(sites,), roles=roles)
    conditions = intervention.conditions(session)
    outcomes = outcomes_of(session, [name], conditions[2:])
    entries = dict(session.certificate)
    measurement = measured(outcomes, SUITE, intervention.parameters(), entries, lambda _: b"")
    rows = JointPlaces.effects(measurement)
    return {row.cells if row.part == "cell" else row.part: row for row in rows}


def test_a_single_place_is_read_and_is_the_smallest_set(wired: WiredSession) -> None:
    rows = joint(wired, "copied")
    assert (rows["kv.01 language"].finding, rows["kv.02 language"].finding) == ("read here", "nothing alone")
    assert (rows["minimal"].cells, rows["minimal"].finding) == ("kv.01 language", "read here")
    assert describe_joint_places(list(rows.values())) == "read at kv.01 language"
    assert JointPlaces.notes([rows["minimal"]]) == []
    (note,) = JointPlaces.notes([replace(rows["minimal"], n_groups=4)])
    assert note.startswith("copied: the smallest set is scored in 4 groups, in which no p can be below 0.062")


def test_a_majority_of_blocks_is_read_jointly_and_at_no_single_place(wired: WiredSession) -> None:
    rows = joint(wired, "blocks")
    words = [rows[f"kv.{block:02d} language"] for block in range(3)]
    assert {row.finding for row in words} == {"nothing alone"}
    assert all(abs(row.alone or 0) <= 0.02 and abs(row.needed or 0) <= 0.02 for row in words)
    joint_row = rows["minimal"]
    assert (joint_row.cells, joint_row.finding, joint_row.n_groups) == (
        "kv.01 language + kv.02 language",
        "read jointly",
        6,
    )
    assert (joint_row.alone or 0) >= 0.95
    assert describe_joint_places(list(rows.values())).startswith("no single place: read jointly at kv.01")


def test_a_majority_of_roles_is_found_within_one_block(wired: WiredSession) -> None:
    rows = joint(wired, "roles", "kv.01", ("image", "language", "state"))
    assert rows["minimal"].cells == "kv.01 language + kv.01 state"
    assert rows["minimal"].finding == "read jointly"


def test_what_bypasses_the_backbone_is_past_all_cells(wired: WiredSession) -> None:
    rows = joint(wired, "bypass")
    assert rows["every-cell"].finding == "past it"
    assert "minimal" not in rows
    assert describe_joint_places(list(rows.values())) == "past kv language"
    for site, sentence in (
        ("kv.01", "past kv.01 language, state"),
        ("backbone.02", "past backbone.02 language, state"),
    ):
        part = joint(wired, "bypass", site, ("language", "state"))
        assert describe_joint_places(list(part.values())) == sentence, "null results of a part are of that part"


def test_a_place_that_carries_half_is_named_with_the_one_that_carries_the_rest(wired: WiredSession) -> None:
    """Was *read at kv.01 language*."""
    rows = joint(wired, "shared", "kv.01", ("image", "language", "state"))
    expected = "read jointly at kv.01 language + kv.01 state (alone: kv.01 language 0.55)"
    assert describe_joint_places(list(rows.values())) == expected


def test_what_opposes_the_effect_is_read_too(wired: WiredSession) -> None:
    """Was *nothing alone* and *past kv*: bounds had one side."""
    rows = joint(wired, "opposing")
    assert [rows[f"kv.{block:02d} language"].finding for block in range(3)] == [
        "nothing alone", "opposes it", "nothing alone",
    ]  # fmt: skip
    assert rows["every-cell"].finding == "opposes it"
    assert describe_joint_places(list(rows.values())) == ""
    opposed = "opposed at kv.01 language; all cells of kv language carry -2.00 of it"
    assert "; ".join(describe_remainders(list(rows.values()))) == opposed
    rows = joint(wired, "balance")
    assert describe_joint_places(list(rows.values())) == "read at kv.01 language"
    assert describe_remainders(list(rows.values())) == ("opposed at kv.02 language",)


def test_what_acts_against_the_answer_reads_it_where_all_others_do(wired: WiredSession) -> None:
    """Joint places, screens and sweeps test the direction that the swap itself takes."""
    rows = joint(wired, "against")
    assert (rows["kv.01 language"].finding, rows["minimal"].finding) == ("read here", "read here")
    pairs, cells = pt.find_pairs(wired, "against"), pt.find_cells(wired.policy, "kv.*|language")
    swept = pt.sweep_cells(wired.policy, pairs, cells, wired.lateral_displacement)
    assert swept.table["share"].round(2).tolist() == [0, 1, 0]
    assert (swept.table["p_fwe"] < 0.01).tolist() == [False, True, False]
    assert pt.attribute_cells(wired.policy, pairs, cells, wired.lateral_motion).finding == "anchored"


def test_an_exchange_finds_the_place_that_a_backup_hides_from_erasing(wired: WiredSession) -> None:
    rows = joint(wired, "backup")
    assert rows["kv.01 language"].finding == "read here"
    assert (rows["kv.01 language"].alone or 0) == pytest.approx(1.0, abs=0.02)


def test_layers_that_follow_each_other_are_no_parallel_cells(wired: WiredSession) -> None:
    with pytest.raises(UsageError, match="one after the other"):
        JointPlaces(categories=("copied",), sites=("backbone.*",)).conditions(wired)
    with pytest.raises(UsageError, match="two cells or more"):
        JointPlaces(categories=("copied",), sites=("kv.01",), roles=("image",)).conditions(wired)
    with pytest.raises(UsageError, match="share no token"):
        JointPlaces(roles=("all", "image"))


# -- ties --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OneDirection:
    """The direction of the answer in the words' mean, as a probe finds it: the same for every episode."""

    vector: np.ndarray
    control_names: tuple[str, ...] = ("control-1",)

    def basis(self, name: str, episode: str) -> np.ndarray:
        del episode
        other = np.zeros_like(self.vector)
        other[-1] = 1.0
        return (other if name.startswith("control") else self.vector)[None]


def probed_direction(session: WiredSession, name: str, site: Site) -> np.ndarray:
    """(D,) unit weights of a logistic probe of the answer in the mean over the words."""
    features, labels = [], []
    for replay_input in replay_inputs(name):
        with capture(session.policy, [site]) as cache:
            session.act(replay_input.clean, replay_input.seed)
        features.append(cache[site][0, WORDS].mean(0).numpy())
        labels.append(replay_input.side)
    weights = LogisticRegression(C=0.1).fit(np.array(features), labels).coef_[0]
    return (weights / np.linalg.norm(weights)).astype(np.float32)


def tie_of(session: WiredSession, name: str, layer: int, called: str = "mean-difference") -> str:
    """At the words of one layer of the backbone. called: as what the direction is stored."""
    (site_group,) = resolve_sites(f"backbone.{layer:02d}", session.policy)
    direction = OneDirection(probed_direction(session, name, site_group.only_site))
    roles = ("language", "all", "image", "state")
    conditions: list[Condition] = [patch_of(Cell(site_group, role), site_group.sites) for role in roles]
    conditions += patches_within(called, direction, Cell(site_group, "language"), site_group.sites)
    rows = patches_of(outcomes_of(session, [name], conditions), SUITE)
    layer, along = rows[: len(roles)], rows[len(roles) :]
    return tie_at_site(layer[0], [row for row in along if not row.is_control], layer)


@pytest.mark.parametrize(
    ("name", "ties"),
    [
        ("copied", {1: "read", 2: "unread"}),
        ("bypass", {1: "unread", 2: "unread"}),  # was *used* beside a copy that nothing reads
        ("elsewhere", {1: "unread", 2: "unread"}),
        ("code", {1: "another code", 2: "unread"}),
        ("decoy", {1: "read"}),  # two copies that always agree are one direction to any patch
        ("roles", {1: "in part", 2: "unread"}),  # was *unread*: the words are one of three parts that decide
        ("opposite", {1: "read", 2: "read", 3: "unread"}),
        ("opposing", {1: "in part", 2: "unread"}),  # was *unread*, but it is read against the effect
        ("balance", {1: "read", 2: "in part"}),
        ("behind", {2: "unread", 3: "unread"}),
    ],
)
def test_the_copy_that_probes_read_is_told_from_the_one_that_is_used(
    wired: WiredSession, name: str, ties: dict[int, str]
) -> None:
    assert {layer: tie_of(wired, name, layer) for layer in ties} == ties


def test_a_probe_alone_does_not_show_another_code(wired: WiredSession) -> None:
    """`--direction probe` carries 0.05 of a copy that is read, and was *another code*."""
    assert tie_of(wired, "code", 1, called="probe") == "not tested"


def test_the_tie_of_all_sites_is_said_in_one_sentence() -> None:
    read, unread = ("backbone.01", "all"), ("backbone.02", "all")
    assert describe_tie({read: "read", unread: "unread"}) == "the readable copy is read (backbone.01 all)"
    elsewhere = "the readable copy is not the one used: the answer passes elsewhere"
    assert describe_tie({read: "unread", unread: "unread"}) == elsewhere
    assert "another code in the same place (backbone.01 all)" in describe_tie(
        {read: "another code", unread: "unread"}
    )
    open_ = "whether the readable copy is the one used remains open"
    assert describe_tie({read: "in part", unread: "unread"}) == open_
    assert describe_tie({unread: "unread"}, is_joint=True) == open_, "it can be one of several parts"
    assert describe_tie({read: "read", unread: "unread"}, is_joint=True).startswith("the readable copy is read")
    assert describe_tie({read: "not tested", unread: "unread"}) == ""
    assert describe_tie({}) == ""
