"""Checks of the files that `probe-kit verify` needs, before torch is imported."""

from pathlib import Path

from probe_kit.errors import UsageError
from probe_kit.hooks.registry import find_family

REFERENCE_FILE, CHECKPOINT_FOLDER = "reference.npz", "checkpoint"


def check_reference(family: str, folder: Path) -> None:
    """Refuse a family without a verifier, a folder without a reference, and a checkpoint of another model.

    Raises UnknownModelError, UsageError, CheckpointError or WeightsError.
    """
    found = find_family(family)
    if found.verifier is None:
        raise UsageError(f"{family} has no verifier; it cannot be verified this way")
    if not (folder / REFERENCE_FILE).is_file():
        raise UsageError(
            f"{folder} is not a golden reference: it has no {REFERENCE_FILE}. Give a folder that has one, and the "
            f"recorded model in {CHECKPOINT_FOLDER}/"
        )
    found.check(str(folder / CHECKPOINT_FOLDER))


def check_key_list(family: str, file: Path) -> None:
    """Refuse a family without a full-size network, and a key list that is not there.

    Raises UnknownModelError or UsageError.
    """
    if find_family(family).full_size is None:
        raise UsageError(f"{family} has no full-size; it cannot be verified this way")
    if not file.is_file():
        raise UsageError(f"key list {file} does not exist")
