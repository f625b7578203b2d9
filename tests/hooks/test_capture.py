""""""

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from probe_kit.errors import (
    CaptureError,
    NonFiniteActivationError,
    SiteFiredTooOftenError,
    SiteNeverFiredError,
    UnknownSiteError,
    UsageError,
)
from probe_kit.hooks import ActivationCache, Observation, Site, capture, edit, load_policy
from probe_kit.hooks.capturing.capture_context import Reduce, compiled_parts
from probe_kit.hooks.capturing.edits import Edit, apply_edits, vector_hash
from probe_kit.hooks.families.pi0.adapter import Pi0


@pytest.fixture(scope="module")
def activations(pi0_tiny: Pi0) -> ActivationCache:
    import numpy as np

    observation = Observation(
        np.zeros((48, 64, 3), np.uint8), np.zeros(8, np.float32), "Put the cube on the red shape"
    )
    with capture(pi0_tiny, pi0_tiny.sites()) as activations:
        pi0_tiny.act([observation, observation], [0, 1])
    return activations


def test_a_cache_is_a_mapping_from_sites(activations: ActivationCache, pi0_tiny: Pi0) -> None:
    assert set(activations) == set(activations.keys()) == set(pi0_tiny.sites())
    assert len(list(activations)) == len(activations) == 44
    assert all(torch.equal(activations[site], tensor) for site, tensor in activations.items())
    assert {activations: 1}[activations] == 1  # compared by identity, as tensors are


def test_the_name_of_a_site_does_as_well_as_the_site(activations: ActivationCache) -> None:
    assert torch.equal(activations["expert.02.residual@3"], activations[Site("expert", 2, iteration=3)])
    assert "backbone.03.residual" in activations
    assert "backbone.09.residual" not in activations
    assert "nonsense" not in activations
    assert activations.get("backbone.09.residual") is None


def test_a_site_that_was_not_captured_is_named_with_what_was(activations: ActivationCache) -> None:
    with pytest.raises(
        UnknownSiteError, match=r"backbone\.09\.residual was not captured; .*expert.residual: 4 layers x 10"
    ):
        activations["backbone.09.residual"]
    with pytest.raises(UnknownSiteError, match="nothing yet"):
        ActivationCache()["backbone.00.residual"]


def test_layers_and_iterations_stack_into_one_tensor(activations: ActivationCache) -> None:
    assert activations.stack("backbone").shape == (4, 2, 52, 96)
    expert = activations.stack("expert")
    assert expert.shape == (4, 10, 2, 17, 64)
    assert torch.equal(expert[2, 7], activations["expert.02.residual@7"])
    with pytest.raises(UnknownSiteError, match="mlp was captured"):
        activations.stack("expert", "mlp")


def test_activations_of_unequal_shapes_are_not_stacked(pi0_tiny: Pi0, observation: Observation) -> None:
    with capture(pi0_tiny, [Site("expert", 0, iteration=0), *pi0_tiny.streams["expert"].sites()[1:]]) as tape:
        pi0_tiny.act([observation], [0])
    del tape._kept[Site("expert", 1, iteration=4)]
    with pytest.raises(UnknownSiteError, match=r"layers \[1\] of expert lack iterations"):
        tape.stack("expert")


def test_it_says_what_it_holds(activations: ActivationCache) -> None:
    assert (
        repr(activations)
        == "<ActivationCache of 44 sites: backbone.residual: 4 layers; expert.residual: 4 layers x 10 iterations>"
    )
    assert "2 × 17 × 64" in activations._repr_html_()
    assert repr(ActivationCache()) == "<ActivationCache of 0 sites>"


def hooks_on(policy: Pi0) -> int:
    return sum(len(module._forward_pre_hooks) + len(module._forward_hooks) for module in policy.network.modules())


