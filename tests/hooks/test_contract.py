"""What families declare, and how what they do not support is refused before anything is loaded."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from probe_kit.errors import (
    CaptureError,
    EmptyRoleError,
    ObservationError,
    RolesMismatchError,
    UnknownSiteError,
    UnsupportedInterventionError,
    UsageError,
)
from probe_kit.hooks import (
    Family,
    Model,
    ModelCard,
    Observation,
    Option,
    Reading,
    Roles,
    Rows,
    Site,
    Stream,
    Tap,
    capture,
    edit,
    pool,
)
from probe_kit.hooks.capturing.edits import Edit, apply_edits, vector_hash
from probe_kit.hooks.contract.declared import Interventions, check_options, read_pairs
from probe_kit.hooks.contract.roles import Span
from probe_kit.hooks.contract.sites import view_names
from probe_kit.hooks.families.pi0.adapter import Pi0, load_pi0_tiny
from probe_kit.hooks.registry import own_families
from probe_kit.hooks.testing import example_observations
from probe_kit.runs.layout import StoredStream

FAMILIES = own_families()


@pytest.mark.parametrize("name", [name for name, family in FAMILIES.items() if family.abilities.acts])
def test_every_family_that_acts_names_its_streams_and_gives_a_reason_for_what_it_lacks(name: str) -> None:
    supported = FAMILIES[name].abilities.interventions
    assert supported.edits, "say which quantities of which streams can be rewritten"
    assert {"backbone"} < supported.edits.keys()
    assert supported.prompt_kv or "kv" in supported.instead
    one_action = "action" in supported.edits and name != "pi0-fast"  # whose tokens are a whole chunk
    assert (supported.readout == "per-step") == one_action
    assert json.loads(json.dumps(supported.to_json()))["kinds"][:2] == ["swap", "edit"]


@pytest.mark.parametrize("name", [name for name, family in FAMILIES.items() if not family.abilities.acts])
def test_a_vlm_is_refused_because_it_does_not_act(name: str) -> None:
    with pytest.raises(UnsupportedInterventionError, match=f"{name}.*does not act"):
        FAMILIES[name].check_intervention("follow")
    assert FAMILIES[name].interventions_json() is None


def test_a_family_without_a_memory_says_what_to_exchange_instead() -> None:
    with pytest.raises(UnsupportedInterventionError, match=r"internvla-m1.*last `bridge` site"):
        FAMILIES["internvla-m1"].check_intervention("kv")
    FAMILIES["internvla-m1"].check_intervention("edit")


def test_a_family_that_says_nothing_is_told_how_to_say_it() -> None:
    with pytest.raises(UnsupportedInterventionError, match=r"declare `Model\.prompt_kv`"):
        Interventions().check("kv", "mine")
    with pytest.raises(UsageError, match="no intervention levitate"):
        Interventions(instead={"levitate": "no"})


def test_another_adapter_over_the_same_network_keeps_its_memory(pi0_tiny: Pi0, observation: Observation) -> None:
    """The prompt passes once, however often an adapter is put around it."""
    again = type(pi0_tiny)(pi0_tiny.network, pi0_tiny.folder, pi0_tiny.checkpoint)
    again.card = pi0_tiny.card
    assert again.passages is pi0_tiny.passages
    site = Site("kv", 0, "keys")
    with capture(again, [site]) as activations:
        again.act([observation], [0])
    assert activations.fires == {"kv.00.keys": 1}


def test_an_edit_of_the_memory_is_what_every_iteration_reads(pi0_tiny: Pi0, observation: Observation) -> None:
    """Zero values everywhere are an expert that reads nothing: then no picture changes an action."""
    memory = pi0_tiny.prompt_kv
    assert memory is not None
    nothing = {site: lambda values: values * 0 for site in memory.sites("values")}
    nothing |= {site: lambda keys: keys * 0 for site in memory.sites("keys")}
    blank = Observation(np.zeros_like(observation.image), observation.state, observation.instruction)
    with edit(pi0_tiny, nothing):
        first = pi0_tiny.act([observation], [0])
    with edit(pi0_tiny, nothing):
        second = pi0_tiny.act([blank], [0])
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - pi0_tiny.act([observation], [0])).max() > 0


def test_a_donor_of_another_number_of_tokens_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    site = Site("kv", 0, "keys")
    donor = np.zeros((3, 16), np.float32)
    replacement = Edit("replace", (site,), vector=vector_hash(donor))
    with (
        pytest.raises(UsageError, match=r"kv\.00\.keys has shape"),
        apply_edits(pi0_tiny, [replacement], [observation], {replacement.vector: donor}),
    ):
        pi0_tiny.act([observation], [0])


def test_the_memory_passes_in_a_random_twin_too(observation: Observation) -> None:
    twin = load_pi0_tiny(random_weights=True)
    with capture(twin, [Site("kv", 1, "values")]) as activations:
        twin.act([observation], [0])
    assert len(activations) == 1


CARD = ModelCard("guided", "none", "0" * 64, True, 1, "float32", "cpu", "none", ("primary",), 0, 0)


class Guided(Model):
    """Runs conditional rows over unconditional ones, and each step's layer once more beforehand."""

    def __init__(self) -> None:
        self.card = CARD
        self.layer, self.norm = nn.Identity(), nn.Identity()
        self.streams = {"expert": Stream("expert", 1, 3, iterations=2, quantities=("residual",))}
        self.role_names = {"expert": ("action",)}
        self.select: dict = {}

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        return {"expert": [Roles.from_labels(["action"] * 4)] * len(observations)}

    def tap(self, site: Site) -> Tap:
        self.stream_of(site)
        return Tap(self.layer, 2, **self.select)

    def step(self, rows: Tensor) -> Tensor:
        doubled: Tensor = self.layer(torch.cat([rows, -rows]))
        return doubled


