"""An adapter whose network ignores the noise of the seed fails the contract, in every family that draws noise.

lerobot's X-VLA takes a noise argument and draws its own: an adapter that passed noise to it would look sound.
"""

from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from probe_kit.errors import ProbeKitError
from probe_kit.hooks import Policy, load_model
from probe_kit.hooks.conformance.check import CheckFailedError
from probe_kit.hooks.conformance.policies import (
    actions_have_the_contracts_shape_and_come_from_the_seed_alone,
    another_seed_gives_another_chunk_where_noise_is_drawn,
)
from probe_kit.hooks.conformance.subject import PolicySubject
from probe_kit.hooks.registry import own_families
from tests.support.every_checkpoint import WRITERS

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:the model put out tokens")]
NOISY = {"pi0", "pi05", "smolvla", "molmoact2", "groot", "xvla", "eo1", "xiaomi-r0", "internvla-m1"}
ACTING = [name for name in WRITERS if own_families()[name].abilities.acts]
DRAWN, CONSTANT = (
    actions_have_the_contracts_shape_and_come_from_the_seed_alone,
    another_seed_gives_another_chunk_where_noise_is_drawn,
)
IGNORED: dict[str, tuple[Callable[[Tensor], Tensor], Any]] = {
    "drawn by the package itself": (torch.randn_like, DRAWN),
    "zeros": (torch.zeros_like, CONSTANT),
}


def checked(policy: Policy) -> PolicySubject:
    return PolicySubject(model=policy, instructions=("put the cube on the red shape",))


@pytest.mark.parametrize("family", ACTING)
def test_noise_that_is_ignored_fails_the_contract(family: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    if family == "pi0":  # its written checkpoint has no units; this one has its modules
        policy = load_model("pi0-tiny")
    else:
        policy = load_model(family, str(write(tmp_path / family)), "cpu", "float32", **options)
    assert isinstance(policy, Policy)
    assert (policy.draws_noise is True) == (family in NOISY)
    if family not in NOISY:
        first, other = (checked(policy).run_row(checked(policy).single[0], seed) for seed in (5, 6))
        assert (first == other).all()  # nothing is drawn, so that there is no noise to ignore
        return
    for check in (DRAWN, CONSTANT):
        check(checked(policy))
    for instead, found_by in IGNORED.values():
        with pytest.raises((CheckFailedError, ProbeKitError), match="seed"):
            found_by(checked(ignoring(policy, instead)))


def ignoring(policy: Policy, instead: Callable[[Tensor], Tensor]) -> Policy:
    """The policy with `infer`, whose last argument is the noise, given something in the place of it."""
    kind: Any = type(policy)
    other: Any = copy(policy)

    def infer(self: Any, *arguments: Any) -> Any:
        return kind.infer(self, *arguments[:-1], instead(arguments[-1]))

    other.__class__ = type("Ignoring", (kind,), {"infer": infer})
    return cast(Policy, other)
