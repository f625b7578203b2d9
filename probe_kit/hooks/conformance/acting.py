"""Checks of policies: actions, seeds, inference without acting."""

import numpy as np
import torch

from probe_kit.errors import ObservationError
from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.conformance.check import SkipTest, check, refused, require, require_bits
from probe_kit.hooks.conformance.subject import PolicySubject
from probe_kit.hooks.contract.model import Policy


@check(
    "The action is made in a probed stream with part='action'.",
    "Declare the stream that makes the action, and chunk ≥ execute ≥ 1 in the card.",
)
def the_action_is_made_in_a_stream(subject: PolicySubject) -> None:
    streams, card = subject.policy.streams.values(), subject.policy.card
    acting = [stream.name for stream in streams if stream.part == "action" and stream.probed]
    require(
        bool(acting), f"streams {[stream.name for stream in streams]}", "one with part='action' that is probed"
    )
    require(card.chunk >= card.execute >= 1, f"chunk {card.chunk}, execute {card.execute}", "chunk ≥ execute ≥ 1")


@check(
    "Actions are (batch, chunk, 7) float32, finite, and come from the seed alone.",
    "Return float32 with seven numbers per action, and draw noise from a generator seeded with the row's seed.",
)
def actions_have_the_contracts_shape_and_come_from_the_seed_alone(subject: PolicySubject) -> None:
    policy, observations = _acting(subject), subject.batch
    seeds = [5, 6][: len(observations)]
    torch.manual_seed(1)
    first = policy.act(observations, seeds)
    torch.manual_seed(2)
    require_bits(policy.act(observations, seeds), first, "actions of the same seeds", "those of the first call")
    shape = (len(observations), policy.card.chunk, 7)
    require(first.shape == shape, f"actions of shape {first.shape}", f"{shape}")
    require(first.dtype == np.float32, f"actions of type {first.dtype}", "float32")
    require(bool(np.isfinite(first).all()), "actions that hold NaN or infinity", "finite numbers")


@check(
    "Another seed gives another chunk where noise enters an inference, and the same one where none does.",
    "Pass the noise of the row's seed to the network, and set `draws_noise`. Some packages ignore given noise.",
)
def another_seed_gives_another_chunk_where_noise_is_drawn(subject: PolicySubject) -> None:
    policy = subject.policy
    if policy.draws_noise is None:
        raise SkipTest(f"{policy.card.family} does not say whether noise enters an inference (`draws_noise`)")
    first, other = (subject.run_row(subject.single[0], seed) for seed in (5, 6))
    if policy.draws_noise:
        require(not np.array_equal(first, other), "the same actions of two seeds", "others: the noise is ignored")
    else:
        require_bits(other, first, "actions of another seed", "those of the first, or `draws_noise = True`")


@check(
    "An inference without acting is that of acting, bit for bit at every site.",
    "Let `infer_without_acting` call what `act` calls, with the same inputs.",
)
def inference_without_acting_equals_that_of_acting(subject: PolicySubject) -> None:
    policy, observations = _acting(subject), subject.single
    sites = policy.sites()
    with capture(policy, sites) as acting:
        policy.act(observations, [5])
    with capture(policy, sites) as without_acting:
        raw = policy.infer_without_acting(observations, [5])
    require(raw.shape[0] == 1, f"{raw.shape[0]} rows for one observation", "1")
    for site in sites:
        equal = torch.equal(acting[site], without_acting[site])
        require(equal, f"another activation at {site}", "the same, bit for bit")


@check(
    "Every observation needs a seed of its own.",
    "Call `self.check(observations, seeds)` first in `act`.",
)
def every_observation_needs_its_seed(subject: PolicySubject) -> None:
    with refused("an observation without a seed", ObservationError):
        subject.policy.act(subject.batch, [])


def _acting(subject: PolicySubject) -> Policy:
    """The policy. Raises SkipTest for one whose actions do not fit this arm."""
    if (mismatch := subject.policy.embodiment_mismatch()) is not None:
        raise SkipTest(f"its actions do not fit this arm: {mismatch}")
    return subject.policy
