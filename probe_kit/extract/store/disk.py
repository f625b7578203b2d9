"""Disk space: a run that cannot fit is refused before it begins."""

from probe_kit.errors import DiskSpaceError
from probe_kit.extract.store.location import Location

# The estimate is of uncompressed bytes; this much more covers commits and file-system blocks.
HEADROOM = 1.1


def refuse_if_full(raw_bytes: int, location: Location) -> None:
    """Raise DiskSpaceError if so many uncompressed bytes, with headroom, exceed the free space at `location`."""
    needed, free = raw_bytes * HEADROOM, location.free_bytes()
    if free is not None and needed > free:
        raise DiskSpaceError(
            f"the run needs up to {needed / 1e9:.1f} GB but the disk of {location} has {free / 1e9:.1f} GB free. "
            "Use fewer --items, --tokens pooled, another --out, or --force"
        )
