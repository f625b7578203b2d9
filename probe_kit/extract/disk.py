"""Disk space: refused before a run that cannot fit, put in words when it ran out after all."""

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from probe_kit.errors import DiskSpaceError
from probe_kit.extract.plan import Plan

# The estimate is of uncompressed bytes; this much more covers commits and file-system blocks.
HEADROOM = 1.1


def free_bytes(out: Path) -> int:
    """Free space where `out` lies or will lie."""
    place = next(parent for parent in (out, *out.resolve().parents) if parent.exists())
    return shutil.disk_usage(place).free


def refuse_if_full(plan: Plan, out: Path) -> None:
    """Raise DiskSpaceError if the plan with headroom exceeds the free space where `out` will lie."""
    needed, free = plan.bytes * HEADROOM, free_bytes(out)
    if needed > free:
        raise DiskSpaceError(
            f"the run needs up to {needed / 1e9:.1f} GB but {out.resolve().parent} has {free / 1e9:.1f} GB free. "
            "Use fewer --items, --tokens pooled, another --out, or --force"
        )


@contextmanager
def full_disk_in_words(run: Path) -> Iterator[None]:
    """Raise DiskSpaceError in place of the system's error if the disk runs full in the body."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskSpaceError(
            f"the disk of {run} is full ({free_bytes(run) / 1e6:.1f} MB free); every committed episode is whole "
            "and kept. Free some space, then the same command continues"
        ) from error
