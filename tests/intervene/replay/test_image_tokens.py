"""Tokens by tile: where the renderer says a tile is seen, and which patches of a policy see it."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import EmptyRoleError, UnsupportedInterventionError, UsageError
from probe_kit.hooks.registry import find_family
from probe_kit.intervene import ClosedLoop, ConceptErasure, Interchange, ReplaySource, Steering, run_intervention
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.sessions.session import ReplaySession
from probe_kit.intervene.tokens import TILES, role_token_mask, tokens_overlapping
from probe_kit.runs import Run
from probe_kit.suite import Suite

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


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
        mask = role_token_mask(session.policy, replay_input, "backbone", role, {})
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
        role_token_mask(session.policy, nothing, "backbone", "image.left", {})


def test_both_tiles_are_held_against_the_same_plain_patches(
    session: ReplaySession, copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    act, seen = session.policy.act, []
    monkeypatch.setattr(session.policy, "act", lambda own, seeds: seen.append(own[0].image) or act(own, seeds))
    memo: dict[object, object] = {}
    together = [role_token_mask(session.policy, replay_input, "backbone", role, memo) for role in TILES]
    assert len(seen) == 1 + len(TILES)
    for role, mask in zip(TILES, together, strict=True):
        np.testing.assert_array_equal(mask, role_token_mask(session.policy, replay_input, "backbone", role, {}))


@pytest.mark.slow
def test_tiles_are_exchanged_apart(copy: Run, small_suite: Suite, twin: "Policy") -> None:
    intervention = Interchange(
        categories=("color",), items=1, sites=("backbone.00", "kv.01", "expert.00@0"),
        roles=("image", "image.left", "image.right"),
    )  # fmt: skip
    effects = run_intervention(copy, intervention, ReplaySource(small_suite.folder), load=lambda *_: twin)
    said = effects.certificate["edits"]
    roles = ("image", *TILES)
    assert set(said) == {f"{place}|{role}" for place in ("backbone.00", "kv.01") for role in roles}
    for place, fires in (("backbone.00", 2), ("kv.01", 4)):
        assert all(said[f"{place}|{role}"]["fires"] == fires for role in roles)
        assert said[f"{place}|image.left"]["max_action_change"] > 0
        whole = said[f"{place}|image"]["largest_change"]
        assert all(0 < said[f"{place}|{role}"]["largest_change"] <= whole for role in TILES)


@pytest.mark.parametrize("family", ["xiaomi-r0", "magma", "internvla-m1"])
def test_families_that_cannot_say_are_refused_by_name(family: str) -> None:
    for intervention in (Interchange(roles=("image.left",)), ClosedLoop(targets=("backbone.02|image.right",))):
        assert "tiles" in intervention.required_capabilities
        with pytest.raises(UnsupportedInterventionError, match=f"{family} does not support.*tiles.*`image`"):
            list(map(find_family(family).check_intervention, intervention.required_capabilities))


def test_what_needs_positions_or_means_is_not_asked_of_tiles() -> None:
    with pytest.raises(UsageError, match=r"image\.left is of other patches"):
        ConceptErasure(sites=("backbone.02",), roles=("image.left",))
    with pytest.raises(UsageError, match=r"image\.left has no mean"):
        Steering(sites=("backbone.02",), role="image.left")
    with pytest.raises(UsageError, match="patch them in full"):
        Interchange(roles=("image.right",), direction="mean-difference")
