"""What a run holds, to be compared byte for byte."""

from pathlib import Path

from probe_kit.runs import open_run
from probe_kit.runs.layout import COLUMNS
from probe_kit.runs.store import Location, locate


def objects(run: str | Path | Location) -> dict[str, bytes]:
    """Every object by key; the columns by what they are called in a folder."""
    location = locate(run)
    stamped = f"{location.derived(COLUMNS, open_run(run).stamp)}/"
    return {key.replace(stamped, f"{COLUMNS}/"): location.read(key) for key in location.keys("")}
