"""Every family that reads a state compares it with its statistics, or says by name that it has none."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import UnitsError
from probe_kit.extract.sources.source import check_units, unusual_shares
from probe_kit.hooks import load_policy
from probe_kit.hooks.registry import own_families
from tests.support.every_checkpoint import WRITERS
from tests.support.groot_checkpoints import write_nvidias

ACTING = {name: made for name, made in WRITERS.items() if own_families()[name].acts}
MADE: dict[str, tuple[str, Callable[[Path], Path], dict[str, Any]]] = {
    **{name: (name, *made) for name, made in ACTING.items()},
    "groot of NVIDIA": ("groot", write_nvidias, {"embodiment": "libero_sim"}),
    "pi0 of Bridge": ("pi0", ACTING["pi0"][0], {"statistics": "bridge"}),
}
UNGUARDED = {
    "openvla": "no state is read",
    "spatialvla": "no state is read",
    "magma": "no state is read",
    "internvla-m1": "no state is read",
    "xiaomi-r0": "statistics of actions alone",
    "pi0": "leaves the units of its observation.state to its evaluation",
}
NOTE = "units of states are not compared with statistics: "


@pytest.mark.parametrize("name", MADE)
def test_a_state_in_other_units_is_refused_or_the_family_says_why_it_is_not_compared(
    name: str, tmp_path: Path
) -> None:
    family, write, options = MADE[name]
    policy = load_policy(family, str(write(tmp_path / "model")), **options)
    notes = [note for note in policy.card.notes if note.startswith(NOTE)]
    if name in UNGUARDED:
        assert policy.unguarded_state is not None
        assert UNGUARDED[name] in policy.unguarded_state
        assert notes == ([] if policy.state_numbers is None else [NOTE + policy.unguarded_state])
        return
    assert policy.unguarded_state is None
    assert notes == []
    assert policy.state_numbers is not None
    far = np.full((4, policy.state_numbers), 1e4, np.float32)
    shares = unusual_shares(policy, far)
    assert shares.tolist() == [1.0] * policy.state_numbers
    names = [str(number) for number in range(policy.state_numbers)]
    with pytest.raises(UnitsError, match=r"the source: .*outside the statistics of .*--accept-units"):
        check_units(shares, names, "the source", policy, False)


def test_a_state_that_a_checkpoint_reads_as_it_is_is_named(tmp_path: Path) -> None:
    policy = load_policy("pi0", str(ACTING["pi0"][0](tmp_path / "model")), statistics="none")
    assert f"{NOTE}the state is IDENTITY by -M statistics=none" in policy.card.notes
