"""Quantities in which pi0.5 is compared with its golden references: see `shared.lerobot.verify`."""

from pathlib import Path

from probe_kit.hooks.families.pi05.adapter import load_pi05
from probe_kit.hooks.families.shared.lerobot.verify import Arrays, verify_flow
from probe_kit.hooks.verification.verify import Comparison


def verify_pi05(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Compare a pi0.5 reference."""
    return verify_flow(load_pi05, folder, recorded)
