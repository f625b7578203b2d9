"""Quantities in which SmolVLA is compared with its golden references: see `shared.lerobot.verify`."""

from pathlib import Path

from probe_kit.hooks.families.shared.lerobot.verify import Arrays, verify_flow
from probe_kit.hooks.families.smolvla.adapter import load_smolvla
from probe_kit.hooks.verification.verify import Comparison


def verify_smolvla(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Compare a SmolVLA reference."""
    return verify_flow(load_smolvla, folder, recorded)
