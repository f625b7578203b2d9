"""Changes inside a real network: what is put in, along what, and what the ledger says of it."""

from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import EmptyRoleError, UnknownSiteError, UsageError
from probe_kit.hooks import Site
from probe_kit.hooks.capturing.edits import EditLog, ReplaceInSubspace, ReplaceWith, _ActiveEdits
from probe_kit.intervene import (
    ClosedLoop,
    ConceptErasure,
    Interchange,
    InterventionResult,
    ReplaySource,
    Steering,
    load_effects,
    run_intervention,
    stored_site_effects,
)
from probe_kit.intervene.directions import fit_directions
from probe_kit.intervene.kinds.site_maps import keys_in_use
from probe_kit.intervene.places import resolve_sites
from probe_kit.intervene.sessions.session import ReplaySession
from probe_kit.intervene.tokens import token_mask
from probe_kit.runs import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

LAST = 3


@pytest.fixture(scope="module")
def whole(copy: Run, source: ReplaySource, twin: "Policy") -> InterventionResult:
    intervention = Interchange(
        categories=("color",),
        items=2,
        sites=("backbone.00", "backbone.03", "expert.02@0-1"),
        roles=("all", "language"),
    )
    return run_intervention(copy, intervention, source, load=lambda *_: twin)


def test_all_tokens_of_the_first_layer_are_the_whole_exchange(whole: InterventionResult) -> None:
    outcomes = whole.outcomes
    np.testing.assert_allclose(outcomes.of("backbone.00|all"), outcomes.of("image_swap"), atol=1e-6)


def test_a_site_that_nothing_reads_leaves_every_action_bit_for_bit(whole: InterventionResult) -> None:
    """The ledger tells it from hooks that missed: they fired, and moved what passed."""
    (row,) = (row for row in whole.effects if (row.place, row.role) == ("backbone.03", "all"))
    assert row.max_action_change == 0.0
    assert (row.fires, row.no_op_fires) == (4, 0)
    assert row.relative_change > 0
    assert row.p_fwe == 1.0


def test_words_are_the_same_before_and_after_the_exchange(whole: InterventionResult) -> None:
    """In the embeddings only pictures differ, so that taking the words over moves nothing."""
    said = whole.certificate["edits"]["backbone.00|language"]
    assert (said["fires"], said["no_op_fires"], said["max_action_change"]) == (4.0, 4.0, 0.0)


def test_an_expert_is_changed_at_every_iteration_that_is_named(whole: InterventionResult) -> None:
    said = whole.certificate["edits"]["expert.02@0-1|all"]
    assert said["fires"] == 2 * 4
    assert "expert.02@0-1|language" not in whole.certificate["edits"]


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
    copy: Run, source: ReplaySource, twin: "Policy", sites: tuple[str, ...], roles: tuple[str, ...], role: str
) -> None:
    before = keys_in_use(copy)
    for intervention in (
        Interchange(categories=("color",), items=1, sites=sites, roles=roles),
        ConceptErasure(categories=("color",), items=1, sites=sites[:1], roles=roles),
        ClosedLoop(categories=("color",), items=1, targets=(f"{sites[0]}|{role}",), direction="none", controls=0),
    ):
        with pytest.raises(UsageError, match=f"has the role '{role}'; expected one of all, "):
            run_intervention(copy, intervention, source, load=lambda *_: twin)
    assert keys_in_use(copy) == before


def test_it_is_read_back_beside_what_else_is_stored(copy: Run, whole: InterventionResult) -> None:
    assert load_effects(copy, kind="interchange").to_csv() == whole.to_csv()
    assert {row.place for row in stored_site_effects(copy)["color"]} == {
        "backbone.00",
        "backbone.03",
        "expert.02@0-1",
    }


def test_an_interchange_along_a_direction_takes_no_maps_place(
    copy: Run, source: ReplaySource, twin: "Policy", whole: InterventionResult
) -> None:
    intervention = Interchange(
        categories=("color",), items=1, sites=("backbone.02",), roles=("image",), direction="mean-difference"
    )
    assert run_intervention(copy, intervention, source, load=lambda *_: twin).key != whole.key
    assert {row.key for row in stored_site_effects(copy)["color"]} == {whole.key}


def test_steering_by_nothing_changes_nothing_and_controls_move_as_far(
    copy: Run, source: ReplaySource, twin: "Policy"
) -> None:
    intervention = Steering(
        categories=("color",), items=2, sites=("backbone.02",), role="image", coefficients=(2.0,), controls=1
    )
    effects = run_intervention(copy, intervention, source, load=lambda *_: twin)
    edits = effects.certificate["edits"]
    assert edits["backbone.02|image|mean-difference|0"]["max_action_change"] == 0.0
    own, control = (edits[f"backbone.02|image|{name}|2"] for name in ("mean-difference", "control-1"))
    assert own["change"] > 0
    assert control["change"] == pytest.approx(own["change"], rel=1e-4)
    assert own["largest_change"] == pytest.approx(own["change"], rel=0.5)
    assert {row.coefficient for row in effects.effects} == {"0", "2"}
    assert "image_swap" in effects.outcomes.conditions, "the effect is a share of the swap"


# -- along what ----------------------------------------------------------------------------------------------


