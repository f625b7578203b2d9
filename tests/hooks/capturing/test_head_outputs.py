"""Heads are split as plain torch splits them: columns of the output projection times what a head read."""

import pytest
import torch

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks import Observation, Site, capture, edit, project_heads
from probe_kit.hooks.families.pi0.adapter import Pi0


@pytest.mark.parametrize(("stream", "iteration"), [("backbone", None), ("expert", 6), ("vision", 0)])
def test_every_head_adds_its_columns_of_the_projection_and_all_make_the_attention(
    pi0_tiny: Pi0, observation: Observation, stream: str, iteration: int | None
) -> None:
    site = Site(stream, 1, "heads", iteration)
    attention = Site(stream, 1, "attention", iteration)
    with capture(pi0_tiny, [site, attention]) as tape:
        pi0_tiny.act([observation], [0])
    projection, heads = pi0_tiny.tap(site).module, pi0_tiny.every_stream()[stream].heads
    added = project_heads(pi0_tiny, tape, site)
    assert added.shape == (heads, *tape[attention].shape)
    weight, bias = projection.weight.detach(), projection.bias
    size = weight.shape[1] // heads
    for head in range(heads):
        own = slice(head * size, (head + 1) * size)
        torch.testing.assert_close(added[head], tape[site][..., own] @ weight[:, own].T, rtol=1e-4, atol=1e-5)
    whole = added.sum(dim=0) + (0 if bias is None else bias.detach())
    torch.testing.assert_close(whole, tape[attention], rtol=1e-4, atol=1e-5)


def test_a_site_by_name_is_the_same_and_another_quantity_is_refused(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    with capture(pi0_tiny, [Site("backbone", 1, "heads"), Site("backbone", 1)]) as tape:
        pi0_tiny.act([observation], [0])
    by_name = project_heads(pi0_tiny, tape, "backbone.01.heads")
    assert torch.equal(by_name, project_heads(pi0_tiny, tape, Site("backbone", 1, "heads")))
    with pytest.raises(UnknownSiteError, match=r"not of heads; expected backbone\.01\.heads"):
        project_heads(pi0_tiny, tape, Site("backbone", 1))
    with pytest.raises(UnknownSiteError, match="was not captured"):
        project_heads(pi0_tiny, tape, Site("backbone", 2, "heads"))


def test_an_edit_of_heads_writes_what_a_plain_torch_hook_writes(pi0_tiny: Pi0, observation: Observation) -> None:
    site = Site("backbone", 1, "heads")
    module = pi0_tiny.tap(site).module

    def silence(passing: torch.Tensor) -> torch.Tensor:
        passing[..., :16] = 0
        return passing

    handle = module.register_forward_pre_hook(lambda _, inputs: (silence(inputs[0].clone()),))
    expected = pi0_tiny.act([observation], [0])
    handle.remove()
    with edit(pi0_tiny, {site: silence}):
        edited = pi0_tiny.act([observation], [0])
    assert (edited == expected).all()
    assert (edited != pi0_tiny.act([observation], [0])).any()


def test_heads_of_a_stream_that_has_none_are_refused_with_what_there_is(pi0_tiny: Pi0) -> None:
    assert pi0_tiny.prompt_kv is not None
    with pytest.raises(UnknownSiteError, match="the stream kv has no quantity 'heads'; it has keys, values"):
        pi0_tiny.prompt_kv.sites("heads")
    with pytest.raises(
        UnknownSiteError, match=r"backbone: 4 layers of residual, attention, mlp, final_norm, heads"
    ):
        pi0_tiny.tap(Site("backbone", 9, "heads"))