ROWS = torch.arange(24, dtype=torch.float32).reshape(2, 4, 3)
SITES = [Site("expert", 0, iteration=step) for step in (0, 1)]


def test_one_half_of_a_doubled_batch_is_the_stream() -> None:
    model = Guided()
    for index, sign in ((0, 1), (1, -1)):
        model.select = {"rows": Rows(index, 2)}
        with capture(model, SITES) as activations:
            model.step(ROWS)
            model.step(2 * ROWS)
        torch.testing.assert_close(activations[SITES[0]], sign * ROWS)
        torch.testing.assert_close(activations[SITES[1]], sign * 2 * ROWS)


def test_an_edit_of_one_half_leaves_the_other() -> None:
    model = Guided()
    model.select = {"rows": Rows(0, 2)}
    with edit(model, {SITES[0]: torch.zeros_like, SITES[1]: torch.zeros_like}):
        first, second = model.step(ROWS), model.step(ROWS)
    for output in (first, second):
        torch.testing.assert_close(output, torch.cat([0 * ROWS, -ROWS]))


def test_rows_that_do_not_divide_are_refused() -> None:
    model = Guided()
    model.select = {"rows": Rows(0, 3)}
    with pytest.raises(CaptureError, match="3 equal blocks"), capture(model, SITES):
        model.step(ROWS)


def test_calls_before_the_first_one_are_passed_over_but_counted() -> None:
    model = Guided()
    model.select = {"first": 1}
    with capture(model, SITES) as activations:
        for factor in (1, 2, 3):
            model.step(factor * ROWS)
    torch.testing.assert_close(activations[SITES[0]][:2], 2 * ROWS)
    with pytest.raises(CaptureError, match="fired 1 times in one inference; expected 3"), capture(model, SITES):
        model.step(ROWS)


def test_a_view_brings_flat_tokens_to_rows_and_carries_edits_back() -> None:
    model = Guided()
    model.select = {"view": lambda flat: flat.reshape(2, 4, 3)}
    flat = ROWS.reshape(8, 3).clone()
    with edit(model, dict.fromkeys(SITES, lambda activation: activation + 1)):
        changed = model.layer(flat)
        model.layer(flat.clone())
    torch.testing.assert_close(changed, ROWS.reshape(8, 3) + 1)


def test_a_tensor_given_by_keyword_is_captured_and_another_keyword_is_an_error() -> None:
    class Called(nn.Module):
        def forward(self, *, hidden: Tensor) -> Tensor:
            return hidden

    model = Guided()
    model.layer = Called()  # type: ignore[assignment]
    model.select = {"argument": "hidden"}
    with capture(model, SITES) as activations:
        model.layer(hidden=ROWS)
        model.layer(hidden=2 * ROWS)
    torch.testing.assert_close(activations[SITES[1]], 2 * ROWS)
    model.select = {"argument": "states"}
    with pytest.raises(CaptureError, match="without the keyword 'states'"), capture(model, SITES):
        model.layer(hidden=ROWS)


