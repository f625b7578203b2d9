"""Tokens by tile: where the renderer says a tile is seen, and which patches of a policy see it."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import EmptyRoleError, UnsupportedInterventionError, UsageError
from probe_kit.extract import Run
from probe_kit.hooks.registry import find_family
from probe_kit.intervene import ClosedLoop, Erase, Interchange, Source, Steer, intervene_on
from probe_kit.intervene.replay.image_tokens import TILES, role_mask, tokens_seeing
from probe_kit.intervene.replay.session import Bench, Question
from probe_kit.suite import Suite

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


@pytest.fixture(scope="module")
def question(bench: Bench, copy: Run) -> Question:
    return bench.questions(str(copy.episodes["item_id"][0]))[0]


def test_pictures_differ_where_tiles_are_and_nowhere_else(question: Question) -> None:
    """Up to light that tiles throw on nothing: there is none."""
    differs = (question.seen.image != question.exchanged.image).any(axis=-1)
    tiles = question.tiles["left"] | question.tiles["right"]
    assert differs.any()
    assert not (differs & ~tiles).any()
    assert not (question.tiles["left"] & question.tiles["right"]).any()
    columns = {side: np.argwhere(mask)[:, 1].mean() for side, mask in question.tiles.items()}
    assert columns["left"] < columns["right"]


def test_the_patches_of_a_tile_lie_where_its_pixels_do(bench: Bench, question: Question) -> None:
    """Across, the middle of the patches is the middle of the pixels."""
    middles = {}
    for role, side in TILES.items():
        mask = role_mask(bench.policy, question, "backbone", role, {})
        images = np.flatnonzero(bench.policy.roles([question.seen])["backbone"][0].mask("image"))
        assert 0 < mask.sum() < images.size / 2
        assert set(np.flatnonzero(mask)) <= set(images)
        grid = mask[images].reshape(6, 6)
        middles[side] = np.argwhere(grid).mean(axis=0)
        high, wide = question.tiles[side].shape
        pixels = np.argwhere(question.tiles[side]).mean(axis=0) / (high, wide)
        # A picture that is wider than high is padded above and below.
        across = middles[side][1] + 0.5
        assert abs(across - 6 * pixels[1]) < 1
    assert middles["left"][0] < middles["right"][0]


def test_all_pixels_are_seen_by_all_patches_but_the_padding_and_none_by_none(
    bench: Bench, question: Question
) -> None:
    every = np.ones(question.seen.image.shape[:2], bool)
    seeing = tokens_seeing(bench.policy, question.seen, every).reshape(6, 6)
    assert seeing[1:5].all()
    assert not tokens_seeing(bench.policy, question.seen, ~every).any()
    nothing = replace(question, tiles=dict.fromkeys(("left", "right"), ~every))
    with pytest.raises(EmptyRoleError, match="sees the left tile"):
        role_mask(bench.policy, nothing, "backbone", "image.left", {})


def test_both_tiles_are_held_against_the_same_plain_patches(
    bench: Bench, copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    (question, _) = bench.questions(str(copy.episodes["item_id"][0]))
    act, seen = bench.policy.act, []
    monkeypatch.setattr(bench.policy, "act", lambda own, seeds: seen.append(own[0].image) or act(own, seeds))
    memo: dict[object, object] = {}
    together = [role_mask(bench.policy, question, "backbone", role, memo) for role in TILES]
    assert len(seen) == 1 + len(TILES)
    for role, mask in zip(TILES, together, strict=True):
        np.testing.assert_array_equal(mask, role_mask(bench.policy, question, "backbone", role, {}))


def test_tiles_are_exchanged_apart(copy: Run, small_suite: Suite, twin: "Policy") -> None:
    asked = Interchange(
        categories=("color",), items=1, sites=("backbone.00", "memory.01", "expert.00@0"),
        roles=("image", "image.left", "image.right"),
    )  # fmt: skip
    effects = intervene_on(copy, asked, Source(small_suite.folder), load=lambda *_: twin)
    said = effects.certificate["edits"]
    roles = ("image", *TILES)
    assert set(said) == {f"{place}|{role}" for place in ("backbone.00", "memory.01") for role in roles}
    for place, fires in (("backbone.00", 2), ("memory.01", 4)):
        assert all(said[f"{place}|{role}"]["fires"] == fires for role in roles)
        assert said[f"{place}|image.left"]["largest_change"] > 0
        whole = said[f"{place}|image"]["largest"]
        assert all(0 < said[f"{place}|{role}"]["largest"] <= whole for role in TILES)


@pytest.mark.parametrize("family", ["xiaomi-r0", "magma", "internvla-m1"])
def test_families_that_cannot_say_are_refused_by_name(family: str) -> None:
    for asked in (Interchange(roles=("image.left",)), ClosedLoop(cells=("backbone.02|image.right",))):
        assert "tiles" in asked.needs
        with pytest.raises(UnsupportedInterventionError, match=f"{family} does not support.*tiles.*`image`"):
            list(map(find_family(family).check_intervention, asked.needs))


def test_what_needs_positions_or_means_is_not_asked_of_tiles() -> None:
    with pytest.raises(UsageError, match=r"image\.left is of other patches"):
        Erase(sites=("backbone.02",), roles=("image.left",))
    with pytest.raises(UsageError, match=r"image\.left has no mean"):
        Steer(sites=("backbone.02",), role="image.left")
    with pytest.raises(UsageError, match="exchange them whole"):
        Interchange(roles=("image.right",), direction="mean-difference")
