"""An output that changes under capture is an error that names its cause; torch's fused encoder is switched off."""

from collections.abc import Iterator, Sequence
from itertools import count

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from probe_kit.hooks import Observation, capture
from probe_kit.hooks.capturing.capture_context import reason_of_change
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Requirements
from probe_kit.hooks.testing import example_observations
from tests.support.encoder_vla.policy import EncoderPolicy, load, write_checkpoint

SEEN = example_observations(["Put the cube on the star"])


@pytest.fixture(autouse=True)
def fused() -> Iterator[None]:
    """As a fresh process has it; the tests before may have loaded models."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(True)
    yield
    torch.backends.mha.set_fastpath_enabled(before)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_checkpoint(tmp_path_factory.mktemp("encoder")))


def plain(policy: EncoderPolicy) -> NDArray[np.float32]:
    return policy.act(SEEN, [0])


def captured(policy: EncoderPolicy) -> NDArray[np.float32]:
    with capture(policy, policy.sites()):
        return policy.act(SEEN, [0])


def reason(policy: EncoderPolicy) -> str:
    return reason_of_change(lambda: plain(policy), plain(policy), lambda: captured(policy))


def test_torchs_fused_encoder_rounds_differently_under_hooks_and_is_named(checkpoint: str) -> None:
    policy = load(checkpoint)
    change = np.abs(plain(policy) - captured(policy)).max()
    assert 0 < change < 1e-5, "torch no longer fuses: remove what switches it off"
    cause = reason(policy)
    assert "torch's fused encoder" in cause
    assert "set_fastpath_enabled(False)" in cause
    assert torch.backends.mha.get_fastpath_enabled(), "the diagnosis left it as it was"


def test_a_family_loads_with_the_fused_encoder_switched_off(checkpoint: str) -> None:
    family = Family(
        "encoder-vla",
        "",
        None,
        "tests.support.encoder_vla.policy:load",
        requirements=Requirements(needs_checkpoint=True),
    )
    policy = family.load(checkpoint)
    assert isinstance(policy, EncoderPolicy)
    np.testing.assert_array_equal(plain(policy), captured(policy))


def test_state_that_is_kept_between_calls_is_told_from_a_path_that_hooks_change(checkpoint: str) -> None:
    calls = count(1)

    class Drifting(EncoderPolicy):
        def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
            return super().act(observations, seeds) + np.float32(1e-3 * next(calls))

    sound = load(checkpoint)
    drifting = Drifting(sound.network, sound.card)
    cause = reason(drifting)
    assert "keeps state between calls" in cause
    assert "fused" not in cause


def test_another_module_that_looks_for_hooks_is_described(checkpoint: str) -> None:
    class Looking(EncoderPolicy):
        def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
            hooked = any(module._forward_pre_hooks for module in self.network.modules())
            return super().act(observations, seeds) + np.float32(hooked)

    sound = load(checkpoint)
    looking = Looking(sound.network, sound.card)
    cause = reason(looking)
    assert "while it has hooks" in cause
    assert "keeps state" not in cause