def test_the_mean_difference_is_found_without_the_episode_it_is_used_on(copy: Run) -> None:
    """Where it lies is planted; a probe's weights and controls are of length 1 as well."""
    axes = fit_directions(copy, Site("backbone", 2), "image", "mean-difference", 3, seed=0)
    episodes = copy.episodes
    assert set(axes.fold_of) == set(episodes["episode_id"])
    name, category = str(episodes["episode_id"][0]), str(episodes["category"][0])
    features = copy.column(Site("backbone", 2), "mean:image").astype(float)
    fold = axes.fold_of[name]
    own = (episodes["category"] == category).to_numpy()
    others = own & np.array([axes.fold_of[str(one)] != fold for one in episodes["episode_id"]])
    left = (episodes["side_correct"] == "left").to_numpy()
    expected = features[others & left].mean(axis=0) - features[others & ~left].mean(axis=0)
    unit = axes.of("mean-difference", name, category)
    np.testing.assert_allclose(unit, expected / np.linalg.norm(expected), atol=1e-5)
    assert axes.half_difference(name, category) == pytest.approx(np.linalg.norm(expected) / 2, rel=1e-5)
    groups = dict(zip(episodes["episode_id"].astype(str), episodes["group_id"].astype(str), strict=True))
    assert not {groups[one] for one, of in axes.fold_of.items() if of == fold and one.startswith(category)} & {
        str(group) for group in episodes["group_id"][others]
    }
    for control in axes.control_names:
        vector = axes.of(control, name, category)
        assert np.linalg.norm(vector) == pytest.approx(1.0, rel=1e-5)
        assert abs(float(vector @ unit)) < 1e-5


def test_a_direction_that_does_not_exist_is_refused(copy: Run) -> None:
    with pytest.raises(UsageError, match="expected one of mean-difference, probe"):
        fit_directions(copy, Site("backbone", 2), "image", "mean-difference:1", 0, seed=0)


@pytest.mark.parametrize("direction", ["mean-difference", "probe"])
@pytest.mark.parametrize("role", ["all", "image", "language"])
def test_the_networks_input_has_no_direction(copy: Run, direction: str, role: str) -> None:
    """The suite asks of every picture both ways; the first layer combines it with the words."""
    with pytest.raises(UsageError, match=f"color, .*00.*, role {role}: no direction for {direction}"):
        fit_directions(copy, Site("backbone", 0), role, direction, 1, seed=0)


def test_the_probes_direction_is_another_one(copy: Run) -> None:
    episode, category = str(copy.episodes["episode_id"][0]), str(copy.episodes["category"][0])
    mean, probe = (
        fit_directions(copy, Site("backbone", 2), "image", name, 0, seed=0).of(name, episode, category)
        for name in ("mean-difference", "probe")
    )
    assert 0 < float(mean @ probe) < 0.999


def test_along_every_direction_is_the_whole_and_along_none_is_nothing() -> None:
    import torch

    draw = np.random.default_rng(0)
    own, other = (torch.from_numpy(draw.normal(size=(5, 4)).astype(np.float32)) for _ in range(2))
    site, mask = Site("backbone", 0), np.array([True, False, True, True, True])
    basis = np.linalg.qr(draw.normal(size=(4, 4)))[0].astype(np.float32)
    source = {site: other[None]}
    where = torch.from_numpy(np.flatnonzero(mask))
    taken = own[None, where]
    whole = ReplaceWith(source, 5)(site, taken, where)  # type: ignore[arg-type]
    np.testing.assert_array_equal(whole[0].numpy(), other.numpy()[mask])
    along = ReplaceInSubspace(source, 5, basis)(site, taken, where)  # type: ignore[arg-type]
    np.testing.assert_allclose(along.numpy(), whole.numpy(), atol=1e-5)
    rank_one = ReplaceInSubspace(source, 5, basis[:1])(site, taken, where)  # type: ignore[arg-type]
    np.testing.assert_allclose(rank_one.numpy() @ basis[0], whole.numpy() @ basis[0], atol=1e-5)
    np.testing.assert_allclose(rank_one.numpy() @ basis[1], taken.numpy() @ basis[1], atol=1e-5)


def test_what_fires_moved_is_summed_whatever_their_shapes() -> None:
    """Two fires of one shape, one of another; the second moves nothing. By hand."""
    import torch

    active, sites = _ActiveEdits(), (Site("backbone", 0), Site("backbone", 1), Site("expert", 0))
    one, other = torch.tensor([[3.0, 4.0], [0.0, 1.0]]), torch.tensor([[2.0, 0.0, 0.0]])
    tokens = (one, one + torch.tensor([[0.0, 2.0], [0.0, 4.0]])), (other, -other), (one, one)
    active.fired += [
        (site, before[None], after[None]) for site, (before, after) in zip(sites, tokens, strict=True)
    ]
    edit_log = EditLog(active.measured())
    assert [entry.site for entry in edit_log.entries] == [str(site) for site in sites]
    assert edit_log.row().tolist() == [3, 1, (3 + 2 + 3) / 3, (3 + 4 + 0) / 3, 4]
    assert EditLog.sum([edit_log, edit_log]).row().tolist() == [6, 2, 8 / 3, 7 / 3, 4]
    assert EditLog(_ActiveEdits().measured()) == EditLog()


# -- where ---------------------------------------------------------------------------------------------------


def test_places_are_layers_or_layers_over_iterations(twin: "Policy") -> None:
    assert [place.name for place in resolve_sites("backbone.*", twin)] == [
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


@pytest.mark.parametrize("pattern", ["backbone.9", "backbone.00@1", "expert.01@9-12", "brain.01", "backbone", ""])
def test_places_that_are_none_are_refused(twin: "Policy", pattern: str) -> None:
    with pytest.raises(UnknownSiteError):
        resolve_sites(pattern, twin)


def test_roles_that_no_token_plays_are_refused(session: ReplaySession, copy: Run) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    assert token_mask(session.policy, replay_input.clean, "backbone", "image").sum() > 1
    with pytest.raises(EmptyRoleError, match="language"):
        token_mask(session.policy, replay_input.clean, "backbone", "smell")


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
def test_what_cannot_be_asked_is_refused(intervention: object) -> None:
    with pytest.raises(UsageError):
        intervention()  # type: ignore[operator]
