"""Disk space: a run that cannot fit is refused before it starts."""

from collections.abc import Mapping

from probe_kit.errors import DiskSpaceError
from probe_kit.runs.store import Location

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
    """Bytes in the unit in which they are at least one: `3.2 GB`, `17 B`."""
    for unit, name in _UNITS:
        if size >= unit:
            return f"{size / unit:,.1f} {name}"
    return f"{size:.0f} B"
