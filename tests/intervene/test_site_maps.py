"""Changes inside a real network: what is put in, along what, and what the ledger says of it."""

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import EmptyRoleError, RunDamagedError, UnknownSiteError, UsageError
from probe_kit.hooks import Site
from probe_kit.hooks.capturing.edits import ActiveEdits, EditLog, ReplaceInSubspace, ReplaceWith
from probe_kit.intervene import (
    ClosedLoop,
    ConceptErasure,
    ConditionOutcomes,
    Interchange,
    InterventionResult,
    PatchEffect,
    ReplayFiles,
    Steering,
    classify_use,
    load_effects,
    run_intervention,
    stored_site_effects,
)
from probe_kit.intervene.directions import fit_pooled_directions
from probe_kit.intervene.edited_cells import COLUMNS, EditedCell, columns_of
from probe_kit.intervene.kinds.interchange import localised_sites, target_sign
from probe_kit.intervene.outcomes import arrays_from_bytes
from probe_kit.intervene.places import resolve_sites
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.settings import FORMAT
from probe_kit.intervene.tokens import token_mask
from probe_kit.intervene.verdict import Places
from probe_kit.runs import Run
from probe_kit.train import ArrayRun, train_probes
from tests.intervene.answers import follower, habit, measured, outcomes_of, patches_of, store_outcomes, swaps_of

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


LAST = 3


