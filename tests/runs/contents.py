"""What a run holds, to be compared byte for byte."""

from pathlib import Path

from probe_kit.runs.store import Location, locate


def objects(run: str | Path | Location) -> dict[str, bytes]:
    """Every object by key."""
    location = locate(run)
    return {key: location.read(key) for key in location.keys("")}
