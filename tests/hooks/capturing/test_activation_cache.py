import pytest
import torch

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks import ActivationCache, Observation, Site, capture
from probe_kit.hooks.families.pi0.adapter import Pi0


@pytest.fixture(scope="module")
def tape(pi0_tiny: Pi0) -> ActivationCache:
    import numpy as np

    seen = Observation(np.zeros((48, 64, 3), np.uint8), np.zeros(8, np.float32), "Put the cube on the red shape")
    with capture(pi0_tiny, pi0_tiny.sites()) as tape:
        pi0_tiny.act([seen, seen], [0, 1])
    return tape


def test_a_tape_is_a_mapping_from_sites(tape: ActivationCache, pi0_tiny: Pi0) -> None:
    assert set(tape) == set(tape.keys()) == set(pi0_tiny.sites())
    assert len(list(tape)) == len(tape) == 44
    assert all(torch.equal(tape[site], kept) for site, kept in tape.items())
    assert {tape: 1}[tape] == 1  # compared by identity, as tensors are


def test_the_name_of_a_site_does_as_well_as_the_site(tape: ActivationCache) -> None:
    assert torch.equal(tape["expert.02.residual@3"], tape[Site("expert", 2, iteration=3)])
    assert "backbone.03.residual" in tape
    assert "backbone.09.residual" not in tape
    assert "nonsense" not in tape
    assert tape.get("backbone.09.residual") is None


def test_a_site_that_was_not_captured_is_named_with_what_was(tape: ActivationCache) -> None:
    with pytest.raises(
        UnknownSiteError, match=r"backbone\.09\.residual was not captured; .*expert.residual: 4 layers x 10"
    ):
        tape["backbone.09.residual"]
    with pytest.raises(UnknownSiteError, match="nothing yet"):
        ActivationCache()["backbone.00.residual"]


def test_layers_and_iterations_stack_into_one_tensor(tape: ActivationCache) -> None:
    assert tape.stack("backbone").shape == (4, 2, 52, 96)
    expert = tape.stack("expert")
    assert expert.shape == (4, 10, 2, 17, 64)
    assert torch.equal(expert[2, 7], tape["expert.02.residual@7"])
    with pytest.raises(UnknownSiteError, match="mlp was captured"):
        tape.stack("expert", "mlp")


def test_what_has_no_rectangular_shape_is_not_stacked(pi0_tiny: Pi0, observation: Observation) -> None:
    with capture(pi0_tiny, [Site("expert", 0, iteration=0), *pi0_tiny.streams["expert"].sites()[1:]]) as whole:
        pi0_tiny.act([observation], [0])
    del whole._kept[Site("expert", 1, iteration=4)]
    with pytest.raises(UnknownSiteError, match=r"layers \[1\] of expert lack iterations"):
        whole.stack("expert")


def test_it_says_what_it_holds(tape: ActivationCache) -> None:
    assert (
        repr(tape)
        == "<ActivationCache of 44 sites: backbone.residual: 4 layers; expert.residual: 4 layers x 10 iterations>"
    )
    assert "2 × 17 × 64" in tape._repr_html_()
    assert repr(ActivationCache()) == "<ActivationCache of 0 sites>"
