"""What families declare, and how what they do not support is refused before anything is loaded."""

import json

import numpy as np
import pytest

from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks import Observation, Site, capture, edit
from probe_kit.hooks.capturing.edits import Edit, apply_edits, vector_hash
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.hooks.families.pi0.adapter import Pi0, load_pi0_tiny
from probe_kit.hooks.registry import own_families

FAMILIES = own_families()


@pytest.mark.parametrize("name", [name for name, family in FAMILIES.items() if family.acts])
def test_every_family_that_acts_names_its_streams_and_gives_a_reason_for_what_it_lacks(name: str) -> None:
    supported = FAMILIES[name].interventions
    assert supported.edits, "say which quantities of which streams can be rewritten"
    assert {"backbone"} < supported.edits.keys()
    assert supported.prompt_kv or "kv" in supported.instead
    one_action = "action" in supported.edits and name != "pi0-fast"  # whose tokens are a whole chunk
    assert (supported.readout == "per-step") == one_action
    assert json.loads(json.dumps(supported.to_json()))["kinds"][:2] == ["swap", "edit"]


@pytest.mark.parametrize("name", [name for name, family in FAMILIES.items() if not family.acts])
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
    with capture(again, [site]) as tape:
        again.act([observation], [0])
    assert tape.fires == {"kv.00.keys": 1}


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
    own = Edit("replace", (site,), vector=vector_hash(donor))
    with (
        pytest.raises(UsageError, match=r"kv\.00\.keys has shape"),
        apply_edits(pi0_tiny, [own], [observation], {own.vector: donor}),
    ):
        pi0_tiny.act([observation], [0])


def test_the_memory_passes_in_a_random_twin_too(observation: Observation) -> None:
    twin = load_pi0_tiny(random_weights=True)
    with capture(twin, [Site("kv", 1, "values")]) as tape:
        twin.act([observation], [0])
    assert len(tape) == 1
