"""The embedded default: small enough to ship, and it knows what its model card says."""

from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.models.pi0_tiny import ACTION_DIMS
from probe_kit.suite import build_suite

NAMES = ("pi0-tiny", "pi0-tiny-early")


def test_the_weights_that_come_with_the_package_are_small() -> None:
    assert sum((embedded_checkpoint(name) / "model.safetensors").stat().st_size for name in NAMES) < 5_000_000


@pytest.mark.parametrize("name", NAMES)
def test_the_weights_say_how_they_were_made(name: str) -> None:
    path = embedded_checkpoint(name) / "model.safetensors"
    with safe_open(path, "pt") as file:
        assert file.metadata()["probe_kit.weights"].startswith("trained")
        assert all(torch.isfinite(file.get_tensor(key)).all() for key in file.keys())  # noqa: SIM118


def test_the_hand_never_turns(pi0_tiny: Pi0) -> None:
    turning = [dimension for dimension in range(7) if dimension not in ACTION_DIMS]
    assert not pi0_tiny.action_units.high[turning].any()
    assert not pi0_tiny.action_units.low[turning].any()


@pytest.mark.slow
def test_color_and_shape_are_answered_far_above_chance(tmp_path: Path) -> None:
    """Sixteen episodes; the bound is three standard errors under the measured rate, and far above one half."""
    suite = build_suite(tmp_path / "suite", ["color", "shape"], 4)
    run = extract_run(ExtractSettings("pi0-tiny", suite=suite.folder), tmp_path / "run")
    assert run.episodes["is_success"].mean() >= 0.75
    assert (run.episodes["outcome"] == "wrong").mean() <= 0.2