def test_a_quantity_that_was_not_declared_is_refused_by_name() -> None:
    with pytest.raises(UnknownSiteError, match="expert: 1 layers x 2 iterations of residual"):
        Guided().tap(Site("expert", 0, "mlp", 0))


def test_observations_that_the_card_rules_out_are_refused() -> None:
    model, observations = Guided(), example_observations(["one", "two"])
    model.check(observations, [0, 1])
    with pytest.raises(ObservationError, match="2 observations but 1 seeds"):
        model.check(observations, [0])
    model.card = replace(CARD, batch=1)
    with pytest.raises(ObservationError, match="at most 1"):
        model.check(observations)
    model.card = replace(CARD, needs=frozenset({"intrinsics", "camera.wrist"}))
    with pytest.raises(ObservationError, match=r"no camera\.wrist, which guided reads"):
        model.check(observations[:1])


def test_a_stream_of_an_unknown_part_is_refused_and_old_names_tell_theirs() -> None:
    assert Stream("expert", 2, 8).part == "action"
    with pytest.raises(UsageError, match="declares part None"):
        Stream("torso", 2, 8)


def test_a_reading_picks_the_options_and_says_their_share() -> None:
    logits = np.log(np.array([[0.1, 0.2, 0.7], [0.5, 0.25, 0.25]], np.float32))
    reading = Reading.of(logits, [[0, 2], [1, 2]])
    np.testing.assert_allclose(np.exp(reading.option_logits), [[0.1, 0.7], [0.25, 0.25]], rtol=1e-6)
    np.testing.assert_allclose(reading.option_mass, [0.8, 0.5], rtol=1e-6)


DECLARED = (
    Option("size", int, "Of something.", "8", choices=(8, 16)),
    Option("crop", bool, "Whether.", "false"),
    Option("scale", float, "How much."),
    Option("prompt", str, "Which."),
)


def test_texts_become_values_of_the_declared_kind() -> None:
    texts = read_pairs(["size=16", "crop=Yes", "scale=2", "prompt=a=b"])
    assert check_options("mine", DECLARED, texts) == {"size": 16, "crop": True, "scale": 2.0, "prompt": "a=b"}


def test_values_that_have_the_kind_already_pass_and_whole_numbers_are_numbers() -> None:
    checked = check_options("mine", DECLARED, {"size": 8, "crop": False, "scale": 3})
    assert checked == {"size": 8, "crop": False, "scale": 3.0}
    assert type(checked["scale"]) is float


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sice": "8"}, "no model option sice; it has crop, prompt, scale, size. Did you mean size"),
        ({"size": "9"}, "expected one of 8, 16"),
        ({"size": "eight"}, "expected a whole number"),
        ({"size": True}, "expected a whole number"),
        ({"crop": "maybe"}, "expected true or false"),
        ({"crop": 1}, "expected true or false"),
        ({"prompt": 3}, "expected text"),
    ],
)
def test_a_model_option_that_was_not_declared_is_refused(options: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_options("mine", DECLARED, options)


@pytest.mark.parametrize("pair", ["size", "=8", "  =8"])
def test_a_pair_without_key_and_value_is_refused(pair: str) -> None:
    with pytest.raises(UsageError, match="not KEY=VALUE"):
        read_pairs([pair])


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="given twice"):
        read_pairs(["size=8", "size=16"])


def test_a_family_of_the_former_contract_is_told_what_to_change() -> None:
    with pytest.raises(UsageError, match=r"Option\('unnorm_key', str"):
        Family("mine", "of 0.2", None, "mine:load", options=("unnorm_key",))  # type: ignore[arg-type]


ROLES = Roles.from_labels(["image.base", "image.base", "language", "language", "padding"])


def test_labels_become_spans_and_masks() -> None:
    assert ROLES.spans == (Span("image.base", 0, 2), Span("language", 2, 4), Span("padding", 4, 5))
    assert ROLES.mask("language").tolist() == [False, False, True, True, False]
    assert ROLES.valid.tolist() == [True, True, True, True, False]


def test_spans_with_a_gap_are_refused() -> None:
    with pytest.raises(ValueError, match="tile the sequence"):
        Roles((Span("image.base", 0, 2), Span("language", 3, 4)))


