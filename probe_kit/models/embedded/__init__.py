"""The embedded models: a small policy and the VLM it was made from. Imports nothing heavy."""

from pathlib import Path


def embedded_checkpoint(name: str) -> Path:
    """Return the folder of a checkpoint that comes with the package, such as `pi0-tiny` or `vlm-tiny`."""
    return Path(__file__).parents[1] / "checkpoints" / name
