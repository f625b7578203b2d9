"""Places by name: whole layers, quantities and heads; a head is patched as a plain torch hook patches it."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from probe_kit.errors import (
    EmptyRoleError,
    NoDirectionError,
    UnknownSiteError,
    UnsupportedInterventionError,
    UsageError,
)
from probe_kit.hooks import Observation, Site, capture, load_model
from probe_kit.hooks.capturing.edits import ReplaceWith, TokenSelection, apply_patch, apply_patches
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.registry import find_family
from probe_kit.intervene import (
    ClosedLoop,
    ConceptErasure,
    Interchange,
    JointPlaces,
    ReplayFiles,
    Steering,
    run_intervention,
)
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.places import TILES, PlaceName, list_places, resolve_sites, unread_note, unread_places
from probe_kit.intervene.replay import Condition
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.tokens import PairTokens, token_mask, tokens_overlapping
from probe_kit.runs import Run
from probe_kit.suite import Suite

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


@pytest.mark.parametrize(
    ("pattern", "places", "sites"),
    [
        ("backbone.*", 4, 1),
        ("backbone.2", 1, 1),
        ("expert.03@0-4", 1, 5),
        ("expert.01", 1, 10),
        ("kv.*", 3, 2),
        ("kv.01.values", 1, 1),
        ("backbone.*.mlp", 3, 1),
        ("backbone.02.heads", 1, 1),
        ("backbone.02.heads.*", 8, 1),
        ("backbone.*.heads.*", 24, 1),
        ("expert.*.heads.1@9", 3, 1),
        ("backbone.03.final_norm", 1, 1),
    ],
)
def test_a_pattern_names_places_whose_names_survive_parsing(
    pi0_tiny: Pi0, pattern: str, places: int, sites: int
) -> None:
    site_groups = resolve_sites(pattern, pi0_tiny)
    assert [len(site_group.sites) for site_group in site_groups] == [sites] * places
    assert len({site_group.name for site_group in site_groups}) == places
    for site_group in site_groups:
        assert str(PlaceName.parse(site_group.name)) == site_group.name
        assert resolve_sites(site_group.name, pi0_tiny) == [site_group]


@pytest.mark.parametrize(
    ("pattern", "reason"),
    [
        ("backbone", "names no place; expected STREAM.LAYER"),
        ("nowhere.02", "of the streams backbone, expert, vision, kv"),
        ("backbone.09", r"backbone\.09 is no place; the stream backbone has 4 layers"),
        ("backbone.02@1", r"backbone\.02@1 is no place"),
        ("backbone.02.heads.8", r"backbone\.02\.heads\.8 is no place; a block of backbone has 8 heads, from 0 on"),
        ("backbone.03.heads.0", r"backbone\.03\.heads\.0 is no place"),
        ("backbone.02.mlp.1", "names a head of the quantity mlp; expected heads"),
        ("backbone.02.nonsense", "has no quantity 'nonsense'; it has residual, attention, mlp, final_norm, heads"),
        ("kv.00.heads.0", "the stream kv has no quantity 'heads'"),
    ],
)
def test_an_unknown_site_is_refused_with_the_sites_of_the_model(pi0_tiny: Pi0, pattern: str, reason: str) -> None:
    with pytest.raises(UnknownSiteError, match=reason):
        resolve_sites(pattern, pi0_tiny)


def test_keys_and_values_of_a_model_without_them_are_refused() -> None:
    with pytest.raises(UnknownSiteError, match=r"of the streams backbone, answer, vision"):
        resolve_sites("kv.*", load_model("vlm-tiny"))


@pytest.mark.parametrize("name", ["backbone.*", "kv", "backbone.02.heads.*", "backbone.02|image", ""])
def test_a_pattern_is_not_the_name_of_a_place(name: str) -> None:
    with pytest.raises(UnknownSiteError, match="is not the name of a place"):
        PlaceName.parse(name)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([], ""),
        (["backbone.01", "backbone.02"], "backbone.01, backbone.02"),
        (["backbone.01", "backbone.02", "backbone.03", "kv.02"], "backbone.01 to backbone.03, kv.02"),
        ([f"kv.{block:02d} image" for block in (0, 1, 2, 4)], "kv.00 to kv.02 image, kv.04 image"),
        (["kv.00 image", "kv.01 language", "kv.02 image"], "kv.00 image, kv.01 language, kv.02 image"),
        ([f"backbone.{layer:02d}.heads.3" for layer in (7, 8, 9)], "backbone.07.heads.3 to backbone.09.heads.3"),
    ],
)
def test_consecutive_layers_are_named_by_the_first_and_the_last(names: list[str], expected: str) -> None:
    assert list_places(names) == expected


def test_a_layer_comes_before_its_parts_and_after_shallower_ones() -> None:
    names = ["backbone.01", "backbone.01.heads", "backbone.01.heads.2", "backbone.01.heads.10", "backbone.02"]
    assert [
        str(place_name)
        for place_name in sorted(map(PlaceName.parse, names[::-1]), key=lambda place_name: place_name.depth)
    ] == names
    assert [PlaceName.parse(name).is_whole_layer for name in names] == [True, False, False, False, True]
    assert not PlaceName.parse("expert.03@0-4").is_whole_layer


@pytest.mark.parametrize("pattern", ["backbone.02.heads.1", "backbone.02.mlp", "kv.01.values"])
def test_a_place_without_stored_means_has_no_direction(pi0_tiny: Pi0, pattern: str) -> None:
    (site_group,) = resolve_sites(pattern, pi0_tiny)
    with pytest.raises(UnknownSiteError, match="of which a run stores no means, so that no direction is found"):
        _ = site_group.only_site


def test_a_patch_of_one_head_is_that_of_a_plain_torch_hook_bit_for_bit(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    other = Observation(255 - observation.image, observation.state, observation.instruction)
    (site_group,) = resolve_sites("backbone.01.heads.2", pi0_tiny)
    with capture(pi0_tiny, site_group.sites) as source:
        pi0_tiny.act([other], [5])
    mask = token_mask(pi0_tiny, observation, "backbone", "image")
    image, size = torch.from_numpy(mask), source[site_group.sites[0]].shape[-1] // 8

    def patch(_: object, inputs: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor]:
        passing = inputs[0].clone()
        columns = slice(2 * size, 3 * size)
        passing[:, image, columns] = source[site_group.sites[0]][:, image, columns]
        return (passing,)

    handle = pi0_tiny.tap(Site("backbone", 1, "heads")).module.register_forward_pre_hook(patch)
    expected = pi0_tiny.act([observation], [5])
    handle.remove()
    tokens = TokenSelection.of(mask, "cpu")
    with apply_patch(
        pi0_tiny, site_group.sites, tokens, site_group.limit(ReplaceWith(source, tokens.count))
    ) as log:
        patched = pi0_tiny.act([observation], [5])
    np.testing.assert_array_equal(patched, expected)
    assert (patched != pi0_tiny.act([observation], [5])).any()
    assert log.entries[0].moved > 0


def test_patches_of_all_heads_of_a_block_are_the_patch_of_the_block(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    other = Observation(255 - observation.image, observation.state, observation.instruction)
    (block,) = resolve_sites("backbone.01.heads", pi0_tiny)
    with capture(pi0_tiny, block.sites) as source:
        pi0_tiny.act([other], [5])
    tokens = TokenSelection.of(token_mask(pi0_tiny, observation, "backbone", "image"), "cpu")
    replacement = ReplaceWith(source, tokens.count)
    heads = [
        (tokens, site_group.limit(replacement)) for site_group in resolve_sites("backbone.01.heads.*", pi0_tiny)
    ]
    with apply_patches(pi0_tiny, {block.sites[0]: heads}):
        one_by_one = pi0_tiny.act([observation], [5])
    with apply_patch(pi0_tiny, block.sites, tokens, block.limit(replacement)):
        np.testing.assert_array_equal(pi0_tiny.act([observation], [5]), one_by_one)


def test_kv_of_a_policy_that_declares_none_is_refused_by_name(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    from probe_kit.hooks import Interventions

    monkeypatch.setattr(pi0_tiny, "interventions", Interventions())
    with pytest.raises(UnsupportedInterventionError, match="pi0-tiny does not support the intervention 'kv'"):
        resolve_sites("kv.*", pi0_tiny)


STREAMS = {"backbone": Stream("backbone", 4, 8), "expert": Stream("expert", 4, 8, 10)}
UNREAD = Interventions(unread=("backbone",))


@pytest.mark.parametrize(
    ("names", "places"),
    [
        (["backbone.02", "backbone.03"], ("backbone.03",)),
        (["backbone.03", "backbone.03"], ("backbone.03",)),
        (["backbone.02", "expert.03", "kv.02", "backbone.03.heads.1"], ()),
        (["backbone.03.residual"], ("backbone.03.residual",)),
        (["backbone.03.final_norm"], ("backbone.03.final_norm",)),
    ],
)
def test_the_end_of_an_unread_stream_is_unread_and_nothing_before_it(
    names: list[str], places: tuple[str, ...]
) -> None:
    assert unread_places(names, STREAMS, UNREAD) == places
    assert unread_places(names, STREAMS, Interventions()) == ()
    assert not places or places[0] in unread_note(places)


@pytest.mark.parametrize(
    "intervention",
    [
        Interchange(roles=("image",)),
        Steering(sites=("backbone.*",), role="language", categories=("color",)),
        pytest.param(
            JointPlaces(sites=("backbone.03",), roles=("image", "language"), categories=("color",)),
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda intervention: str(intervention.kind),
)
def test_conditions_name_the_places_that_they_edit(session: ReplaySession, intervention: Intervention) -> None:
    edited = {site_group for condition in intervention.conditions(session) for site_group in condition.places}
    assert "backbone.03" in edited
    assert "backbone.00" not in edited or isinstance(intervention, Interchange)


@dataclass(frozen=True, kw_only=True)
class FirstLayer(Interchange):
    """A kind that patches fewer places than `--sites` names."""

    def conditions(self, session: ReplaySession) -> list[Condition]:
        return [condition for condition in super().conditions(session) if "backbone.03" not in condition.places]


@pytest.mark.parametrize(("kind", "is_noted"), [(Interchange, True), (FirstLayer, False)])
def test_a_note_before_the_replay_names_what_is_really_patched(
    copy: Run, small_suite: Suite, twin: "Policy", kind: type[Interchange], is_noted: bool
) -> None:
    notes: list[str] = []
    places = ("backbone.02", "backbone.03")
    intervention = kind(sites=places, roles=("image",), categories=("color",), items=1, seed=int(is_noted))
    source = ReplayFiles(small_suite.folder)
    result = run_intervention(copy, intervention, source, load=lambda *_: twin, on_note=notes.append)
    assert [note.startswith("unread: backbone.03. ") for note in notes] == [True] * is_noted
    assert any(note.startswith("unread: ") for note in result.notes) == is_noted


def test_a_wildcard_passes_over_places_without_a_direction_and_a_named_place_is_refused(
    session: ReplaySession,
) -> None:
    options = {"role": "language", "categories": ("color",), "controls": 1, "coefficients": (2.0,)}
    session.passed_over.clear()
    conditions = Steering(sites=("backbone.*",), **options).conditions(session)  # type: ignore[arg-type]
    assert list(session.passed_over) == ["backbone.00 language"]
    assert "class means of left and right are equal" in session.passed_over["backbone.00 language"]
    names = {condition.name.partition("|")[0] for condition in conditions[1:]}
    assert "backbone.00" not in names
    assert "backbone.01" in names
    with pytest.raises(NoDirectionError, match=r"backbone\.00"):
        Steering(sites=("backbone.00",), **options).conditions(session)  # type: ignore[arg-type]
    session.passed_over.clear()


@pytest.fixture(scope="module")
def replay_input(session: ReplaySession, copy: Run) -> Pair:
    return session.pairs(str(copy.episodes["item_id"][0]))[0]


def test_pictures_differ_where_tiles_are_and_nowhere_else(replay_input: Pair) -> None:
    """Up to light that tiles throw on nothing: there is none."""
    differs = (replay_input.clean.image != replay_input.source.image).any(axis=-1)
    tiles = replay_input.tiles["left"] | replay_input.tiles["right"]
    assert differs.any()
    assert not (differs & ~tiles).any()
    assert not (replay_input.tiles["left"] & replay_input.tiles["right"]).any()
    columns = {side: np.argwhere(mask)[:, 1].mean() for side, mask in replay_input.tiles.items()}
    assert columns["left"] < columns["right"]


def test_the_patches_of_a_tile_lie_where_its_pixels_do(session: ReplaySession, replay_input: Pair) -> None:
    """Across, the middle of the patches is the middle of the pixels."""
    middles = {}
    for role, side in TILES.items():
        mask = PairTokens(session.policy, replay_input).mask("backbone", role)
        images = np.flatnonzero(session.policy.roles([replay_input.clean])["backbone"][0].mask("image"))
        assert 0 < mask.sum() < images.size / 2
        assert set(np.flatnonzero(mask)) <= set(images)
        grid = mask[images].reshape(6, 6)
        middles[side] = np.argwhere(grid).mean(axis=0)
        high, wide = replay_input.tiles[side].shape
        pixels = np.argwhere(replay_input.tiles[side]).mean(axis=0) / (high, wide)
        # A picture that is wider than high is padded above and below.
        lateral_offset = middles[side][1] + 0.5
        assert abs(lateral_offset - 6 * pixels[1]) < 1
    assert middles["left"][0] < middles["right"][0]


def test_all_pixels_are_seen_by_all_patches_but_the_padding_and_none_by_none(
    session: ReplaySession, replay_input: Pair
) -> None:
    every = np.ones(replay_input.clean.image.shape[:2], bool)
    seeing = tokens_overlapping(session.policy, replay_input.clean, every).reshape(6, 6)
    assert seeing[1:5].all()
    assert not tokens_overlapping(session.policy, replay_input.clean, ~every).any()
    nothing = replace(replay_input, tiles=dict.fromkeys(("left", "right"), ~every))
    with pytest.raises(EmptyRoleError, match="sees the left tile"):
        PairTokens(session.policy, nothing).mask("backbone", "image.left")


@pytest.mark.slow
def test_both_tiles_are_held_against_the_same_plain_patches(
    session: ReplaySession, copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    act, images = session.policy.act, []
    monkeypatch.setattr(
        session.policy,
        "act",
        lambda observations, seeds: images.append(observations[0].image) or act(observations, seeds),
    )
    tokens = PairTokens(session.policy, replay_input)
    together = [tokens.mask("backbone", role) for role in TILES]
    assert len(images) == 1 + len(TILES)
    for role, mask in zip(TILES, together, strict=True):
        np.testing.assert_array_equal(mask, PairTokens(session.policy, replay_input).mask("backbone", role))


@pytest.mark.slow
def test_tiles_are_exchanged_apart(copy: Run, small_suite: Suite, twin: "Policy") -> None:
    intervention = Interchange(
        categories=("color",), items=1, sites=("backbone.00", "kv.01", "expert.00@0"),
        roles=("image", "image.left", "image.right"),
    )  # fmt: skip
    effects = run_intervention(copy, intervention, ReplayFiles(small_suite.folder), load=lambda *_: twin)
    edits = effects.certificate["edits"]
    roles = ("image", *TILES)
    assert set(edits) == {f"{site}|{role}" for site in ("backbone.00", "kv.01") for role in roles}
    for site, fires in (("backbone.00", 2), ("kv.01", 4)):
        assert all(edits[f"{site}|{role}"]["fires"] == fires for role in roles)
        assert edits[f"{site}|image.left"]["max_action_change"] > 0
        image_change = edits[f"{site}|image"]["largest_change"]
        assert all(0 < edits[f"{site}|{role}"]["largest_change"] <= image_change for role in TILES)


@pytest.mark.parametrize("family", ["xiaomi-r0", "magma", "internvla-m1"])
def test_families_that_cannot_say_are_refused_by_name(family: str) -> None:
    for intervention in (Interchange(roles=("image.left",)), ClosedLoop(targets=("backbone.02|image.right",))):
        assert "tiles" in intervention.required_capabilities
        with pytest.raises(UnsupportedInterventionError, match=f"{family} does not support.*tiles.*`image`"):
            list(map(find_family(family).check_intervention, intervention.required_capabilities))


def test_tiles_are_refused_where_positions_or_means_are_needed() -> None:
    with pytest.raises(UsageError, match=r"image\.left is of other patches"):
        ConceptErasure(sites=("backbone.02",), roles=("image.left",))
    with pytest.raises(UsageError, match=r"image\.left has no mean"):
        Steering(sites=("backbone.02",), role="image.left")
    with pytest.raises(UsageError, match="patch them in full"):
        Interchange(roles=("image.right",), direction="mean-difference")
