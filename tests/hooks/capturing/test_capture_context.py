import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from probe_kit.errors import CaptureError, NonFiniteActivationError, SiteFiredTooOftenError, SiteNeverFiredError
from probe_kit.hooks import Observation, Site, capture, edit
from probe_kit.hooks.families.pi0.adapter import Pi0


def hooks_on(policy: Pi0) -> int:
    return sum(len(module._forward_pre_hooks) + len(module._forward_hooks) for module in policy.network.modules())


def test_capturing_changes_no_action_bit_for_bit(pi0_tiny: Pi0, observation: Observation) -> None:
    plain = pi0_tiny.act([observation], [7])
    with capture(pi0_tiny, pi0_tiny.sites()):
        captured = pi0_tiny.act([observation], [7])
    np.testing.assert_array_equal(plain, captured)


def test_only_the_asked_sites_are_kept_with_the_shape_of_their_stream(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    sites = [Site("backbone", 3), Site("expert", 0, iteration=9)]
    with capture(pi0_tiny, sites) as tape:
        pi0_tiny.act([observation, observation], [0, 1])
    assert len(tape) == 2
    assert tape[sites[0]].shape == (2, 52, 96)
    assert tape[sites[1]].shape == (2, 17, 64)


def test_iterations_of_one_layer_are_different_activations(pi0_tiny: Pi0, observation: Observation) -> None:
    first, last = Site("expert", 2, iteration=0), Site("expert", 2, iteration=9)
    with capture(pi0_tiny, [first, last]) as tape:
        pi0_tiny.act([observation], [0])
    assert (tape[first] - tape[last]).abs().max() > 0.01


def test_copies_do_not_alias_what_the_model_works_on(pi0_tiny: Pi0, observation: Observation) -> None:
    """An in-place change behind the hook must not reach the tape."""
    site = Site("backbone", 1)
    norm = pi0_tiny.tap(site).module
    seen: list[torch.Tensor] = []

    def vandalise(_module: object, inputs: tuple[torch.Tensor, ...]) -> None:
        seen.append(inputs[0].clone())
        inputs[0].zero_()

    with capture(pi0_tiny, [site]) as tape:
        handle = norm.register_forward_pre_hook(vandalise)
        pi0_tiny.act([observation], [0])
    handle.remove()
    assert torch.equal(tape[site], seen[0])


def test_hooks_are_gone_after_the_context_and_after_an_exception(pi0_tiny: Pi0, observation: Observation) -> None:
    with capture(pi0_tiny, pi0_tiny.sites()):
        assert hooks_on(pi0_tiny) == 8
        pi0_tiny.act([observation], [0])
    assert hooks_on(pi0_tiny) == 0
    with pytest.raises(KeyError, match="mine"), capture(pi0_tiny, pi0_tiny.sites()):
        raise KeyError("mine")
    assert hooks_on(pi0_tiny) == 0


def test_a_capture_inside_a_capture_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    with capture(pi0_tiny, [Site("backbone", 0)]):
        with pytest.raises(CaptureError, match="already"), capture(pi0_tiny, [Site("backbone", 1)]):
            pass
        pi0_tiny.act([observation], [0])


def test_a_site_that_never_fires_is_named(pi0_tiny: Pi0) -> None:
    expected = r"backbone\.03\.residual fired 0 times.*expected 1"
    with pytest.raises(SiteNeverFiredError, match=expected), capture(pi0_tiny, [Site("backbone", 3)]):
        pass


def test_acting_twice_in_one_capture_is_an_error(pi0_tiny: Pi0, observation: Observation) -> None:
    def act_twice() -> None:
        with capture(pi0_tiny, [Site("expert", 0, iteration=3)]):
            pi0_tiny.act([observation], [0])
            pi0_tiny.act([observation], [0])

    with pytest.raises(SiteFiredTooOftenError, match=r"fired 20 times.*expected 10"):
        act_twice()


def test_nan_in_an_activation_is_an_error_that_names_the_site(pi0_tiny: Pi0, observation: Observation) -> None:
    broken = replace(observation, state=np.full(8, np.nan, np.float32))
    site = Site("expert", 0, iteration=0)
    with pytest.raises(NonFiniteActivationError, match=re.escape(str(site))), capture(pi0_tiny, [site]):
        pi0_tiny.act([broken], [0])


def test_a_compiled_module_is_refused_with_the_remedy(pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch) -> None:
    tap = pi0_tiny.tap(Site("backbone", 0))
    compiled = replace(tap, module=torch.compile(tap.module))
    monkeypatch.setattr(pi0_tiny, "tap", lambda _site: compiled)
    with pytest.raises(CaptureError, match="uncompiled"), capture(pi0_tiny, [Site("backbone", 0)]):
        pass


def test_attention_and_mlp_are_what_a_block_adds_to_the_residual(pi0_tiny: Pi0, observation: Observation) -> None:
    quantities = ("residual", "attention", "mlp")
    with capture(pi0_tiny, [site for quantity in quantities for site in pi0_tiny.sites(quantity)]) as tape:
        pi0_tiny.act([observation], [0])
    for stream, iteration in (("backbone", None), ("expert", 6)):
        for layer in range(3):
            added = [tape[Site(stream, layer, quantity, iteration)] for quantity in ("attention", "mlp")]
            expected = tape[Site(stream, layer, "residual", iteration)] + added[0] + added[1]
            after = tape[Site(stream, layer + 1, "residual", iteration)]
            torch.testing.assert_close(after, expected, atol=1e-5, rtol=1e-5)


def test_a_reduction_runs_at_the_moment_of_firing_and_replaces_the_copy(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    sites = [Site("backbone", 2), Site("expert", 1, iteration=3)]
    with capture(pi0_tiny, sites) as whole:
        pi0_tiny.act([observation], [0])
    with capture(pi0_tiny, sites, reduce=lambda _site, activation: activation.mean(1)) as reduced:
        pi0_tiny.act([observation], [0])
    for site in sites:
        assert torch.equal(reduced[site], whole[site].mean(1))


def test_an_edit_of_one_iteration_leaves_the_others_before_it_alone(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    site, before = Site("expert", 2, iteration=5), Site("expert", 2, iteration=4)
    with capture(pi0_tiny, [before]) as plain:
        untouched = pi0_tiny.act([observation], [0])
    with edit(pi0_tiny, {site: torch.zeros_like}), capture(pi0_tiny, [before, site]) as edited:
        changed = pi0_tiny.act([observation], [0])
    assert torch.equal(plain[before], edited[before])
    assert (edited[site] == 0).all()
    assert np.abs(changed - untouched).max() > 0


def test_an_edit_of_another_shape_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    with (
        pytest.raises(CaptureError, match=r"backbone\.01\.residual"),
        edit(pi0_tiny, {Site("backbone", 1): lambda activation: activation[:, :1]}),
    ):
        pi0_tiny.act([observation], [0])


def test_a_module_that_may_be_called_more_often_is_captured_at_its_first_calls(
    pi0_tiny: Pi0, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the model itself decides how many tokens it puts out; fewer calls than are captured stay an error."""
    sites, whole = pi0_tiny.streams["expert"].sites()[:1], pi0_tiny.tap(Site("expert", 0, iteration=0))
    with capture(pi0_tiny, sites) as plain:
        pi0_tiny.act([observation], [0])
    monkeypatch.setattr(pi0_tiny, "tap", lambda _: replace(whole, fires=3, more=True))
    with capture(pi0_tiny, sites) as cache:
        pi0_tiny.act([observation], [0])
    assert torch.equal(cache[sites[0]], plain[sites[0]])
    assert cache.fires == {"expert.00.residual": 3}
    monkeypatch.setattr(pi0_tiny, "tap", lambda _: replace(whole, fires=11, more=True))
    with pytest.raises(SiteNeverFiredError, match="expected at least 11"), capture(pi0_tiny, sites):
        pi0_tiny.act([observation], [0])