def test_only_the_asked_sites_are_kept_with_the_shape_of_their_stream(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    sites = [Site("backbone", 3), Site("expert", 0, iteration=9)]
    with capture(pi0_tiny, sites) as activations:
        pi0_tiny.act([observation, observation], [0, 1])
    assert len(activations) == 2
    assert activations[sites[0]].shape == (2, 52, 96)
    assert activations[sites[1]].shape == (2, 17, 64)


def test_iterations_of_one_layer_are_different_activations(pi0_tiny: Pi0, observation: Observation) -> None:
    first, last = Site("expert", 2, iteration=0), Site("expert", 2, iteration=9)
    with capture(pi0_tiny, [first, last]) as activations:
        pi0_tiny.act([observation], [0])
    assert (activations[first] - activations[last]).abs().max() > 0.01


def test_copies_do_not_alias_what_the_model_works_on(pi0_tiny: Pi0, observation: Observation) -> None:
    """An in-place change behind the hook must not reach the cache."""
    site = Site("backbone", 1)
    norm = pi0_tiny.tap(site).module
    cloned_inputs: list[torch.Tensor] = []

    def vandalise(_module: object, inputs: tuple[torch.Tensor, ...]) -> None:
        cloned_inputs.append(inputs[0].clone())
        inputs[0].zero_()

    with capture(pi0_tiny, [site]) as activations:
        handle = norm.register_forward_pre_hook(vandalise)
        pi0_tiny.act([observation], [0])
    handle.remove()
    assert torch.equal(activations[site], cloned_inputs[0])


@pytest.mark.parametrize("most_bytes", [None, 1, 100_000])
def test_a_network_that_writes_its_stream_in_place_is_captured_as_it_passed(
    pi0_tiny: Pi0, observation: Observation, most_bytes: int | None
) -> None:
    """The blocks' inputs change behind the hooks, at every inference; the last one is the output of all."""
    sites = pi0_tiny.sites()
    layers = pi0_tiny.tap(Site("backbone", 1)).module, pi0_tiny.tap(Site("expert", 2, iteration=0)).module
    entered: list[torch.Tensor] = []

    def write(_module: object, inputs: tuple[torch.Tensor, ...], _output: object) -> None:
        entered.append(inputs[0])

    def write_later(_module: object, _inputs: object, _output: object) -> None:
        for tensor in entered:
            tensor.add_(1)
        entered.clear()

    parts = [pi0_tiny.tap(Site("backbone", 1, "mlp")), pi0_tiny.tap(Site("expert", 2, "mlp", 0))]
    handles = [module.register_forward_hook(write) for module in layers]
    handles += [tap.module.register_forward_hook(write_later) for tap in parts]
    try:
        with capture(pi0_tiny, sites, reduce=lambda _, activation: activation.clone()) as fired:
            pi0_tiny.act([observation, observation], [0, 1])
        for _ in range(2):
            with capture(pi0_tiny, sites, most_bytes=most_bytes) as tape:
                pi0_tiny.act([observation, observation], [0, 1])
            assert [site for site in sites if not torch.equal(tape[site], fired[site])] == []
    finally:
        for handle in handles:
            handle.remove()
    if most_bytes is None:
        assert not torch.equal(fired["backbone.01.residual"] + 1, fired["backbone.02.residual"])


def test_captured_activations_can_be_read_while_the_model_runs_and_share_no_memory(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    first, clones = Site("backbone", 0), list[torch.Tensor]()
    with capture(pi0_tiny, pi0_tiny.sites()) as activations:
        module = pi0_tiny.tap(Site("backbone", 1)).module
        handle = module.register_forward_hook(lambda *_: clones.append(activations[first].clone()))
        pi0_tiny.act([observation], [0])
    handle.remove()
    captured = activations[first]
    assert torch.equal(captured, clones[0])
    assert captured.untyped_storage().nbytes() == captured.numel() * captured.element_size()
    assert not captured.is_inference()


def test_an_edit_that_is_entered_inside_a_capture_does_not_reach_what_passed_before_it(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    sites, zeroed = pi0_tiny.sites(), Site("backbone", 2)
    for _ in range(2):
        with capture(pi0_tiny, sites) as clean:
            pi0_tiny.act([observation], [0])
    with capture(pi0_tiny, sites) as activations, edit(pi0_tiny, {zeroed: torch.zeros_like}):
        pi0_tiny.act([observation], [0])
    assert torch.equal(activations[zeroed], clean[zeroed])
    assert not torch.equal(activations["backbone.03.residual"], clean["backbone.03.residual"])


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


@pytest.mark.parametrize("reduce", [None, lambda _site, activation: activation.mean(1, keepdim=True)])
def test_a_probe_trains_on_any_part_of_what_was_captured(
    pi0_tiny: Pi0, observation: Observation, reduce: Reduce | None
) -> None:
    with capture(pi0_tiny, pi0_tiny.sites(), reduce) as activations:
        pi0_tiny.act([observation, observation], [0, 1])
    assert not any(tensor.is_inference() or tensor.requires_grad for tensor in activations.values())
    tokens = activations["backbone.02.residual"].float()
    probe = torch.nn.Linear(tokens.shape[-1], 2)
    torch.nn.functional.cross_entropy(probe(tokens[:, -1]), torch.tensor([0, 1])).backward()
    assert probe.weight.grad is not None
    assert probe.weight.grad.abs().sum() > 0


@pytest.mark.slow
def test_a_site_that_a_compiled_function_passes_over_names_that_function(observation: Observation) -> None:
    policy = load_policy("pi0-tiny")
    inner = policy.network.model
    inner.denoise_step = torch.compile(inner.denoise_step, backend="eager")
    policy.act([observation], [0])  # compiled code calls no hook that is attached after this
    reason = r"fired 0 times .*torch\.compile or torch\.jit: model\.denoise_step"
    try:
        with pytest.raises(SiteNeverFiredError, match=reason), capture(policy, [Site("expert", 0, iteration=0)]):
            policy.act([observation], [0])
    finally:
        torch.compiler.reset()


@pytest.mark.filterwarnings("ignore:.torch.jit.trace:DeprecationWarning")
def test_every_way_of_compiling_a_part_is_recognised() -> None:
    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.plain, self.block, self.traced = (
                torch.nn.Linear(2, 2),
                torch.nn.Linear(2, 2),
                torch.nn.Linear(2, 2),
            )
            self.block.compile()
            self.traced = torch.jit.trace(self.traced, torch.zeros(1, 2))
            self.step = torch.compile(self.plain.forward)
            self.wrapped = torch.compile(torch.nn.Linear(2, 2))

    class Adapter:
        network = None

        def __init__(self) -> None:
            self.network = Network()

    assert {"block", "traced", "step", "wrapped"} <= set(compiled_parts(Adapter()))
    assert "plain" not in compiled_parts(Adapter())


def test_a_compiled_module_is_refused_with_the_remedy(pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch) -> None:
    tap = pi0_tiny.tap(Site("backbone", 0))
    compiled = replace(tap, module=torch.compile(tap.module))
    monkeypatch.setattr(pi0_tiny, "tap", lambda _site: compiled)
    with pytest.raises(CaptureError, match="uncompiled"), capture(pi0_tiny, [Site("backbone", 0)]):
        pass


def test_a_reduction_runs_at_the_moment_of_firing_and_replaces_the_copy(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    sites = [Site("backbone", 2), Site("expert", 1, iteration=3)]
    with capture(pi0_tiny, sites) as unreduced:
        pi0_tiny.act([observation], [0])
    with capture(pi0_tiny, sites, reduce=lambda _site, activation: activation.mean(1)) as reduced:
        pi0_tiny.act([observation], [0])
    for site in sites:
        assert torch.equal(reduced[site], unreduced[site].mean(1))


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
    sites, tap = pi0_tiny.streams["expert"].sites()[:1], pi0_tiny.tap(Site("expert", 0, iteration=0))
    with capture(pi0_tiny, sites) as plain:
        pi0_tiny.act([observation], [0])
    monkeypatch.setattr(pi0_tiny, "tap", lambda _: replace(tap, fires=3, more=True))
    with capture(pi0_tiny, sites) as cache:
        pi0_tiny.act([observation], [0])
    assert torch.equal(cache[sites[0]], plain[sites[0]])
    assert cache.fires == {"expert.00.residual": 3}
    monkeypatch.setattr(pi0_tiny, "tap", lambda _: replace(tap, fires=11, more=True))
    with pytest.raises(SiteNeverFiredError, match="expected at least 11"), capture(pi0_tiny, sites):
        pi0_tiny.act([observation], [0])


SITE = Site("backbone", 2)


def _tape(policy: Pi0, observations: list[Observation], edits: list[Edit], vectors: dict) -> tuple:
    with apply_edits(policy, edits, observations, vectors) as edit_log, capture(policy, [SITE]) as activations:
        actions = policy.act(observations, [0])
    return activations[SITE][0].numpy(), actions, edit_log


@pytest.fixture
def plain(pi0_tiny: Pi0, observation: Observation) -> np.ndarray:
    return _tape(pi0_tiny, [observation], [], {})[0]


def _direction(policy: Pi0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=policy.streams["backbone"].width).astype(np.float32)


def test_an_edit_is_data_that_can_be_hashed_and_sent_between_processes() -> None:
    zero_edit = Edit("zero", (SITE,), roles=("language",))
    assert pickle.loads(pickle.dumps(zero_edit)) == zero_edit
    assert len({zero_edit, Edit("zero", (SITE,), roles=("language",)), Edit("zero", (SITE,))}) == 2
    assert zero_edit.to_json()["sites"] == ["backbone.02.residual"]


def test_only_tokens_of_the_named_roles_change(pi0_tiny: Pi0, observation: Observation, plain: np.ndarray) -> None:
    changed, _, edit_log = _tape(pi0_tiny, [observation], [Edit("zero", (SITE,), roles=("language",))], {})
    language = pi0_tiny.roles([observation])["backbone"][0].mask("language")
    assert (changed[language] == 0).all()
    np.testing.assert_array_equal(changed[~language], plain[~language])
    (entry,) = edit_log.entries
    assert entry.tokens == language.sum()
    np.testing.assert_allclose(entry.norm, np.linalg.norm(plain[language], axis=1).mean(), rtol=1e-5)
    np.testing.assert_allclose(entry.moved, entry.norm, rtol=1e-5)


def test_adding_and_removing_a_direction_follow_their_formulas(
    pi0_tiny: Pi0, observation: Observation, plain: np.ndarray
) -> None:
    direction = _direction(pi0_tiny)
    vectors = {vector_hash(direction): direction}
    valid = pi0_tiny.roles([observation])["backbone"][0].valid
    add = Edit("add", (SITE,), vector=vector_hash(direction), strength=2.0)
    np.testing.assert_allclose(
        _tape(pi0_tiny, [observation], [add], vectors)[0][valid], plain[valid] + 2 * direction, atol=1e-5
    )
    remove = Edit("remove", (SITE,), vector=vector_hash(direction))
    without_direction = _tape(pi0_tiny, [observation], [remove], vectors)[0]
    np.testing.assert_allclose(without_direction[valid] @ direction, 0, atol=1e-3)
    both = _tape(pi0_tiny, [observation], [add, remove], vectors)[0]
    np.testing.assert_allclose(both[valid], without_direction[valid], atol=1e-4)


def test_dose_zero_changes_no_action_bit_for_bit(pi0_tiny: Pi0, observation: Observation) -> None:
    direction = _direction(pi0_tiny)
    none = Edit("add", (SITE,), vector=vector_hash(direction), strength=0.0)
    expected = pi0_tiny.act([observation], [0])
    np.testing.assert_array_equal(_tape(pi0_tiny, [observation], [none], {none.vector: direction})[1], expected)


def test_a_donor_replaces_token_by_token(pi0_tiny: Pi0, observation: Observation, plain: np.ndarray) -> None:
    donor = np.random.default_rng(1).normal(size=plain.shape).astype(np.float32)
    replacement = Edit("replace", (SITE,), vector=vector_hash(donor))
    valid = pi0_tiny.roles([observation])["backbone"][0].valid
    changed, actions, _ = _tape(pi0_tiny, [observation], [replacement], {vector_hash(donor): donor})
    np.testing.assert_allclose(changed[valid], donor[valid], atol=1e-5)
    assert np.abs(actions - pi0_tiny.act([observation], [0])).max() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "burn", "sites": (SITE,)}, "does not exist"),
        ({"kind": "zero", "sites": ()}, "names no site"),
        ({"kind": "add", "sites": (SITE,)}, "all kinds but zero need one"),
        ({"kind": "zero", "sites": (SITE,), "vector": "ab"}, "all kinds but zero"),
        ({"kind": "zero", "sites": (SITE,), "strength": float("nan")}, "finite"),
    ],
)
def test_an_edit_with_meaningless_fields_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Edit(**arguments)


