"""The runs below a folder of this machine."""

import os
from pathlib import Path

from probe_kit.errors import UsageError
from probe_kit.runs.layout import RUN_FILE


def is_run(folder: Path) -> bool:
    """Whether the folder itself is a run."""
    return (folder / RUN_FILE).is_file()


def runs_in(folder: Path, deep: bool = True) -> list[Path]:
    """Return the runs below `folder`, finished or not, in the order of their paths; empty without any.

    A run holds no other. deep: at any depth, else directly below, which is quick in a large folder.
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
