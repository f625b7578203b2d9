"""The runs below a folder of this machine, and whether one more fits on its disk."""

import os
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from probe_kit._system.counting import plural
from probe_kit.errors import DiskSpaceError, UsageError
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.store import Location


def is_run(folder: Path) -> bool:
    """Whether the folder itself is a run."""
    return (folder / RUN_FILE).is_file()


def runs_in(folder: Path, deep: bool = True) -> list[Path]:
    """Return the runs below `folder`, finished or not, in the order of their paths; empty without any.

    A run holds no other run. With `deep`, folders at any depth are searched; else only those directly below, which
    is quick in a large folder.
    """
    if not deep:
        return [path.parent for path in sorted(folder.glob(f"*/{RUN_FILE}"))] if folder.is_dir() else []
    runs = []
    for path, names, _ in os.walk(folder):
        if is_run(Path(path)):
            runs.append(Path(path))
            names.clear()
        names[:] = sorted(name for name in names if not name.startswith("."))
    return runs


def find_runs(folder: Path) -> list[Path]:
    """Return the runs below `folder` at any depth. Raises UsageError for no folder, or one without a run."""
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder of this machine; give the folder that holds the runs")
    runs = runs_in(folder)
    if not runs:
        raise UsageError(
            f"there is no run below {folder}: no folder of it has a {RUN_FILE}. Make one with `probe-kit extract`"
        )
    return runs


def runs_below(address: str) -> list[Path]:
    """Return the runs inside a folder of this machine that is no run itself; none for a run or another address."""
    folder = Path(address).expanduser()
    return [] if "://" in address or is_run(folder) else runs_in(folder)


MOST = 12
"""The most runs of a folder that a message names."""


def what_to_open(address: str) -> str:
    """Advise what to do where there is no run: open one inside, one of nearly that name, or make one."""
    folder = Path(address).expanduser()
    if "://" not in address:
        if inside := runs_in(folder):
            more = f" and {len(inside) - MOST} more" if len(inside) > MOST else ""
            return f"It holds {plural(len(inside), 'run')}: {', '.join(map(str, inside[:MOST]))}{more}"
        neighbours = {path.name: path for path in runs_in(folder.parent, deep=False)}
        if near := get_close_matches(folder.name, neighbours, n=1):
            return f"Did you mean {neighbours[near[0]]}?"
    return "Make one with `probe-kit extract`"


# The estimate is of uncompressed bytes; this much more covers file-system blocks. Less would start runs that fill
# the disk, more would refuse runs that fit.
HEADROOM = 1.1
_UNITS = ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB"))


def check_if_full(parts: Mapping[str, int], location: Location) -> None:
    """Raise DiskSpaceError if the parts of a run, in bytes, with headroom exceed the free space at `location`."""
    needed, free = sum(parts.values()) * HEADROOM, location.free_bytes()
    if free is not None and needed > free:
        listed = ", ".join(f"{name} {in_units(size)}" for name, size in parts.items() if size)
        raise DiskSpaceError(
            f"the run needs up to {in_units(needed)} ({listed}, and a tenth more) but the disk of {location} has "
            f"{in_units(free)} free. Use fewer --items, --tokens pooled, another --out, or --force"
        )


def in_units(size: float) -> str:
    """Return bytes in the unit in which they are at least one: `3.2 GB`, `17 B`."""
    for unit, name in _UNITS:
        if size >= unit:
            return f"{size / unit:,.1f} {name}"
    return f"{size:.0f} B"
