"""Every adapter passes the same contract."""

from pathlib import Path

import pytest

from probe_kit.hooks import Observation
from probe_kit.hooks.families.pi0.adapter import Pi0, load_pi0
from probe_kit.hooks.families.smolvla.adapter import SmolVLA, load_smolvla
from probe_kit.hooks.testing import AdapterContract, example_observations

GOLDEN_TASKS = ["open the drawer", "pick up the red cube and place it on the tray"]


@pytest.fixture(scope="module")
def pi0(golden_pi0: Path) -> Pi0:
    return load_pi0(str(golden_pi0 / "checkpoint"))


@pytest.fixture(scope="module")
def smolvla(golden_smolvla: Path) -> SmolVLA:
    return load_smolvla(str(golden_smolvla / "checkpoint"))


class TestPi0Tiny(AdapterContract):
    @pytest.fixture
    def policy(self, pi0_tiny: Pi0) -> Pi0:
        return pi0_tiny


class TestGoldenPi0(AdapterContract):
    """Two cameras, of which one stays masked, and an empty one."""

    @pytest.fixture
    def policy(self, pi0: Pi0) -> Pi0:
        return pi0

    @pytest.fixture
    def observations(self) -> list[Observation]:
        return example_observations(GOLDEN_TASKS)


class TestGoldenSmolVLA(AdapterContract):
    @pytest.fixture
    def policy(self, smolvla: SmolVLA) -> SmolVLA:
        return smolvla

    @pytest.fixture
    def observations(self) -> list[Observation]:
        return example_observations(GOLDEN_TASKS)