@pytest.fixture(scope="module")
def site_map(copy: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    intervention = Interchange(
        categories=("color",),
        items=2,
        sites=("backbone.00", "backbone.03", "expert.02@0-1"),
        roles=("all", "language"),
    )
    return run_intervention(copy, intervention, source, load=lambda *_: twin)


@pytest.mark.slow
def test_all_tokens_of_the_first_layer_are_the_whole_exchange(site_map: InterventionResult) -> None:
    outcomes = site_map.outcomes
    np.testing.assert_allclose(outcomes.of("backbone.00|all"), outcomes.of("image_swap"), atol=1e-6)


@pytest.mark.slow
def test_a_site_that_nothing_reads_leaves_every_action_bit_for_bit(site_map: InterventionResult) -> None:
    """The ledger tells it from hooks that missed: they fired, and moved what passed."""
    (row,) = (row for row in site_map.effects if (row.sites, row.role) == ("backbone.03", "all"))
    assert row.max_action_change == 0.0
    assert (row.fires, row.no_op_fires) == (4, 0)
    assert row.relative_change > 0
    assert row.p_fwe == 1.0


@pytest.mark.slow
def test_words_are_the_same_before_and_after_the_exchange(site_map: InterventionResult) -> None:
    """In the embeddings only pictures differ, so that taking the words over moves nothing."""
    counts = site_map.certificate["edits"]["backbone.00|language"]
    assert (counts["fires"], counts["no_op_fires"], counts["max_action_change"]) == (4.0, 4.0, 0.0)


@pytest.mark.slow
def test_an_expert_is_changed_at_every_iteration_that_is_named(site_map: InterventionResult) -> None:
    counts = site_map.certificate["edits"]["expert.02@0-1|all"]
    assert counts["fires"] == 2 * 4
    assert "expert.02@0-1|language" not in site_map.certificate["edits"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sites", "roles", "role"),
    [
        (("backbone.02",), ("imgae",), "imgae"),
        (("backbone.02",), ("image", "words"), "words"),
        (("backbone.02",), ("image.wrist",), "image.wrist"),
        (("expert.*",), ("language",), "language"),
        (("kv.*",), ("action",), "action"),
    ],
)
def test_a_role_that_nothing_plays_there_is_refused_and_nothing_is_stored(
    copy: Run, source: ReplayFiles, twin: "Policy", sites: tuple[str, ...], roles: tuple[str, ...], role: str
) -> None:
    before = Interchange.keys_in_use(copy)
    for intervention in (
        Interchange(categories=("color",), items=1, sites=sites, roles=roles),
        ConceptErasure(categories=("color",), items=1, sites=sites[:1], roles=roles),
        ClosedLoop(categories=("color",), items=1, targets=(f"{sites[0]}|{role}",), direction="none", controls=0),
    ):
        with pytest.raises(UsageError, match=f"has the role '{role}'; expected one of all, "):
            run_intervention(copy, intervention, source, load=lambda *_: twin)
    assert Interchange.keys_in_use(copy) == before


@pytest.mark.slow
def test_it_is_read_back_beside_what_else_is_stored(copy: Run, site_map: InterventionResult) -> None:
    assert load_effects(copy, kind="interchange").to_csv() == site_map.to_csv()
    assert {row.sites for row in stored_site_effects(copy)["color"]} == {
        "backbone.00",
        "backbone.03",
        "expert.02@0-1",
    }


@pytest.mark.slow
def test_an_interchange_along_a_direction_takes_no_maps_place(
    copy: Run, source: ReplayFiles, twin: "Policy", site_map: InterventionResult
) -> None:
    intervention = Interchange(
        categories=("color",), items=1, sites=("backbone.02",), roles=("image",), direction="mean-difference"
    )
    assert run_intervention(copy, intervention, source, load=lambda *_: twin).key != site_map.key
    assert {row.key for row in stored_site_effects(copy)["color"]} == {site_map.key}


@pytest.mark.slow
def test_steering_by_nothing_changes_nothing_and_controls_move_as_far(
    copy: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    intervention = Steering(
        categories=("color",), items=2, sites=("backbone.02",), role="image", coefficients=(2.0,), controls=1
    )
    effects = run_intervention(copy, intervention, source, load=lambda *_: twin)
    edits = effects.certificate["edits"]
    assert edits["backbone.02|image|mean-difference|0"]["max_action_change"] == 0.0
    along, control = (edits[f"backbone.02|image|{name}|2"] for name in ("mean-difference", "control-1"))
    assert along["change"] > 0
    assert control["change"] == pytest.approx(along["change"], rel=1e-4)
    assert along["largest_change"] == pytest.approx(along["change"], rel=0.5)
    assert {row.coefficient for row in effects.effects} == {"0", "2"}
    assert "image_swap" in effects.outcomes.conditions, "the effect is a share of the swap"


# -- along what ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_mean_difference_is_found_without_the_episode_it_is_used_on(copy: Run) -> None:
    """Where it lies is planted; a probe's weights and controls are of length 1 as well."""
    axes = fit_pooled_directions(copy, Site("backbone", 2), "image", "mean-difference", 3, seed=0)
    episodes = copy.episodes
    assert set(axes.halves) == set(episodes["episode_id"])
    name, category = str(episodes["episode_id"][0]), str(episodes["category"][0])
    features = copy.column(Site("backbone", 2), "mean:image").astype(float)
    unit = axes.basis("mean-difference", name)[0]
    in_fold = {half for half in axes.halves if np.array_equal(axes.basis("mean-difference", half)[0], unit)}
    in_category = (episodes["category"] == category).to_numpy()
    outside_fold = in_category & ~episodes["episode_id"].isin(in_fold).to_numpy()
    is_left = (episodes["side_correct"] == "left").to_numpy()
    expected = features[outside_fold & is_left].mean(axis=0) - features[outside_fold & ~is_left].mean(axis=0)
    np.testing.assert_allclose(unit, expected / np.linalg.norm(expected), atol=1e-5)
    assert axes.halves[name].item() == pytest.approx(np.linalg.norm(expected) / 2, rel=1e-5)
    groups = dict(zip(episodes["episode_id"].astype(str), episodes["group_id"].astype(str), strict=True))
    assert not {groups[episode] for episode in in_fold} & {
        str(group) for group in episodes["group_id"][outside_fold]
    }
    for control in axes.control_names:
        vector = axes.basis(control, name)[0]
        assert np.linalg.norm(vector) == pytest.approx(1.0, rel=1e-5)
        assert abs(float(vector @ unit)) < 1e-5


@pytest.mark.slow
def test_a_direction_that_does_not_exist_is_refused(copy: Run) -> None:
    with pytest.raises(UsageError, match="expected one of mean-difference, probe"):
        fit_pooled_directions(copy, Site("backbone", 2), "image", "mean-difference:1", 0, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["mean-difference", "probe"])
@pytest.mark.parametrize("role", ["all", "image", "language"])
def test_the_networks_input_has_no_direction(copy: Run, direction: str, role: str) -> None:
    """The suite asks of every picture both ways; the first layer combines it with the words."""
    with pytest.raises(UsageError, match=f"color, .*00.*, role {role}: no direction for {direction}"):
        fit_pooled_directions(copy, Site("backbone", 0), role, direction, 1, seed=0)


@pytest.mark.slow
def test_the_probes_direction_is_another_one(copy: Run) -> None:
    episode = str(copy.episodes["episode_id"][0])
    mean, probe = (
        fit_pooled_directions(copy, Site("backbone", 2), "image", name, 0, seed=0).basis(name, episode)[0]
        for name in ("mean-difference", "probe")
    )
    assert 0 < float(mean @ probe) < 0.999


@pytest.mark.slow
def test_along_every_direction_is_the_whole_and_along_none_is_nothing() -> None:
    import torch

    draw = np.random.default_rng(0)
    received, other = (torch.from_numpy(draw.normal(size=(5, 4)).astype(np.float32)) for _ in range(2))
    site, mask = Site("backbone", 0), np.array([True, False, True, True, True])
    basis = np.linalg.qr(draw.normal(size=(4, 4)))[0].astype(np.float32)
    source = {site: other[None]}
    where = torch.from_numpy(np.flatnonzero(mask))
    edited_tokens = received[None, where]
    replaced = ReplaceWith(source, 5)(site, edited_tokens, where)  # type: ignore[arg-type]
    np.testing.assert_array_equal(replaced[0].numpy(), other.numpy()[mask])
    along = ReplaceInSubspace(source, 5, basis)(site, edited_tokens, where)  # type: ignore[arg-type]
    np.testing.assert_allclose(along.numpy(), replaced.numpy(), atol=1e-5)
    rank_one = ReplaceInSubspace(source, 5, basis[:1])(site, edited_tokens, where)  # type: ignore[arg-type]
    np.testing.assert_allclose(rank_one.numpy() @ basis[0], replaced.numpy() @ basis[0], atol=1e-5)
    np.testing.assert_allclose(rank_one.numpy() @ basis[1], edited_tokens.numpy() @ basis[1], atol=1e-5)


@pytest.mark.slow
def test_what_fires_moved_is_summed_whatever_their_shapes() -> None:
    """Two fires of one shape, one of another; the second moves nothing. By hand."""
    import torch

    active, sites = ActiveEdits(), (Site("backbone", 0), Site("backbone", 1), Site("expert", 0))
    matrix, other = torch.tensor([[3.0, 4.0], [0.0, 1.0]]), torch.tensor([[2.0, 0.0, 0.0]])
    tokens = (matrix, matrix + torch.tensor([[0.0, 2.0], [0.0, 4.0]])), (other, -other), (matrix, matrix)
    active.fired += [
        (site, before[None], after[None]) for site, (before, after) in zip(sites, tokens, strict=True)
    ]
    edit_log = EditLog(active.measured())
    assert [entry.site for entry in edit_log.entries] == [str(site) for site in sites]
    assert edit_log.row().tolist() == [3, 1, (3 + 2 + 3) / 3, (3 + 4 + 0) / 3, 4]
    assert EditLog.sum([edit_log, edit_log]).row().tolist() == [6, 2, 8 / 3, 7 / 3, 4]
    assert EditLog(ActiveEdits().measured()) == EditLog()


# -- where ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_places_are_layers_or_layers_over_iterations(twin: "Policy") -> None:
    assert [site_group.name for site_group in resolve_sites("backbone.*", twin)] == [
        f"backbone.{n:02d}" for n in range(LAST + 1)
    ]
    (some,) = resolve_sites("expert.01@2-4", twin)
    assert [site.iteration for site in some.sites] == [2, 3, 4]
    (every,) = resolve_sites("expert.01", twin)
    assert len(every.sites) == twin.streams["expert"].iterations
    with pytest.raises(UnknownSiteError, match="each with directions of its own"):
        _ = every.only_site
    (memory,) = resolve_sites("kv.02", twin)
    with pytest.raises(UnknownSiteError, match="no direction is found; name a place of a residual stream"):
        _ = memory.only_site


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["backbone.9", "backbone.00@1", "expert.01@9-12", "brain.01", "backbone", ""])
def test_places_that_are_none_are_refused(twin: "Policy", pattern: str) -> None:
    with pytest.raises(UnknownSiteError):
        resolve_sites(pattern, twin)


@pytest.mark.slow
def test_roles_that_no_token_plays_are_refused(session: ReplaySession, copy: Run) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    assert token_mask(session.policy, replay_input.clean, "backbone", "image").sum() > 1
    with pytest.raises(EmptyRoleError, match="language"):
        token_mask(session.policy, replay_input.clean, "backbone", "smell")


@pytest.mark.slow
@pytest.mark.parametrize(
    "intervention",
    [
        lambda: Interchange(sites=()),
        lambda: Interchange(controls=2),
        lambda: Steering(sites=("backbone.02",), role="image", coefficients=(0.0,)),
        lambda: Steering(sites=("backbone.02",), role="image", coefficients=(1.0, 1.0)),
        lambda: Steering(sites=("backbone.02",), role="image", target_side="up"),
    ],
)
def test_a_map_of_sites_refuses_impossible_settings(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]


EPISODES = 24
ANSWERS = outcomes_of({"color": follower(EPISODES)})
UNTESTED = "--kind interchange tests where the answer passes"
OPEN = "--kind joint tests where it is read"
UNREAD = "the probes' best site backbone.03 is unread: nothing that acts reads the end of the backbone"
PASSES = {
    **{f"backbone.{layer:02d}|{role}": 1.0 for layer in (0, 1, 2) for role in ("all", "image")},
    **{f"backbone.{layer:02d}|language": 0.0 for layer in range(4)},
    "backbone.03|all": 0.0,
    "backbone.03|image": 0.0,
}
"""Where the answer passes in the embedded policy, in the pictures' tokens of the first layers."""


@pytest.fixture
def run(tmp_path: Path) -> ArrayRun:
    """Of a policy of the embedded family: the answer is planted at the end of its backbone."""
    episodes = pd.DataFrame(
        {
            "episode_id": ANSWERS.episodes, "item_id": ANSWERS.items, "group_id": ANSWERS.groups,
            "category": ANSWERS.categories, "side_correct": ANSWERS.sides, "layout": "original",
            "outcome": "correct", "side_placed": ANSWERS.sides,
        }
    )  # fmt: skip
    draw = np.random.default_rng(0)
    sign = np.where(ANSWERS.sides == "left", 1.0, -1.0)[:, None]
    features = {
        (Site("backbone", layer), "mean"): draw.normal(size=(EPISODES, 4)) + 4 * sign * (layer == 3)
        for layer in range(4)
    }
    return ArrayRun(tmp_path, "pi0-tiny", "suite@1#0123456789ab", episodes, features)


def store(run: ArrayRun, moves: Mapping[str, float], kind: str = "interchange", **settings: Any) -> None:
    """Store an intervention; moves: by condition, the share of episodes that go where the swap brings them."""
    turned = np.arange(EPISODES)
    rows = [
        np.where(turned < share * EPISODES, ANSWERS.of("image_swap"), ANSWERS.of("clean"))
        for share in moves.values()
    ]
    displacement = np.vstack([ANSWERS.displacement, *rows])
    outcomes = replace(
        ANSWERS,
        conditions=(*ANSWERS.conditions, *moves),
        displacement=displacement,
        max_action_change=np.abs(displacement - displacement[0]),
        edit_log=np.ones((*displacement.shape, 5)),
    )
    common = {
        "format": FORMAT, "kind": kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": ["color"], "readout": "first-chunk", "direction": "none",
    }  # fmt: skip
    store_outcomes(run.location, run.suite, {**common, **settings}, outcomes)


def line(run: ArrayRun) -> str:
    """The line below the newest intervention's table."""
    result = load_effects(run)
    text, (parts,) = result.sentences[-1].removeprefix("Which layer, Color: "), result.layers.values()
    assert text == f"{'; '.join(parts)}."
    assert result.findings[-1] == f"Which layer, Color: {parts[0]}."
    return text.removesuffix(".")


def test_after_an_interchange_it_names_where_the_answer_passes_and_where_to_steer(run: ArrayRun) -> None:
    train_probes(run, permutations=50, controls=())
    store(run, PASSES)
    assert line(run).split("; ") == [
        "passes at backbone.01, backbone.02",
        "steer at backbone.02 image with --direction mean-difference:1",
        OPEN,
        UNREAD,
    ]


def test_where_a_block_of_keys_and_values_carries_it_the_block_is_named(run: ArrayRun) -> None:
    store(run, PASSES)
    store(run, {"kv.00|image": 0.0, "kv.01|image": 0.0, "kv.02|image": 1.0}, sites=["kv.*"])
    assert "read at kv.02 image" in line(run).split("; ")
    assert OPEN not in line(run)


@pytest.mark.slow
def test_where_no_layer_carries_it_no_place_to_steer_is_named(run: ArrayRun) -> None:
    train_probes(run, permutations=50, controls=())
    store(run, dict.fromkeys(PASSES, 0.0))
    assert line(run).split("; ") == ["no layer of the backbone carries half of it", OPEN, UNREAD]


def test_without_an_interchange_and_probes_it_names_the_commands_that_are_missing(run: ArrayRun) -> None:
    steered = {"backbone.01|image|mean-difference|2": 0.0}
    store(run, steered, "steer", direction="mean-difference", target_side="wrong", seed=0)
    assert line(run).split("; ") == [UNTESTED, OPEN, "no probes are stored: probe-kit train makes them"]


@pytest.mark.parametrize(
    ("direction", "turned", "is_said"),
    [("mean-difference", 0.0, True), ("mean-difference", 1.0, False), ("mean-difference:1", 0.0, False)],
)
def test_steering_by_one_vector_that_moves_nothing_says_which_direction_may(
    run: ArrayRun, direction: str, turned: float, is_said: bool
) -> None:
    """The embedded policy marks the tokens of one tile: the same vector on all of them changes no action."""
    condition = f"backbone.02|image|{direction}|2"
    store(run, {condition: turned}, "steer", direction=direction, target_side="wrong", seed=0)
    notes = [note for note in load_effects(run).notes if "one vector that is added to every token" in note]
    assert len(notes) == is_said
    assert all("color: " in note and "--direction mean-difference:1" in note for note in notes)


SUITE = "suite@1#0123456789ab"


def with_changes(signs: tuple[np.ndarray, np.ndarray], **changes: np.ndarray) -> ConditionOutcomes:
    """changes: by condition (`__` for `|`, `_` for `-`), metres toward the clean images' correct side."""
    outcomes = outcomes_of({"color": signs})
    names = [name.replace("__", "|").replace("_", "-") for name in changes]
    more = np.stack([outcomes.correct_sign * values for values in changes.values()])
    displacement = np.vstack([outcomes.displacement, more])
    return replace(
        outcomes,
        conditions=(*outcomes.conditions, *names),
        displacement=displacement,
        max_action_change=np.abs(displacement - displacement[0]),
        edit_log=np.tile([1.0, 0.0, 10.0, 5.0, 9.0], (*displacement.shape, 1)),
    )


def rows_of(outcomes: ConditionOutcomes) -> dict[str, PatchEffect]:
    return {f"{row.sites}|{row.role}|{row.direction}".rstrip("|"): row for row in patches_of(outcomes, SUITE)}


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
    rows = rows_of(with_changes((plain, exchanged), **{f"{site}__all": exchanged for site in places}))
    assert all(row.is_localised for row in rows.values())
    assert localised_sites(list(rows.values())) == ("backbone.01", "kv.00")


@pytest.mark.parametrize("target_side", ["wrong", "left", "right", "correct"])
def test_a_steering_is_a_share_of_the_swap_whichever_side_it_pushes_to(target_side: str) -> None:
    plain, exchanged = follower(48)
    outcomes = with_changes((plain, exchanged), a__image__mean_difference__2=exchanged)
    # Every action moves by half of the swap's 0.2 m, toward the side that is pushed to.
    pushed = outcomes.of("clean") + 0.1 * target_sign(outcomes, target_side)
    displacement = np.vstack([outcomes.displacement[:2], pushed])
    (row,) = patches_of(replace(outcomes, displacement=displacement), SUITE, target_side)
    assert row.effect == pytest.approx(0.5)
    assert row.mean_displacement == pytest.approx(0.1)


def test_the_note_about_one_vector_is_of_steering_along_one_and_not_of_its_controls() -> None:
    plain, exchanged = follower(48)
    still = {f"a__image__{name}__2": plain for name in ("mean_difference:1", "control_1")}
    along_tokens = patches_of(with_changes((plain, exchanged), **still), SUITE)
    assert Steering.notes(along_tokens) == []
    in_all = patches_of(with_changes((plain, exchanged), a__image__mean_difference__2=plain), SUITE)
    (note,) = Steering.notes(in_all)
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


def test_controls_are_of_the_same_cell_and_coefficient() -> None:
    plain_cell, along, control = (EditedCell("backbone.02", "image", name) for name in ("", "probe", "control-1"))
    assert control.is_control_of(along)
    assert not control.is_control_of(plain_cell)
    assert not along.is_control_of(along)
    assert not replace(control, coefficient="2").is_control_of(along)
    assert not replace(control, role="language").is_control_of(along)


CELLS = (
    EditedCell(),
    EditedCell("backbone.02", "image"),
    EditedCell("backbone.02", "image", "probe"),
    EditedCell("backbone.02", "image", "control-1", "2"),
    EditedCell("kv.00", "language", part="alone"),
    EditedCell("expert.01@0-1", "all", part="exact"),
)


def test_cells_of_conditions_are_stored_as_columns_and_read_from_the_names_of_an_earlier_version() -> None:
    """The columns decide: a name is read only where there are none."""
    (plain, *_) = np.zeros((1, 4))
    names = ("clean", *map(str, CELLS[1:]))
    numbers = np.zeros((len(names), 4))
    episodes = np.array(list("abcd"))
    outcomes = ConditionOutcomes(
        names, episodes, episodes, episodes, episodes, np.full(4, "left"), numbers, numbers,
        np.zeros((len(names), 4, 5)), plain, **columns_of(CELLS),
    )  # fmt: skip
    assert outcomes.cells == CELLS
    stored = arrays_from_bytes(outcomes.to_bytes())
    assert stored["coefficients"].tolist() == ["", "", "", "2", "", ""]
    assert ConditionOutcomes(**stored).cells == CELLS
    assert outcomes.by_category()[0][1].cells == CELLS
    former = {name: values for name, values in stored.items() if name not in COLUMNS}
    assert ConditionOutcomes(**former).cells == CELLS
    renamed = {**stored, "conditions": np.array(["clean", *(f"{number}|x" for number in range(1, len(names)))])}
    assert ConditionOutcomes(**renamed).cells == CELLS
    assert measured(ConditionOutcomes(**renamed), "").outcomes.cells == CELLS
    file = io.BytesIO()
    np.savez(file, **{name: values for name, values in stored.items() if name != "roles"})
    halved = replace(measured(outcomes, ""), read=lambda _: file.getvalue())
    halved.run.location = "RUN"
    with pytest.raises(RunDamagedError, match="lacks roles"):
        _ = halved.outcomes


def test_the_place_is_said_beside_the_behaviour_and_does_not_change_it() -> None:
    (swap,) = swaps_of(outcomes_of({"color": follower(48)}), SUITE)
    places = {
        None: "",
        (): "no place that was tried carries half of it",
        ("backbone.02",): "passes at backbone.02",
        ("kv.02",): "read at kv.02",
        ("backbone.01", "kv.02", "backbone.02"): "passes at backbone.01, backbone.02; read at kv.02",
    }
    for located, expected in places.items():
        use = classify_use(True, swap, None, Places(located))
        assert (use.behaviour, use.where) == ("used", expected)
    jointly = "no single place: read jointly at kv.01 language + kv.02 language"
    assert str(Places((), jointly=jointly)) == jointly
    assert str(Places(("backbone.01",), jointly=jointly)) == f"passes at backbone.01; {jointly}"
    assert str(Places(("kv.01",), jointly=jointly)) == jointly, "all tokens of a block do not say which are read"
    assert str(Places(("kv.01 image",), jointly="read at kv.01 image")) == "read at kv.01 image"
    assert str(Places(("kv.01",), jointly="past kv")) == "read at kv.01"


def test_a_direction_whose_name_holds_words_of_the_sentence_is_carried_at_its_own_place() -> None:
    carried = (("file:left at start; 1", "backbone.01 image"), ("mean-difference", "kv.01 language"))
    assert Places(("backbone.01",), carried).parts == [
        "passes at backbone.01",
        "carried by file:left at start; 1 at backbone.01 image",
        "mean-difference at kv.01 language",
    ]
