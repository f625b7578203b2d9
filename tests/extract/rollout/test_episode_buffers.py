"""Staging: whole rows, so that a GPU can copy them beside its work, and the zeros behind an episode's tokens."""

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from probe_kit.extract.rollout import capturing as staging
from probe_kit.extract.rollout.capturing import Capturer, EpisodeBuffers, copy_aside, stored_streams
from probe_kit.hooks import Observation, Roles
from probe_kit.hooks.contract.roles import _matrix
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs.layout import StoredStream

STREAM = StoredStream("backbone", 2, 4, None, 5, ("mean", "last"), quantities=("residual",))
ROLES = {"backbone": Roles.from_labels(["language"] * 5)}
WAITING = {
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "is_nonzero",
    "equal",
    "unique",
    "_unique2",
    "lift_fresh",
}
"""Operations that bring a value, or a shape that depends on values, to the host: it waits for the device there."""


class Called(TorchDispatchMode):
    """The names of all operations, in order, and what they moved to another device."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):  # type: ignore[no-untyped-def]
        self.names.append(function.overloadpacket.__name__)
        return function(*arguments, **(keywords or {}))

    def waiting(self) -> list[str]:
        return [name for name in self.names if name in WAITING]


@pytest.mark.parametrize("with_tokens", [False, True])
def test_capture_adds_nothing_to_an_inference_that_waits_for_the_device(
    pi0_tiny: Pi0, observation: Observation, with_tokens: bool
) -> None:
    """The same code runs on a GPU; what waits there is known by its name here."""
    seen, inferences, misses = [observation, observation], list[Called](), list[int]()
    roles = pi0_tiny.roles(seen)
    streams = stored_streams(pi0_tiny, roles)
    capturer = Capturer(pi0_tiny, streams, with_tokens, "actions")
    buffers = {row: EpisodeBuffers(streams, 1, with_tokens, pinned=False) for row in range(2)}

    def infer() -> np.ndarray:
        before = _matrix.cache_info().misses
        with Called() as called:
            actions = pi0_tiny.act(seen, [0, 1])
        inferences.append(called)
        misses.append(_matrix.cache_info().misses - before)
        return actions

    capturer.run(infer, lambda actions: actions, roles, buffers)
    captured, plain = inferences
    assert len(captured.names) > len(plain.names)
    assert captured.waiting() == plain.waiting()
    assert misses == [0, 0], "what pooling needs is on the device before the model runs"


def test_one_question_to_the_device_tells_whether_all_sites_are_finite(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    from probe_kit.hooks import capture

    asked = []
    for sites in (pi0_tiny.sites()[:1], pi0_tiny.sites()):
        with Called() as called, capture(pi0_tiny, sites):
            pi0_tiny.act([observation], [0])
        asked.append(called.waiting().count("_local_scalar_dense"))
    assert asked[0] == asked[1]


def test_tokens_arrive_in_whole_rows_with_zeros_behind_them(monkeypatch: pytest.MonkeyPatch) -> None:
    buffers = EpisodeBuffers([STREAM], 1, True, pinned=False)
    buffers.tokens["backbone"].fill(7)  # as a row of a longer episode would leave it
    whole: list[bool] = []

    def copied(source: torch.Tensor, target: torch.Tensor) -> None:
        whole.append(target.is_contiguous() and source.is_contiguous())
        copy_aside(source, target)

    monkeypatch.setattr(staging, "copy_aside", copied)
    buffers.keep_roles(ROLES)
    bits = torch.arange(2 * 5 * 4, dtype=torch.int16).reshape(2, 5, 4)
    buffers.keep_tokens("backbone", bits)
    buffers.keep_pooled("backbone", torch.ones(2, 2, 4))
    stored = buffers.tokens["backbone"][0]
    assert stored.shape == (2, STREAM.stored_tokens, 4)
    np.testing.assert_array_equal(stored[:, :5], bits.numpy().view(np.uint16))
    assert not stored[:, 5:].any()
    assert whole == [True, True]
    buffers.wait()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
def test_copies_from_a_gpu_arrive_beside_its_next_work() -> None:
    streams = [StoredStream("backbone", 4, 2048, None, 816, ("mean",), quantities=("residual",))]
    buffers = EpisodeBuffers(streams, 1, True, pinned=True)
    bits = torch.randint(-(2**15), 2**15, (4, 816, 2048), dtype=torch.int16, device="cuda")
    expected = bits.cpu().numpy()
    buffers.keep_roles({"backbone": Roles.from_labels(["language"] * 816)})
    buffers.keep_tokens("backbone", bits)
    del bits
    scratch = [torch.full((4, 896, 2048), n, dtype=torch.int16, device="cuda") for n in range(8)]
    buffers.wait()
    np.testing.assert_array_equal(buffers.tokens["backbone"][0][:, :816].view(np.int16), expected)
    assert len(scratch) == 8
