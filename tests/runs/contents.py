"""What a run holds, to be compared byte for byte."""

import hashlib
from pathlib import Path

from probe_kit.runs.store import Location, locate


def objects(run: str | Path | Location) -> dict[str, bytes]:
    """Every object by key."""
    location = locate(run)
    return {key: location.read(key) for key in location.keys("")}


def hashes(folder: Path) -> dict[str, str]:
    """The hash of every file by its path, read past probe_kit."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
