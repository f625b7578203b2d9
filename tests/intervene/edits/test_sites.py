"""Places by name: whole layers, quantities and heads; a head is patched as a plain torch hook patches it."""

import numpy as np
import pytest
import torch

from probe_kit.errors import UnknownSiteError, UnsupportedInterventionError
from probe_kit.hooks import Observation, Site, capture, load_model
from probe_kit.hooks.capturing.edits import ReplaceWith, TokenSelection, apply_patch, apply_patches
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.intervene.places import PlaceName, list_places, resolve_sites
from probe_kit.intervene.tokens import token_mask


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
    found = resolve_sites(pattern, pi0_tiny)
    assert [len(place.sites) for place in found] == [sites] * places
    assert len({place.name for place in found}) == places
    for place in found:
        assert str(PlaceName.parse(place.name)) == place.name
        assert resolve_sites(place.name, pi0_tiny) == [place]


@pytest.mark.parametrize(
    ("pattern", "said"),
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
def test_what_is_no_place_is_refused_with_what_there_is(pi0_tiny: Pi0, pattern: str, said: str) -> None:
    with pytest.raises(UnknownSiteError, match=said):
        resolve_sites(pattern, pi0_tiny)


def test_keys_and_values_of_a_model_without_them_are_refused() -> None:
    with pytest.raises(UnknownSiteError, match=r"of the streams backbone, answer, vision"):
        resolve_sites("kv.*", load_model("vlm-tiny"))


@pytest.mark.parametrize("name", ["backbone.*", "kv", "backbone.02.heads.*", "backbone.02|image", ""])
def test_a_pattern_is_not_the_name_of_a_place(name: str) -> None:
    with pytest.raises(UnknownSiteError, match="is not the name of a place"):
        PlaceName.parse(name)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([], ""),
        (["backbone.01", "backbone.02"], "backbone.01, backbone.02"),
        (["backbone.01", "backbone.02", "backbone.03", "kv.02"], "backbone.01 to backbone.03, kv.02"),
        ([f"kv.{block:02d} image" for block in (0, 1, 2, 4)], "kv.00 to kv.02 image, kv.04 image"),
        (["kv.00 image", "kv.01 language", "kv.02 image"], "kv.00 image, kv.01 language, kv.02 image"),
        ([f"backbone.{layer:02d}.heads.3" for layer in (7, 8, 9)], "backbone.07.heads.3 to backbone.09.heads.3"),
    ],
)
def test_consecutive_layers_are_named_by_the_first_and_the_last(names: list[str], said: str) -> None:
    assert list_places(names) == said


def test_a_layer_comes_before_its_parts_and_after_shallower_ones() -> None:
    names = ["backbone.01", "backbone.01.heads", "backbone.01.heads.2", "backbone.01.heads.10", "backbone.02"]
    assert [str(one) for one in sorted(map(PlaceName.parse, names[::-1]), key=lambda one: one.depth)] == names
    assert [PlaceName.parse(name).is_whole_layer for name in names] == [True, False, False, False, True]
    assert not PlaceName.parse("expert.03@0-4").is_whole_layer


@pytest.mark.parametrize("pattern", ["backbone.02.heads.1", "backbone.02.mlp", "kv.01.values"])
def test_a_place_without_stored_means_has_no_direction(pi0_tiny: Pi0, pattern: str) -> None:
    (place,) = resolve_sites(pattern, pi0_tiny)
    with pytest.raises(UnknownSiteError, match="of which a run stores no means, so that no direction is found"):
        _ = place.only_site


def test_a_patch_of_one_head_is_that_of_a_plain_torch_hook_bit_for_bit(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    other = Observation(255 - observation.image, observation.state, observation.instruction)
    (place,) = resolve_sites("backbone.01.heads.2", pi0_tiny)
    with capture(pi0_tiny, place.sites) as source:
        pi0_tiny.act([other], [5])
    mask = token_mask(pi0_tiny, observation, "backbone", "image")
    image, size = torch.from_numpy(mask), source[place.sites[0]].shape[-1] // 8

    def patch(_: object, inputs: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor]:
        passing = inputs[0].clone()
        columns = slice(2 * size, 3 * size)
        passing[:, image, columns] = source[place.sites[0]][:, image, columns]
        return (passing,)

    handle = pi0_tiny.tap(Site("backbone", 1, "heads")).module.register_forward_pre_hook(patch)
    expected = pi0_tiny.act([observation], [5])
    handle.remove()
    tokens = TokenSelection.of(mask, "cpu")
    with apply_patch(pi0_tiny, place.sites, tokens, place.limit(ReplaceWith(source, tokens.count))) as log:
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
    whole = ReplaceWith(source, tokens.count)
    heads = [(tokens, place.limit(whole)) for place in resolve_sites("backbone.01.heads.*", pi0_tiny)]
    with apply_patches(pi0_tiny, {block.sites[0]: heads}):
        one_by_one = pi0_tiny.act([observation], [5])
    with apply_patch(pi0_tiny, block.sites, tokens, block.limit(whole)):
        np.testing.assert_array_equal(pi0_tiny.act([observation], [5]), one_by_one)


def test_kv_of_a_policy_that_declares_none_is_refused_by_name(
    pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    from probe_kit.hooks import Interventions

    monkeypatch.setattr(pi0_tiny, "interventions", Interventions())
    with pytest.raises(UnsupportedInterventionError, match="pi0-tiny does not support the intervention 'kv'"):
        resolve_sites("kv.*", pi0_tiny)