def test_pooled_views_equal_numpy_and_padding_enters_none() -> None:
    tokens = np.random.default_rng(0).normal(size=(3, 5, 7)).astype(np.float32)
    tokens[:, 4] = 1e9
    pooled = pool(torch.from_numpy(tokens), ROLES, ["mean", "last", "mean:image.base", "mean:language"]).numpy()
    expected = [tokens[:, :4].mean(1), tokens[:, 3], tokens[:, :2].mean(1), tokens[:, 2:4].mean(1)]
    np.testing.assert_allclose(pooled, np.stack(expected, axis=1), rtol=1e-5, atol=1e-6)


def test_bfloat16_is_reduced_in_float32() -> None:
    tokens = torch.full((300, 1), 1.0, dtype=torch.bfloat16)
    tokens[0] = 2.0
    mean = pool(tokens, Roles.from_labels(["action"] * 300), ["mean"])
    assert mean.dtype == torch.float32
    assert mean.item() == pytest.approx(301 / 300, abs=1e-6)


def test_a_view_without_a_token_is_an_error_and_not_a_zero() -> None:
    with pytest.raises(EmptyRoleError, match="mean:state"):
        pool(torch.zeros(5, 2), ROLES, ["mean:state"])


def test_roles_of_another_length_are_an_error() -> None:
    with pytest.raises(RolesMismatchError, match="6 tokens"):
        pool(torch.zeros(6, 2), ROLES, ["mean"])


def test_an_unknown_view_is_an_error() -> None:
    with pytest.raises(UnknownSiteError, match="median"):
        pool(torch.zeros(5, 2), ROLES, ["median"])


def test_every_role_but_padding_and_special_has_a_view() -> None:
    assert view_names(("image.base", "language", "special", "padding")) == (
        "mean",
        "last",
        "mean:image.base",
        "mean:language",
    )


@pytest.mark.parametrize("name", ["backbone.07.residual", "expert.03.residual@4", "expert.120.residual@12"])
def test_a_site_name_survives_parsing(name: str) -> None:
    assert str(Site.parse(name)) == name


@pytest.mark.parametrize("name", ["backbone", "backbone.7.residual", "backbone.07", "expert.03.residual@x", ""])
def test_another_form_is_refused(name: str) -> None:
    with pytest.raises(UnknownSiteError, match="expected <stream>"):
        Site.parse(name)


@pytest.mark.parametrize("iterations", [None, 3])
def test_a_stream_holds_the_sites_that_it_lists_and_no_other(iterations: int | None) -> None:
    stream = Stream(
        "expert", layers=3, width=8, iterations=iterations, quantities=("residual", "mlp", "final_norm")
    )
    every = {site for quantity in stream.quantities for site in stream.sites(quantity)}
    for name in ("expert", "backbone"):
        for layer in range(-1, 5):
            for quantity in (*stream.quantities, "attention"):
                for iteration in (None, -1, 0, 2, 3):
                    site = Site(name, layer, quantity, iteration)
                    assert stream.holds(site) == (site in every)


def test_a_stream_lists_its_sites_by_iteration_then_layer() -> None:
    assert [str(site) for site in Stream("expert", layers=2, width=8, iterations=2).sites()] == [
        "expert.00.residual@0",
        "expert.01.residual@0",
        "expert.00.residual@1",
        "expert.01.residual@1",
    ]
    assert [str(site) for site in Stream("backbone", layers=2, width=8).sites()] == [
        "backbone.00.residual",
        "backbone.01.residual",
    ]


def test_heads_are_a_quantity_of_every_block_that_is_captured_and_stored_nowhere() -> None:
    plain = Stream("backbone", layers=3, width=8)
    stream = Stream("backbone", layers=3, width=8, heads=2)
    assert [str(site) for site in stream.sites("heads")] == ["backbone.00.heads", "backbone.01.heads"]
    assert stream.captured == (*plain.captured, "heads")
    assert stream == plain
    assert StoredStream.of(stream, 5, ("mean",)) == StoredStream.of(plain, 5, ("mean",))
    assert "heads" not in str(asdict(StoredStream.of(stream, 5, ("mean",))))
    with pytest.raises(UnknownSiteError, match="the stream backbone has no quantity 'heads'"):
        plain.sites("heads")
