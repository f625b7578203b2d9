"""Every adapter passes the same contract, on checkpoints made here and, where they are, on golden ones."""

from pathlib import Path

import pytest

from probe_kit.hooks import Model, Observation
from probe_kit.hooks.families.pi0.adapter import Pi0, load_pi0
from probe_kit.hooks.families.smolvla.adapter import SmolVLA, load_smolvla
from probe_kit.hooks.testing import AdapterContract
from probe_kit.models.embedded.folder import embedded_checkpoint
from tests.support.smolvla_checkpoints import write_smolvla


class TestPi0Tiny(AdapterContract):
    family = "pi0-tiny"

    @pytest.fixture(scope="class")
    def checkpoint(self) -> Path:
        return embedded_checkpoint("pi0-tiny")

    @pytest.fixture
    def policy(self, pi0_tiny: Pi0) -> Pi0:
        return pi0_tiny


class TestSmolVLA(AdapterContract):
    family = "smolvla"

    @pytest.fixture(scope="class")
    def checkpoint(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_smolvla(tmp_path_factory.mktemp("smolvla"))

    @pytest.fixture(scope="class")
    def policy(self, checkpoint: Path) -> SmolVLA:
        return load_smolvla(str(checkpoint))


@pytest.mark.slow
class TestSmolVLAWithMarkedPicturesMaskedCamerasAndAFixedPrefix(TestSmolVLA):
    @pytest.fixture(scope="class")
    def checkpoint(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_smolvla(
            tmp_path_factory.mktemp("marked"),
            cameras=("top", "wrist"),
            add_image_special_tokens=True,
            empty_cameras=1,
            prefix_length=40,
        )


class _Golden:
    @pytest.fixture
    def observations(self, model: Model) -> list[Observation]:
        return AdapterContract.examples(model, "open the drawer", "pick up the red cube and place it on the tray")

    @pytest.fixture
    def alike(self, model: Model) -> list[Observation]:
        return AdapterContract.examples(model, "open the drawer", "open the tray")


@pytest.mark.slow
class TestGoldenPi0(_Golden, AdapterContract):
    """Two cameras, of which one stays masked, and an empty one."""

    @pytest.fixture(scope="class")
    def policy(self, golden_pi0: Path) -> Pi0:
        return load_pi0(str(golden_pi0 / "checkpoint"))


@pytest.mark.slow
class TestGoldenSmolVLA(_Golden, AdapterContract):
    @pytest.fixture(scope="class")
    def policy(self, golden_smolvla: Path) -> SmolVLA:
        return load_smolvla(str(golden_smolvla / "checkpoint"))