def test_a_vector_of_another_hash_or_shape_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    direction = _direction(pi0_tiny)
    name = vector_hash(direction)
    add = Edit("add", (SITE,), vector=name)
    with pytest.raises(UsageError, match="no array of that hash"):
        _tape(pi0_tiny, [observation], [add], {name: _direction(pi0_tiny, 1)})
    short = direction[:-1]
    with pytest.raises(UsageError, match="expected"):
        _tape(
            pi0_tiny,
            [observation],
            [Edit("add", (SITE,), vector=vector_hash(short))],
            {vector_hash(short): short},
        )
    with pytest.raises(UnknownSiteError):
        _tape(pi0_tiny, [observation], [Edit("zero", (Site("backbone", 99),))], {})


def test_rows_of_a_batch_are_edited_each_by_its_own_roles(pi0_tiny: Pi0, observation: Observation) -> None:
    """Zero and source, one after the other at the same site; instructions differ in their length."""
    observations = [observation, replace(observation, instruction="Put the cube on the shape")]
    masks = [roles.mask("language") for roles in pi0_tiny.roles(observations)["backbone"]]
    assert masks[0].sum() != masks[1].sum()
    with capture(pi0_tiny, [SITE]) as activations:
        pi0_tiny.act(observations, [0, 1])
    plain = activations[SITE].numpy()
    source = np.random.default_rng(1).normal(size=plain.shape[1:]).astype(np.float32)
    image = Edit("replace", (SITE,), roles=("image",), vector=vector_hash(source), strength=0.5)
    edits = [Edit("zero", (SITE,), roles=("language",)), image]
    with (
        apply_edits(pi0_tiny, edits, observations, {image.vector: source}) as edit_log,
        capture(pi0_tiny, [SITE]) as activations,
    ):
        pi0_tiny.act(observations, [0, 1])
    changed = activations[SITE].numpy()
    for row, roles in enumerate(pi0_tiny.roles(observations)["backbone"]):
        language, pictures = roles.mask("language"), roles.mask("image")
        assert (changed[row][language] == 0).all()
        half = (plain[row] + source)[pictures] / 2
        np.testing.assert_allclose(changed[row][pictures], half, atol=1e-5)
        other_tokens = ~language & ~pictures
        np.testing.assert_array_equal(changed[row][other_tokens], plain[row][other_tokens])
    assert [entry.tokens for entry in edit_log.entries] == [sum(mask.sum() for mask in masks), 2 * pictures.sum()]
    first = edit_log.entries[0]
    lengths = np.concatenate([np.linalg.norm(plain[row][mask], axis=1) for row, mask in enumerate(masks)])
    np.testing.assert_allclose(
        (first.norm, first.moved, first.largest), (lengths.mean(), lengths.mean(), lengths.max()), rtol=1e-5
    )
    assert edit_log.row()[:2].tolist() == [2, 0]
